"""The verbs `record` and `teleoperate`: LeRobot's own, with a shield. What is stored is what was executed."""

from dataclasses import dataclass, fields, replace
from pathlib import Path

from lerobot.processor import RobotActionProcessorStep, RobotProcessorPipeline
from lerobot.processor.converters import (
    robot_action_observation_to_transition,
    transition_to_robot_action,
)
from lerobot.robots.config import RobotConfig
from lerobot.scripts.lerobot_record import RecordConfig, record
from lerobot.scripts.lerobot_teleoperate import TeleoperateConfig, teleoperate
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_latentsafe.datasets.decisions import FILE
from lerobot_latentsafe.robots.shielded.config_shielded import LatentSafeShieldedConfig
from lerobot_latentsafe.robots.shielded.shielded import connected_shield


@dataclass
class ShieldStep(RobotActionProcessorStep):
    """The operator's action is executed here already, for what this step returns is what LeRobot stores."""

    def action(self, action: dict[str, float]) -> dict[str, float]:
        return connected_shield().send_early(action)

    def transform_features(self, features: dict) -> dict:
        return features


@dataclass
class Record(RecordConfig):
    """lerobot-record with any robot behind a filter; all its options, and --filter.

    The dataset's actions are the executed ones. What was proposed, V, l, and why the filter intervened is written to
    shield/decisions.parquet in the dataset's folder, frame by frame; `latentsafe merge-decisions` makes columns of it.
    """

    filter: str | None = None
    """A trained filter: a folder, a Hub id or the name of a committed one."""

    def run(self) -> None:
        dataset = self.dataset
        if dataset.root is None and not self.resume:
            dataset.stamp_repo_id()
            dataset.no_stamp = True
        journal = Path(dataset.root or HF_LEROBOT_HOME / dataset.repo_id) / FILE
        config = _lerobots(self, RecordConfig)
        config.robot = _shielded(self.robot, self.filter, fps=dataset.fps, journal=journal)
        step = RobotProcessorPipeline(
            [ShieldStep()],
            to_transition=robot_action_observation_to_transition,
            to_output=transition_to_robot_action,
        )
        record(config, teleop_action_processor=step)
        print(f"the actions are what was executed; what was proposed is in {journal}")


@dataclass
class Teleoperate(TeleoperateConfig):
    """lerobot-teleoperate with any robot behind a filter; all its options, and --filter."""

    filter: str | None = None
    """A trained filter: a folder, a Hub id or the name of a committed one."""

    def run(self) -> None:
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
