"""Does a filter fit a robot? Asked before anything moves."""

from lerobot.robots.robot import Robot
from lerobot.utils.constants import OBS_IMAGES

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.pictures import check_proportions
from lerobot_latentsafe.units import TrainedOn


def check_fit(robot: Robot, filter: str, config: LatentSafeConfig, fps: int | None) -> None:
    """Refuse a filter of another robot, or of another rate.

    Args:
        filter: its name, for errors.
        fps: rate of the loop that drives the robot, if it is known.

    Raises:
        ValueError: with the remedy.
    """
    _check_cameras(robot, filter, config)
    _check_names(robot, filter, config.trained_on)
    if fps not in (None, config.trained_on.fps):
        raise ValueError(
            f"the loop is to run at {fps} Hz, but the filter {filter} decides {config.trained_on.fps} times a second: "
            f"give --fps={config.trained_on.fps} (--dataset.fps={config.trained_on.fps} to record)"
        )


def _check_cameras(robot: Robot, filter: str, config: LatentSafeConfig) -> None:
    """Refuse a robot without a camera that the filter looks through, or with pictures of other proportions."""
    cameras = [name for name, kind in robot.observation_features.items() if isinstance(kind, tuple)]
    wanted = [key.removeprefix(f"{OBS_IMAGES}.") for key in config.trained_on.cameras]
    missing = [name for name in wanted if name not in cameras]
    if missing:
        raise ValueError(
            f"{robot.name} has no camera {', '.join(missing)}; the filter {filter} sees {', '.join(wanted)}, the robot "
            f"has {', '.join(cameras) or 'none'}. Name its cameras alike, or train a filter for this robot"
        )
    for name in wanted:
        key, (height, width, channels) = f"{OBS_IMAGES}.{name}", robot.observation_features[name]
        check_proportions(key, (channels, height, width), config.input_features[key].shape)


def _check_names(robot: Robot, filter: str, trained_on: TrainedOn) -> None:
    """Refuse a robot that takes other commands than the filter gives, or does not observe what the filter reads."""
    if set(trained_on.action_names) != set(robot.action_features):
        raise ValueError(
            f"the filter {filter} acts in {', '.join(trained_on.action_names)}; {robot.name} in "
            f"{', '.join(robot.action_features)}. Train a filter on data of this robot"
        )
    scalars = [name for name, kind in robot.observation_features.items() if not isinstance(kind, tuple)]
    unread = [name for name in trained_on.state_names if name not in scalars]
    if unread:
        raise ValueError(
            f"{robot.name} does not observe {', '.join(unread)}, which the filter {filter} reads; it observes "
            f"{', '.join(scalars) or 'nothing'}. Train a filter on data of this robot"
        )
