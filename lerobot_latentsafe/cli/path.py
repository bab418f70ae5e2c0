"""The verb that tells where a committed checkpoint is, at once: commands of LeRobot's wait for it."""

from dataclasses import dataclass

from lerobot_latentsafe.runtime.locations import resolve_checkpoint


@dataclass
class PathOf:
    """Print the folder of a committed checkpoint, for LeRobot's commands.

    latentsafe path --name=bag

    So `lerobot-eval --policy.path=$(latentsafe path --name=bag) ...` evaluates it.
    """

    name: str = "dubins"
    """The checkpoint's name."""

    def run(self) -> None:
        """Print it."""
        print(resolve_checkpoint(self.name))
