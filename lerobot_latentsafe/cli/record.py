"""Verbs that record: simulated tasks in bulk, LeRobot's own loops under a filter, and what the filter decided."""

from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path

from lerobot.robots.config import RobotConfig
from lerobot.scripts.lerobot_record import RecordConfig, record
from lerobot.scripts.lerobot_teleoperate import TeleoperateConfig, teleoperate
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_latentsafe.cli.options import DatasetSource, NewDataset
from lerobot_latentsafe.collection import dubins, franka, so101
from lerobot_latentsafe.collection.quiet import quiet_recording
from lerobot_latentsafe.collection.sent_actions import storing_what_was_sent
from lerobot_latentsafe.datasets.columns import write_decisions
from lerobot_latentsafe.datasets.decisions import FILE
from lerobot_latentsafe.robots.shielded.config_shielded import LatentSafeShieldedConfig
from lerobot_latentsafe.robots.shielded.shielded import connected_shield
from lerobot_latentsafe.runtime.options import require_at_least
from lerobot_latentsafe.runtime.tasks import Tasks


@dataclass
class Collect:
    """Record labelled episodes of a simulated task as a LeRobotDataset, without a person.

    latentsafe collect --source=random --dataset.repo_id=me/car --dataset.root=data/car

    Sources of the Dubins car:

    - random: the paper's 2,000 trajectories of three actions
    - random_continuous: the same with actions from the whole range
    - random_left_only: without the turn to the right (the ablation)
    - random_located: the first, with the position in observation.environment_state, for train-reachability --alike
    - careful, reckless: drives to the goal, around the obstacle or through it, for diffusion policies

    Sources of the Franka:

    - bag_mix: the paper's 1,300 trajectories
    - bag_branches: several trajectories from each grasped state
    - bag_climbs: up in steps and pauses, as under a filter
    - bag_lifts: one and the same lift by either end
    - bag_between: branches and climbs, grasped between ends and middle
    - bag_dither, bag_clumsy: grasped badly and lifted by unsteady fingers, as by a policy that errs
    - bag_policies: the committed diffusion policies act, and are interrupted now and then
    - bag_shielded: the same policies, interrupted by a slow way down where the committed filter would override them
    - bag_retreats: whole lifts by either end and the middle, lowered slowly or stopped now and then
    - bag_pulls: the same lifts, undisturbed
    - bag_swings: held by its closed end and swung, most of them too slowly to spill
    - bag_varied, bag_varied_pulls: lifts of bags that are stiffer or softer, heavier or lighter, rougher or smoother
    - bag_middle, bag_strong, bag_weak, bag_mixed: demonstrations; in the last three the hand is pushed aside at times,
      and bag_mixed says where the bag is
    - blocks_demos, blocks_random: the blocks

    Sources of the SO-101, which pushes a cube to a mark near the table's edge:

    - so101_careful, so101_reckless: demonstrations, to the mark, or 5.5 cm past it
    - so101_mix: both, undisturbed and held now and then, with pushes by fits and starts and random motion

    If a recording was killed, start it again: it goes on. With --tasks.number=N the episodes are shared among N tasks;
    see docs/scaling.md.
    """

    source: str
    """What to record; see above."""
    dataset: NewDataset
    seed: int = 0
    """At one seed all sources start from the same scenes: where variety counts, give each its own."""
    workers: int = 1
    """Processes that record."""
    policy: str | None = None
    """Who acts in bag_policies and bag_shielded instead of the committed policies: a folder or a Hub id. Recordings of
    the policy that a filter is to shield teach it where that one fails, and where it need not be interrupted."""
    tasks: Tasks = field(default_factory=Tasks)

    def __post_init__(self) -> None:
        require_at_least("--seed", self.seed, 0)
        require_at_least("--workers", self.workers, 1)
        if self.policy is not None:
            franka.require_policies(self.source)

    def run(self) -> None:
        """Record, and say how much."""
        if self.source in franka.SOURCES:
            collect = partial(franka.collect_franka, workers=self.workers, policy=self.policy)
        elif self.source in dubins.SOURCES:
            collect = dubins.collect_dubins
        elif self.source in so101.SOURCES:
            collect = so101.collect_so101
        else:
            known = ", ".join([*dubins.SOURCES, *franka.SOURCES, *so101.SOURCES])
            raise ValueError(f"--source is {self.source!r}; expected one of {known}")
        new = self.dataset
        quiet_recording()
        dataset = collect(self.source, new.repo_id, new.folder, new.num_episodes, self.seed, tasks=self.tasks)
        if dataset is None:
            return print(f"submitted: the last task writes {new.folder}; logs are in {new.folder}.tasks")
        print(f"{dataset.num_episodes} episodes, {dataset.num_frames} frames in {new.folder}")


