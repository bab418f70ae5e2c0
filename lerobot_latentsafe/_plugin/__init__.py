"""Installed as `lerobot_policy_latentsafe`, the module name LeRobot imports for this distribution."""

import lerobot_latentsafe  # noqa: F401  (registers everything)
