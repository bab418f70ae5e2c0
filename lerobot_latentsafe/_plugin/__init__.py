"""Installed as `lerobot_policy_latentsafe`, the module name LeRobot imports for this distribution."""

from lerobot_latentsafe import *  # noqa: F403
