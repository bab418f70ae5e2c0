"""The long verbs, with options by which each takes seconds."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_latentsafe.experiments.kills.courses import Course, Labelling, LeRobotTraining, Pushing, Recording

CAR, DEMONSTRATIONS, MODEL, FILTER = "car", "demonstrations", "world_model", "filter"
"""Folders of what the verbs start from."""


@dataclass(frozen=True)
class Verb:
    """A verb and its options, with `{made}` and `{out}` for the folder to read from and to write into.

    Attributes:
        typed: verb and options.
        product: what it leaves in `{out}`.
        within: a dataset of `{made}` that it writes into, of which each run has a copy in `{out}/out`.
        course: how it goes.
    """

    typed: str
    product: str = "out"
    within: str | None = None
    course: type[Course] = Course

    def words(self, made: Path, out: Path) -> list[str]:
        """What is typed."""
        return self.typed.format(made=made, out=out).split()


def data(name: str) -> str:
    """Options that name a dataset of the folder to read from."""
    return f"--dataset.repo_id=me/{name} --dataset.root={{made}}/{name}"


SMALL = {"type": "rssm", "deterministic": 16, "stochastic": 4, "hidden": 16, "units": 16, "clip_length": 6}
SIZES = [f"world_model.{name}={value}" for name, value in SMALL.items()]
SIZES += ["margin.clips=64", "reachability.critic_hidden=[16]", "reachability.actor_hidden=[16]"]
SIZES += ["reachability.steps=60", "reachability.pool=512", "reachability.horizon=4", "reachability.batch_size=32"]
SIZES += ["reachability.refresh=10"]
TRAIN = f"lerobot-train --policy.type=latentsafe --policy.device=cpu --policy.push_to_hub=false {data('car_cache')} "
TRAIN += " ".join(f"--policy.{size}" for size in SIZES)
TRAIN += " --policy.fallback.action_candidates=[[-1.25,1.0],[0.0,1.0],[1.25,1.0]] --log_freq=1 --batch_size=8"
TRAIN += " --num_workers=0 --seed=1 --output_dir={out}/out"
NEW = "--dataset.repo_id=me/new --dataset.root={out}/out"
DREAMER = (
    "train-dreamer --config_path=configs/blocks_dreamer.yaml --output_dir={out}/out --model.world_model.image_size=16"
)
DREAMER += " --model.world_model.classes=4 --model.world_model.encoder=mlp --policy.behavior.hidden=16"
DREAMER += (
    " --policy.behavior.bins=17 --policy.behavior.horizon=3 --policy.behavior.starts=8 --model.world_model.hidden=16"
)
DREAMER += " --model.world_model.deterministic=16 --model.world_model.clip_length=6 --model.world_model.stochastic=4"
DREAMER += " --demonstrations=4 --pretraining=6 --steps=20 --collect_every=4 --n_envs=2 --batch_size=4 --save_every=3"
DREAMER += " --log_every=1 --cuda_graph=false"
RECORD = "record --filter=blocks --robot.type=latentsafe_franka_mujoco --robot.scene=blocks --robot.seed=3"
RECORD += f" --teleop.type=latentsafe_scripted --teleop.behavior=pluck_careful {NEW} --dataset.single_task=pluck"
RECORD += " --dataset.fps=20 --dataset.num_episodes=5 --dataset.episode_time_s=1 --dataset.reset_time_s=0.2"
RECORD += " --dataset.push_to_hub=false --play_sounds=false"

VERBS = {
    "collect, car": Verb(f"collect {NEW} --source=random --dataset.num_episodes=9"),
    "collect, Franka": Verb(f"collect {NEW} --source=blocks_demos --dataset.num_episodes=4"),
    "collect, SO-101": Verb(f"collect {NEW} --source=so101_mix --dataset.num_episodes=4"),
    "record": Verb(RECORD, course=Recording),
    "cache": Verb(f"cache {data(CAR)} --image_size=64 --output_dir={{out}}/out"),
    "lerobot-train": Verb(f"{TRAIN} --steps=8 --save_freq=1", "out/checkpoints", course=LeRobotTraining),
    "train-margin": Verb(f"train-margin --policy.path={{made}}/{MODEL} {data('car_cache')} --output_dir={{out}}/out"),
    "train-reachability": Verb(
        f"train-reachability --policy.path={{made}}/{MODEL} {data('car_cache')} --output_dir={{out}}/out --steps=300"
    ),
    "train-dreamer": Verb(DREAMER),
    "calibrate": Verb(f"calibrate --policy.path=dubins {data('car_cache')} --alpha=0.3 --output_dir={{out}}/out"),
    "report": Verb(
        f"report --policy.path={{made}}/{FILTER} --env.type=latentsafe_dubins --env.episode_length=8 --n_episodes=2 "
        "--base_policy_path=dubins_diffusion_reckless --output={out}/out/report.html"
    ),
    "label": Verb(
        f"label --dataset.repo_id={Labelling.REPO} --dataset.root={{out}}/out --user=somebody --port=0 "
        f"--specifications=[{Labelling.SPECIFICATION}]",
        within=DEMONSTRATIONS,
        course=Labelling,
    ),
    "auto-label": Verb(
        f"auto-label --dataset.repo_id=me/{DEMONSTRATIONS} --dataset.root={{out}}/out --labeller=dubins_truth "
        "--specification=crashed",
        within=DEMONSTRATIONS,
    ),
    "write-labels": Verb(
        f"write-labels {data(CAR)} --specifications=[crashed] --new_repo_id=me/labelled --output_dir={{out}}/out"
    ),
    "push": Verb("push --policy.path=dubins --repo_id=me/filter --dataset_repo_id=me/car", course=Pushing),
}
