"""What plugins of LeRobot bring, this one among them: a type that a file or an option names is looked for there."""

from functools import cache

from lerobot.utils.import_utils import register_third_party_plugins


@cache
def register_plugins() -> None:
    """Have LeRobot import all installed plugins, as its commands do before they read any option."""
    register_third_party_plugins()
