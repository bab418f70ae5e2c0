"""Recording the simulated Franka in bulk, through the same robot and operators as lerobot-record.

Episode i depends on the seed and i only.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.collection.interventions import BRIEF, RARE, RETREATING, Interventions, InterventionStyle
from lerobot_latentsafe.collection.parts import record_in_parts
from lerobot_latentsafe.collection.policy_operator import LOCATION, PolicyOperator, check_policy
from lerobot_latentsafe.datasets.labels import FAILING, SAFE
from lerobot_latentsafe.evaluation.rollouts import Choice, Step, steps
from lerobot_latentsafe.franka.actions import ACTION_NAMES, STATE_NAMES, action_limits, read_action
from lerobot_latentsafe.franka.bag import BagScene, varied
from lerobot_latentsafe.franka.behaviors import GRASPED, grasp, lower, stray
from lerobot_latentsafe.franka.scenes import CLUMSINESS, HELD_ANYWHERE, SCENES
from lerobot_latentsafe.robots.franka_mujoco.config_franka_mujoco import LatentSafeFrankaMujocoConfig
from lerobot_latentsafe.robots.franka_mujoco.franka_mujoco import LatentSafeFrankaMujoco
from lerobot_latentsafe.runtime.tasks import Tasks
from lerobot_latentsafe.teleoperators.scripted.config_scripted import LatentSafeScriptedConfig
from lerobot_latentsafe.teleoperators.scripted.scripted import LatentSafeScripted

EPISODES_A_PART = 50
HIGH = 0.10
"""Height of the hand below which the fingers may hold something, m."""


@dataclass(frozen=True)
class Source:
    """A dataset: its scene, how many episodes, and who moves the robot in each.

    Attributes:
        mix: behaviours of `franka/behaviors.py` with the number of episodes of each, in a dataset of full size;
            smaller ones keep the proportions. Episodes of different behaviours are interleaved.
        varied: each start has a bag of its own stiffness, weight and friction.
        branches: episodes that start from each grasped state; 0 records whole episodes from the start.
        grasps: of those states, the shares in which the bag is held by each of its segments, from its closed end on.
        clumsiness: of those grasps: 1 is off by a few millimetres.
        speeds: slowest and fastest of the motion that matters, m/s; None: those that a behaviour is known for.
        astray: share of episodes that start with the arm astray instead of at home: demonstrations that all go straight
            to the bag never show a policy how to correct itself.
        pushed: standard deviation of the speed in m/s at which the hand is pushed now and then, and high up its fingers
            are closed, while the operator keeps them open. Recorded is what the operator commands, so that a policy
            learns to correct and not to stray (DART, Laskey et al. 2017).
        policies: the behaviours are names of policies, see `policy_operator.py`.
        style: how somebody intervenes in what policies and operators do, if at all.
        shield: name of the filter that says when, instead of chance.
        seconds: how long an episode lasts; None: as long as the scene's.
        told: where the bag is, is recorded, too: for policies that are told instead of looking.
    """

    scene: str
    mix: dict[str, int]
    variant: str | None = None
    varied: bool = False
    branches: int = 0
    grasps: tuple[float, ...] = (0.6, 0, 0, 0.2, 0, 0, 0.2)
    clumsiness: float = 1.0
    speeds: tuple[float, float] | None = None
    astray: float = 0.0
    pushed: float = 0.0
    policies: bool = False
    style: InterventionStyle | None = None
    shield: str | None = None
    seconds: float | None = None
    told: bool = False

    @property
    def n_episodes(self) -> int:
        """Of a dataset of full size."""
        return sum(self.mix.values())

    def behavior(self, episode: int) -> str:
        """Of an episode: behaviours follow each other in a fixed shuffle of the whole mix, over and over."""
        names = np.repeat(list(self.mix), list(self.mix.values()))
        return str(np.random.default_rng(0).permutation(names)[episode % len(names)])


WEAK, STRONG = "bag_diffusion_weak", "bag_diffusion_strong"
"""The committed policies of the bag."""

SOURCES: dict[str, Source] = {
    "bag_mix": Source("bag", {"random": 1000, "open_end": 75, "middle": 75, "closed_end": 100, "side_to_side": 50}),
    "bag_branches": Source("bag", {"branch": 500}, branches=5),
    "bag_climbs": Source("bag", {"climb": 200}, branches=4, grasps=(0.5, 0, 0, 0.1, 0, 0, 0.4)),
    "bag_lifts": Source("bag", {"rise": 200}, branches=1, grasps=(0.5, 0, 0, 0, 0, 0, 0.5)),
    "bag_between": Source("bag", {"branch": 100, "climb": 100}, branches=4, grasps=(0, 0.4, 0.2, 0, 0.2, 0.2, 0)),
    "bag_dither": Source(
        "bag", {"dither": 200, "branch": 100, "rise": 100}, branches=1, grasps=HELD_ANYWHERE, clumsiness=CLUMSINESS
    ),
    "bag_clumsy": Source("bag", {"clumsy": 120}),
    # The weak one spills, of which there is more to learn; of the strong one, what is stopped without need.
    "bag_policies": Source("bag", {WEAK: 150, STRONG: 50}, policies=True, style=BRIEF, seconds=10.0),
    "bag_shielded": Source("bag", {WEAK: 50, STRONG: 150}, policies=True, style=RETREATING, shield="bag", seconds=10.0),
    "bag_retreats": Source(
        "bag", {"open_end": 80, "middle": 30, "closed_end": 90}, astray=0.3, style=RETREATING, seconds=8.0
    ),
    "bag_pulls": Source("bag", {"open_end": 80, "middle": 30, "closed_end": 50, "side_to_side": 40}, astray=0.3),
    # Most swing too slowly to spill: of fast ones the other recordings have enough.
    "bag_swings": Source("bag", {"side_to_side": 120}, speeds=(0.05, 0.22), style=RARE),
    "bag_varied": Source(
        "bag", {"branch": 80, "climb": 80, "rise": 80}, varied=True, branches=2, grasps=(0.5, 0, 0, 0.1, 0, 0, 0.4)
    ),
    "bag_varied_pulls": Source(
        "bag", {"open_end": 30, "middle": 15, "closed_end": 65, "side_to_side": 10}, varied=True, astray=0.3
    ),
    "bag_middle": Source("bag", {"middle": 100}, astray=0.8),
    "bag_strong": Source("bag", {"middle": 240}, astray=0.8, pushed=0.1),
    "bag_weak": Source("bag", {"closed_end": 240}, variant="sealed", astray=0.8, pushed=0.1),
    "bag_mixed": Source(
        "bag",
        {"nearer": 160, "regrasp": 100},
        variant="sealed",
        astray=0.8,
        pushed=0.1,
        seconds=8.0,
        grasps=(0.6, 0.15, 0, 0.25, 0, 0, 0),
        told=True,
    ),
    "blocks_demos": Source("blocks", {"fetch": 200}),
    "blocks_random": Source("blocks", {"random": 200}),
}
"""What `latentsafe collect --source=...` can record of the Franka."""


def features(source: Source) -> dict:
    """The dataset's features; labels and rewards are no inputs of a policy (see `labels.py`)."""
    size = SCENES[source.scene].image_size
    image = {"dtype": "video", "shape": (size, size, 3), "names": ["height", "width", "channels"]}
    return {
        "observation.images.front": image,
        "observation.images.wrist": dict(image),
        "observation.state": {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": STATE_NAMES},
        **(LOCATION if source.told else {}),
        "action": {"dtype": "float32", "shape": (len(ACTION_NAMES),), "names": ACTION_NAMES},
        "failure": {"dtype": "int64", "shape": (1,), "names": None},
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
        "next.success": {"dtype": "bool", "shape": (1,), "names": None},
        "next.done": {"dtype": "bool", "shape": (1,), "names": None},
    }


def collect_franka(
    name: str, repo_id: str, root: str | Path, n_episodes: int | None, seed: int, workers: int = 1,
    tasks: Tasks | None = None, policy: str | None = None,
) -> LeRobotDataset | None:  # fmt: skip
    """Record a source, or go on recording it.

    Args:
        n_episodes: None takes the source's.
        workers: processes that record.
        policy: path of the one that acts, instead of those of a source of policies.

    Returns, raises:
        See `record_in_parts` and `check_policy`; ValueError for an unknown source, too, and for a policy where
        operators act.
    """
    if name not in SOURCES:
        raise ValueError(f"--source is {name!r}; expected one of {', '.join(SOURCES)}")
    source = SOURCES[name]
    n = source.n_episodes if n_episodes is None else n_episodes
    options = {"source": name, "repo_id": repo_id, "seed": seed}
    if policy is not None:
        require_policies(name)
        check_policy(policy, SCENES[source.scene].fps, SCENES[source.scene].image_size)
        source, options = replace(source, mix={policy: n}), {**options, "policy": policy}
    record = partial(_record, source, repo_id, seed)
    return record_in_parts(repo_id, root, options, n, record, EPISODES_A_PART, workers, tasks)


def require_policies(name: str) -> None:
    """Refuse a policy where operators act.

    Raises:
        ValueError: naming the sources in which policies do.
    """
    of_policies = [known for known, source in SOURCES.items() if source.policies]
    if name not in of_policies:
        raise ValueError(
            f"--policy was given, and no policy acts in {name}; expected --source={' or '.join(of_policies)}"
        )


def _record(source: Source, repo_id: str, seed: int, episodes: range, root: Path) -> Iterator[None]:
    """Write the dataset of some episodes; yields after each."""
    dataset = LeRobotDataset.create(
        repo_id, SCENES[source.scene].fps, features(source), root=root, robot_type=LatentSafeFrankaMujoco.name,
        streaming_encoding=True, encoder_threads=1, metadata_buffer_size=EPISODES_A_PART,
        rgb_encoder=RGBEncoderConfig(vcodec="h264", preset="veryfast", crf=20),
    )  # fmt: skip
    robot = LatentSafeFrankaMujoco(LatentSafeFrankaMujocoConfig(scene=source.scene, variant=source.variant))
    with robot:
        for episode in episodes:
            for frame in episode_frames(robot, source, episode, seed):
                dataset.add_frame(frame)
            dataset.save_episode()
            yield
    dataset.finalize()


def episode_frames(robot: LatentSafeFrankaMujoco, source: Source, episode: int, seed: int) -> Iterator[dict]:
    """The frames of an episode as `LeRobotDataset.add_frame` takes them; the first failing frame and all after fail."""
    scene, pushes, failed = robot.scene, _begin(robot, source, episode, _scene_seed(seed, source, episode)), False
    told = LOCATION if source.told else {}
    with _operator(robot, source, episode) as operator:
        for step in _steps(PushedRobot(robot, pushes), operator):
            failed |= bool(step.before["failure"])
            yield {
                "observation.images.front": step.seen["front"],
                "observation.images.wrist": step.seen["wrist"],
                "observation.state": np.array([step.seen[name] for name in STATE_NAMES], np.float32),
                **{key: np.array([step.seen[name] for name in of["names"]], np.float32) for key, of in told.items()},
                "action": step.action.astype(np.float32),
                "failure": np.array([FAILING if failed else SAFE]),
                "next.reward": np.array([step.info["reward"]], np.float32),
                "next.success": np.array([step.info["is_success"] and not failed]),
                # Nothing ends by itself: an episode lasts its time, and its last state could go on.
                "next.done": np.array([False]),
                "task": scene.task,
            }


def episode_truths(robot: LatentSafeFrankaMujoco, source: Source, episode: int, seed: int) -> Iterator[dict]:
    """What the scene knows at each frame of an episode, played again without pictures: more than was recorded.

    Raises:
        ValueError: it was recorded of policies, which need pictures.
    """
    if source.policies:
        raise ValueError(
            f"{', '.join(source.mix)} are policies, which look at pictures; only operators are played again"
        )
    pushes = _begin(robot, source, episode, _scene_seed(seed, source, episode))
    with _operator(robot, source, episode) as operator:
        for step in _steps(UnseenRobot(robot, pushes), operator):
            yield step.before


def _begin(robot: LatentSafeFrankaMujoco, source: Source, episode: int, scene_seed: int) -> np.ndarray:
    """Bring the robot where the episode starts. Returns the pushes (T, 7) of the T steps that it has."""
    if source.varied:
        robot.change_scene(BagScene(varied(np.random.default_rng([10, scene_seed])), image_size=robot.image_size))
    robot.reset(scene_seed)
    info, scene = SCENES[source.scene], robot.scene
    n_frames = round((source.seconds or info.episode_seconds) * info.fps)
    if source.branches:
        n_frames -= _grasp(robot, scene_seed, source)
    rng = np.random.default_rng([8, scene_seed])
    if source.behavior(episode) == "regrasp":
        _grasp(robot, scene_seed, source)
        _go(robot, lower(scene, rng))
    elif rng.random() < source.astray:
        _go(robot, stray(scene, GRASPED[source.behavior(episode)], rng))
    return _pushes(source.pushed / info.fps, n_frames, rng)


@contextmanager
def _operator(
    robot: LatentSafeFrankaMujoco, source: Source, episode: int
) -> Iterator[Callable[[dict], dict[str, float]]]:
    """Who moves the robot in an episode: observation -> action, clipped into its limits."""
    behavior = source.behavior(episode)
    if source.policies:
        operator = _policy_operator(behavior, robot.scene.fps, source.style, source.shield)
        operator.begin(robot.scene.seed)
        yield operator.act
        return
    speed = None
    if source.speeds is not None:
        speed = float(np.random.default_rng([11, robot.scene.seed]).uniform(*source.speeds))
    with LatentSafeScripted(LatentSafeScriptedConfig(behavior=behavior, speed=speed, seed=episode)) as scripted:
        if source.style is None:
            yield lambda seen: scripted.get_action()
            return
        rng = np.random.default_rng([9, robot.scene.seed])
        interventions = Interventions(source.style, action_limits(robot.scene.fps), rng)
        yield lambda seen: _intervened(scripted.get_action(), interventions)


def _intervened(action: dict[str, float], interventions: Interventions) -> dict[str, float]:
    executed, _ = interventions(np.array([action[name] for name in ACTION_NAMES]))
    return dict(zip(ACTION_NAMES, executed.tolist()))


@cache
def _policy_operator(path: str, fps: int, style: InterventionStyle, shield: str | None) -> PolicyOperator:
    return PolicyOperator(path, fps, style, shield)


def _pushes(sd: float, n: int, rng: np.random.Generator) -> np.ndarray:
    """Actions (n, 7) that are added to an operator's, each for 3 to 10 steps: moves half of the time, fingers less."""
    moves = rng.normal(0, sd, (n, 6)) * [1, 1, 0.5, 0, 0, 4] * rng.integers(2, size=(n, 1))
    closes = (rng.random(n) < 0.15) & (sd > 0)
    return np.repeat(np.column_stack([moves, np.where(closes, -1.0, 0.0)]), rng.integers(3, 11, n), axis=0)[:n]


class PushedRobot:
    """A robot as a world of one episode, whose hand is pushed while it acts; `info` is its scene's truth.

    Args:
        pushes: what is added to the action of each step (T, 7), unless that closes the fingers.
    """

    def __init__(self, robot: LatentSafeFrankaMujoco, pushes: np.ndarray):
        self.robot, self.pushes, self.t = robot, pushes, 0
        self.info = robot.scene.truth()

    @property
    def over(self) -> np.ndarray:
        """Whether the last step is done: bool (1,)."""
        return np.array([self.t >= len(self.pushes)])

    def observe(self) -> dict:
        """An observation of a LeRobot robot."""
        return {**self.robot.get_observation(), **self.robot.scene.location()}

    def step(self, action: np.ndarray) -> None:
        """Act (7,), within limits."""
        scene, pushed = self.robot.scene, action + self.pushes[self.t] * (action[6] > 0.5)
        if scene.controller.position[2] < HIGH:  # fingers that have closed on something are to stay closed
            pushed[6] = action[6]
        self.robot.send_action(dict(zip(ACTION_NAMES, np.clip(pushed, *action_limits(scene.fps)).tolist())))
        self.info, self.t = scene.truth(), self.t + 1


class UnseenRobot(PushedRobot):
    """The same without pictures, for operators who do not look at them."""

    def observe(self) -> dict:
        """Nothing."""
        return {}


def _steps(world: PushedRobot, operator: Callable[[dict], dict[str, float]]) -> Iterator[Step]:
    return steps(world, lambda seen: Choice(read_action(operator(seen), world.robot.scene.fps).delta))


def _scene_seed(seed: int, source: Source, episode: int) -> int:
    """Branches share their start."""
    return 1_000_000 * seed + (episode // source.branches if source.branches else episode)


def _grasp(robot: LatentSafeFrankaMujoco, seed: int, source: Source) -> int:
    """Close the fingers on the bag, unrecorded. Returns the steps taken."""
    rng = np.random.default_rng([7, seed])
    segment = rng.choice(len(source.grasps), p=source.grasps)
    bag: BagScene = robot.scene
    return _go(robot, grasp(bag, int(segment), rng, clumsiness=source.clumsiness))


def _go(robot: LatentSafeFrankaMujoco, actions: Iterator[np.ndarray]) -> int:
    """Act, unrecorded. Returns the steps taken."""
    steps = 0
    for steps, action in enumerate(actions, 1):  # noqa: B007
        robot.send_action(dict(zip(ACTION_NAMES, action.tolist())))
    return steps
