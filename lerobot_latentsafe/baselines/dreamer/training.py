"""Training the task policy online: demonstrations, then episodes of its own, and imagination in between.

Everything a step draws depends on the seed and its number, and everything an episode draws on the seed and its number,
so a run that was killed goes on from its last checkpoint as if nothing had happened.
"""

import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import draccus
import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.optim.optimizers import load_optimizer_state, save_optimizer_state
from torch import Tensor

from lerobot_latentsafe.baselines.dreamer.configuration_dreamer import LatentSafeDreamerConfig
from lerobot_latentsafe.baselines.dreamer.modeling_dreamer import LatentSafeDreamerPolicy
from lerobot_latentsafe.baselines.dreamer.replay import CAMERA_KEYS, Operator, Replay, described, export, record
from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.datasets.collect_franka import SOURCES
from lerobot_latentsafe.envs.franka_env import BlocksEnv
from lerobot_latentsafe.memory import keep_freed_memory
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, adopt_dataset
from lerobot_latentsafe.robots.franka_interface import ACTION_NAMES, STATE_NAMES
from lerobot_latentsafe.teleoperators.scripted.behaviors import Actions, begin
from lerobot_latentsafe.training import save_filter
from lerobot_latentsafe.world_models.base import Clip

OPTIONS, LOG = "options.json", "log.jsonl"