@dataclass
class Record(RecordConfig):
    """Record any robot behind a filter, as lerobot-record does: the dataset's actions are the executed ones.

    latentsafe record --filter=bag --robot.type=latentsafe_franka_mujoco --robot.scene=bag \\
      --teleop.type=latentsafe_scripted --teleop.behavior=closed_end --dataset.repo_id=me/shielded \\
      --dataset.root=data/shielded --dataset.single_task="lift the bag" --dataset.fps=15 \\
      --dataset.num_episodes=2 --dataset.push_to_hub=false

    What was proposed, V, l, and why the filter intervened is written to shield/decisions.parquet in the dataset's
    folder, frame by frame; `latentsafe merge-decisions` makes columns of it. It has all options of lerobot-record, and
    --filter.

    Each episode is on disk, and can be read, before the next one begins. A recording that was killed goes on with
    --resume=true; the episode that was being recorded then is left out.
    """

    filter: str | None = None
    """A trained filter: a folder, a Hub id or the name of a committed one."""

    def run(self) -> None:
        """LeRobot's recording with the filter around the robot."""
        dataset = self.dataset
        if dataset.root is None and not self.resume:
            dataset.stamp_repo_id()
            dataset.no_stamp = True
        if dataset.video_encoding_batch_size > 1:
            raise ValueError(
                f"--dataset.video_encoding_batch_size is {dataset.video_encoding_batch_size}; expected 1, for an "
                "episode is saved with its videos. --dataset.streaming_encoding=true encodes them while the robot moves"
            )
        root = Path(dataset.root or HF_LEROBOT_HOME / dataset.repo_id)
        dataset.root = str(root)
        config = _lerobots(self, RecordConfig)
        config.robot = _shielded(self.robot, self.filter, fps=dataset.fps)
        with storing_what_was_sent(root, self.resume, lambda: connected_shield().take_sent()) as config.resume:
            record(config)
        print(f"the actions are what was executed; what was proposed is in {root / FILE}")


@dataclass
class Teleoperate(TeleoperateConfig):
    """Drive any robot behind a filter, as lerobot-teleoperate does.

    latentsafe teleoperate --filter=bag --robot.type=latentsafe_franka_mujoco --robot.scene=bag \\
      --teleop.type=latentsafe_scripted --teleop.behavior=closed_end --fps=15 --teleop_time_s=6

    It has all options of lerobot-teleoperate, and --filter.
    """

    filter: str | None = None
    """A trained filter: a folder, a Hub id or the name of a committed one."""

    def run(self) -> None:
        """LeRobot's teleoperation with the filter around the robot."""
        config = _lerobots(self, TeleoperateConfig)
        config.robot = _shielded(self.robot, self.filter, fps=self.fps)
        teleoperate(config)


def _lerobots(command: RecordConfig | TeleoperateConfig, config_class: type) -> RecordConfig | TeleoperateConfig:
    """LeRobot's own configuration in one of our commands."""
    return config_class(**{f.name: getattr(command, f.name) for f in fields(config_class)})


def _shielded(robot: RobotConfig, filter: str | None, **options) -> LatentSafeShieldedConfig:
    """The robot of a command with the filter of that command around it.

    Raises:
        ValueError: no filter, or two.
    """
    if isinstance(robot, LatentSafeShieldedConfig):
        if filter:
            raise ValueError("--filter and --robot.type=latentsafe_shielded both name a filter; give one of them")
        return replace(robot, **options)
    if not filter:
        raise ValueError("which filter? Give --filter=<folder, Hub id or committed name>")
    return LatentSafeShieldedConfig(inner=robot, filter=filter, **options)


@dataclass
class MergeDecisions:
    """Copy a recording of `latentsafe record` with what the shield decided as columns `shield.*`, for LeRobot alone.

    latentsafe merge-decisions --dataset.repo_id=me/shielded --dataset.root=data/shielded \\
      --new_repo_id=me/decisions --output_dir=data/decisions

    With --dataset.episodes=[0,1] the copy holds these episodes alone, renumbered.
    """

    output_dir: Path
    """The folder to write."""
    new_repo_id: str
    """The id of the copy."""
    dataset: DatasetSource = field(default_factory=DatasetSource)

    def run(self) -> None:
        """Write the copy."""
        episodes = self.dataset.episodes
        written = write_decisions(self.dataset.opened(), self.output_dir, self.new_repo_id, episodes)
        print(f"{written.num_frames} frames with the shield's decisions in {self.output_dir}")
