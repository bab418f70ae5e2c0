"""Installed as `lerobot_policy_latentsafe`, the module name LeRobot imports for this distribution."""

import lerobot_latentsafe.registration  # noqa: F401  (registers everything)