@dataclass
class TrainDreamer:
    """Learn the blocks' task policy, with its world model and failure margin, from demonstrations and its own episodes.

    A killed run goes on if it is started again. Afterwards <output_dir>/policy is the task policy, <output_dir>/policy/
    world_model what `latentsafe train-reachability` takes as --policy.path, and <output_dir>/episodes the dataset that
    goes with it.
    """

    output_dir: Path
    policy: PreTrainedConfig
    """A latentsafe_dreamer configuration: the actor-critic and its rewards."""
    model: PreTrainedConfig
    """A latentsafe configuration: world model and margin, and the filter to come."""
    repo_id: str = "local/blocks_dreamer"
    """Of the dataset that is written."""
    demonstrations: int = 200
    """Episodes of the scripted operators of the source blocks_demos."""
    pretraining: int = 2000
    """Steps on demonstrations alone: world model, margin and cloning."""
    steps: int = 10_000
    """All steps."""
    collect_every: int = 100
    """Steps between rounds of episodes."""
    n_envs: int = 8
    """Episodes of a round."""
    batch_size: int = 20
    """Clips of a step."""
    demonstration_share: float = 0.1
    """Of a batch, once there are episodes of the policy."""
    save_every: int = 1000
    log_every: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        for name, expected in (("policy", LatentSafeDreamerConfig), ("model", LatentSafeConfig)):
            if not isinstance(getattr(self, name), expected):
                found = getattr(self, name).type
                wanted = "latentsafe_dreamer" if name == "policy" else "latentsafe"
                raise ValueError(f"--{name}.type is {found!r}; expected {wanted}")
        if self.model.world_model.type != "rssm":
            raise ValueError(f"--model.world_model.type is {self.model.world_model.type!r}; expected 'rssm'")
        if not 0 <= self.pretraining <= self.steps:
            raise ValueError(f"--pretraining is {self.pretraining}; expected 0 to --steps, {self.steps}")

    @property
    def n_rounds(self) -> int:
        return -(-(self.steps - self.pretraining) // self.collect_every)

    def run(self) -> None:
        DreamerTraining(self).run()
        print(f"task policy in {self.output_dir / 'policy'}, its episodes in {self.output_dir / 'episodes'}")


class DreamerTraining:
    """The run that a `TrainDreamer` describes, from wherever it stopped."""

    def __init__(self, options: TrainDreamer):
        self.options, self.folder = options, Path(options.output_dir)
        self._claim()
        self.envs = [BlocksEnv() for _ in range(options.n_envs)]
        self.scene = self.envs[0].scene
        self.image_size = options.model.world_model.image_size
        n_episodes = options.demonstrations + options.n_rounds * options.n_envs
        self.replay = Replay.open(self.folder / "replay", n_episodes, self.envs[0]._max_episode_steps, self.image_size)
        self.started = time.process_time()
        self._record_demonstrations()
        self._load() if self._checkpoints() else self._begin()
        if self.policy.model.device.type == "cpu":
            keep_freed_memory()

    def run(self) -> LatentSafeDreamerPolicy:
        """Train to the end, and write the policy and its episodes."""
        options = self.options
        while self.step < options.steps:
            since = self.step - options.pretraining
            if since >= 0 and since % options.collect_every == 0:
                self._record_round(since // options.collect_every)
            metrics = self.update()
            self.step += 1
            if self.step % options.log_every == 0:
                self._note(metrics)
            if self.step % options.save_every == 0 or self.step == options.steps:
                self._save()
        self.policy.eval()
        if not (self.folder / "policy").exists():
            save_filter(self.policy, self.folder / "policy.unfinished")
            (self.folder / "policy.unfinished").rename(self.folder / "policy")
        if not (self.folder / "episodes").exists():
            export(self.replay, self.n_episodes, self.folder / "episodes", options.repo_id, self.scene)
        self._note({"simulator_steps": self.n_episodes * self.replay.length})
        for env in self.envs:
            env.close()
        return self.policy

    # -- episodes ---

    @property
    def n_episodes(self) -> int:
        """Episodes that there are at this step: demonstrations first, then rounds of the policy's."""
        options = self.options
        rounds = (self.step - options.pretraining) // options.collect_every + 1
        return options.demonstrations + min(max(rounds, 0), options.n_rounds) * options.n_envs

    def _record_demonstrations(self) -> None:
        """By the scripted operators; episodes that are there already stay."""
        source, n_envs = SOURCES["blocks_demos"], len(self.envs)
        for first in range(0, self.options.demonstrations, n_envs):
            episodes = list(range(first, min(first + n_envs, self.options.demonstrations)))
            if not self.replay.written[episodes].all():
                operators = [
                    begin(source.behavior(i), env.scene, None, np.random.default_rng([self.options.seed, i]))
                    for env, i in zip(self.envs, episodes)
                ]
                self._record(episodes, _Scripted(operators))

    @torch.no_grad()
    def _record_round(self, index: int) -> None:
        """By the policy as it is, exploring."""
        options, policy = self.options, self.policy.eval()
        episodes = [options.demonstrations + index * options.n_envs + i for i in range(options.n_envs)]
        torch.manual_seed(_number(options.seed, 1, index))
        policy.reset()
        outcomes = self._record(episodes, lambda batch: policy.act(batch, explore=True).cpu().numpy())
        self._note({"round": index, **{name: int(sum(o[name] for o in outcomes)) for name in ("success", "violation")}})

    def _record(self, episodes: list[int], operator: Operator) -> list[dict[str, bool]]:
        seeds = [1_000_000 * self.options.seed + i for i in episodes]
        recorded = record(self.envs[: len(episodes)], seeds, operator, self.image_size)
        outcomes = []
        for i, episode in zip(episodes, recorded):
            self.replay.write(i, episode)
            violation = bool(episode["failure"].any())
            outcomes.append({"success": bool(episode["terms"][-1, 1]) and not violation, "violation": violation})
        return outcomes

    # -- learning ---

    def update(self) -> dict[str, float]:
        """One step on world model, margin, rewards, actor and critic."""
        torch.manual_seed(_number(self.options.seed, 2, self.step))
        policy, config = self.policy.train(), self.policy.config.behavior
        clip, reward, demonstrated = self._batch()
        loss, features, metrics = policy.model_loss(clip, reward)
        self._descend("model", loss)
        features = features.detach()
        cloning_loss = policy.cloning_loss(*(part[demonstrated] for part in (features, clip.action, clip.valid)))
        kept = clip.valid.flatten().nonzero().squeeze(1)
        kept = kept[torch.randperm(len(kept))[: config.starts].to(kept.device)]
        start = policy.model.world_model.latent_of(features.flatten(0, 1)[kept], clip.action.flatten(0, 1)[kept])
        actor_loss, critic_loss, imagined = policy.behavior_losses(start)
        # At first the critic only learns what imitation is worth.
        learning = self.step >= self.options.pretraining
        behavior_loss = critic_loss + (actor_loss + config.cloning * cloning_loss if learning else cloning_loss)
        self._descend("behavior", behavior_loss)
        policy.follow_slowly()
        return {"loss": loss.item(), "loss_cloning": cloning_loss.item(), **metrics, **imagined}

    def _descend(self, name: str, loss: Tensor) -> None:
        """A gradient step; step sizes rise over the first 100 steps and fall over the second half."""
        options, optimizer = self.options, self.optimizers[name]
        decay = min(1.0, (self.step + 1) / 100, 2.05 - 2 * self.step / options.steps)
        parameters = []
        for group, lr in zip(optimizer.param_groups, self.step_sizes[name]):
            group["lr"] = lr * decay
            parameters += group["params"]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, self.policy.model.config.grad_clip_norm)
        optimizer.step()

    def _batch(self) -> tuple[Clip, Tensor, Tensor]:
        """A clip of windows, their rewards (B, T), and which rows are demonstrations: bool (B,)."""
        options, policy = self.options, self.policy
        rng = np.random.default_rng([options.seed, self.step])
        reader = self.replay.reader(self.n_episodes, policy.model.config.world_model.clip_length)
        n_frames, n_demonstrated = len(reader.labels.failure), options.demonstrations * self.replay.length
        n = options.batch_size
        if n_frames > n_demonstrated:
            n = max(1, round(options.demonstration_share * options.batch_size))
        demonstrated = np.arange(options.batch_size) < n
        start = np.where(
            demonstrated,
            rng.integers(n_demonstrated, size=options.batch_size),
            rng.integers(min(n_demonstrated, n_frames - 1), n_frames, size=options.batch_size),
        )
        clip = reader.cut(start, policy.model)
        window = np.minimum(start[:, None] + np.arange(reader.length), n_frames - 1)
        terms = torch.from_numpy(self.replay.arrays["terms"][window]).to(policy.model.device)
        return clip, policy.config.behavior.rewards.reward(terms), torch.from_numpy(demonstrated)

    # -- files ---

    def _begin(self) -> None:
        """Fresh weights, for what the demonstrations hold."""
        options = self.options
        torch.manual_seed(_number(options.seed, 0, 0))
        config = options.model
        config.cameras, config.task = list(CAMERA_KEYS), self.scene.task
        shape = (3, self.scene.image_size, self.scene.image_size)
        config.input_features = {
            **{key: PolicyFeature(FeatureType.VISUAL, shape) for key in CAMERA_KEYS},
            "observation.state": PolicyFeature(FeatureType.STATE, (len(STATE_NAMES),)),
        }
        config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (len(ACTION_NAMES),))}
        adopt_dataset(config, described(self.scene.fps), self.replay.statistics(options.demonstrations))
        self._train(LatentSafeDreamerPolicy(options.policy, LatentSafePolicy(config)), 0)

    def _train(self, policy: LatentSafeDreamerPolicy, step: int) -> None:
        self.policy, self.step = policy, step
        config = policy.config.behavior
        parts = {
            "model": [([*policy.model.get_optim_params(), *policy.reward.parameters()], config.model_lr)],
            "behavior": [(policy.actor.parameters(), config.actor_lr), (policy.critic.parameters(), config.critic_lr)],
        }
        self.step_sizes = {name: [lr for _, lr in groups] for name, groups in parts.items()}
        self.optimizers = {
            name: torch.optim.Adam([{"params": list(p)} for p, _ in groups], fused=True)
            for name, groups in parts.items()
        }

    def _checkpoints(self) -> list[Path]:
        return sorted(p for p in (self.folder / "checkpoints").glob("*") if p.name.isdigit())

    def _save(self) -> None:
        """Write a checkpoint whole, then drop the one before."""
        before = self._checkpoints()
        partial = self.folder / "checkpoints" / "unfinished"
        shutil.rmtree(partial, ignore_errors=True)
        save_filter(self.policy, partial / "policy")
        save_optimizer_state(self.optimizers, partial / "optimizers")
        partial.rename(self.folder / "checkpoints" / f"{self.step:07d}")
        for folder in before:
            shutil.rmtree(folder)

    def _load(self) -> None:
        folder = self._checkpoints()[-1]
        self._train(LatentSafeDreamerPolicy.from_pretrained(folder / "policy"), int(folder.name))
        load_optimizer_state(self.optimizers, folder / "optimizers")

    def _claim(self) -> None:
        """Note what this folder's run is, and refuse to go on with another.

        Raises:
            ValueError: the folder holds a run with other options.
        """
        wanted = json.loads(json.dumps(draccus.encode(self.options)))
        for name in ("output_dir", "log_every"):
            del wanted[name]
        note = self.folder / OPTIONS
        if note.exists() and (known := json.loads(note.read_text())) != wanted:
            names = [k for k in wanted if known.get(k) != wanted[k]]
            raise ValueError(
                f"{self.folder} holds a run with other options ({', '.join(names)}), which a resumed one would mix; "
                "choose another --output_dir or delete it"
            )
        self.folder.mkdir(parents=True, exist_ok=True)
        note.write_text(json.dumps(wanted, indent=2))

    def _note(self, row: dict) -> None:
        row = {"step": self.step, "cpu_s": round(time.process_time() - self.started), **row}
        with (self.folder / LOG).open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(" ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), flush=True)


class _Scripted:
    """Operators of `teleoperators/scripted`, one an environment; when they have finished they hold still."""

    def __init__(self, operators: list[Actions]):
        self.operators, self.last = operators, np.zeros((len(operators), len(ACTION_NAMES)))

    def __call__(self, batch: dict[str, Tensor]) -> np.ndarray:
        still = [np.append(np.zeros(6), last[6]) for last in self.last]
        self.last = np.stack([next(operator, stay) for operator, stay in zip(self.operators, still)])
        return self.last


def _number(*parts: int) -> int:
    """A seed that depends on all parts."""
    return int(np.random.SeedSequence(parts).generate_state(1)[0])
