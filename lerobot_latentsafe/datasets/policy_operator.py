"""A policy as the operator of a recording: what a filter is to judge is best seen while that acts."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE, OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame

from lerobot_latentsafe.envs.franka import CAMERAS
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.robots.franka_interface import ACTION_NAMES, STATE_NAMES, action_limits
from lerobot_latentsafe.shield import BasePolicy

OBSERVED = {
    OBS_STATE: {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": STATE_NAMES},
    **{f"{OBS_IMAGES}.{name}": {"dtype": "image"} for name in CAMERAS},
}
"""What a policy is given of an observation."""
CLOSING = 0.5
"""Command of the fingers below which they are to hold something."""


class PolicyOperator:
    """Acts as a policy does that a filter overrides: what it does next it does in no other recording.

    Either by a filter; or, for want of one that is any good yet, now and then while the fingers close, by hold or by
    the way down.

    Args:
        path: of the policy; folder, Hub id or committed name.
        fps: of the robot.
        overridden: chance that an override begins at a step.
        shield: path of a filter that overrides instead.
    """

    def __init__(self, path: str, fps: int, overridden: float, shield: str | None = None):
        self.limits = action_limits(fps)
        if shield is None:
            self.policy, self.overridden = BasePolicy(path, "cpu"), overridden
            self.propose = self.policy.propose
        else:
            self.policy, self.overridden = LatentSafePolicy.from_pretrained(shield).eval(), 0.0
            self.policy.attach(path)
            self.propose = self.policy.select_action

    def begin(self, seed: int) -> None:
        """Start an episode; what follows depends on the seed and on what is seen."""
        torch.manual_seed(seed)
        self.policy.reset()
        self.rng, self.left, self.override = np.random.default_rng([9, seed]), 0, np.zeros(6)
        self.gripper = 1.0

    def act(self, seen: Mapping[str, Any]) -> dict[str, float]:
        """The action for an observation of a LeRobot robot, clipped into its limits."""
        batch = prepare_observation_for_inference(build_dataset_frame(OBSERVED, seen, OBS_STR), torch.device("cpu"))
        with torch.no_grad():
            action = np.clip(self.propose(batch)[0].double().numpy(), *self.limits)
        if self._interrupts():
            action = np.append(self.override, self.gripper)
            self.policy.replan(torch.from_numpy(action).float()[None])
        self.gripper = action[6]
        return dict(zip(ACTION_NAMES, action.tolist()))

    def _interrupts(self) -> bool:
        """Whether this step is an override's; one lasts 1 to 11 steps."""
        if self.left == 0 and self.gripper < CLOSING and self.rng.random() < self.overridden:
            self.left = int(self.rng.integers(2, 13))
            down = self.rng.random() < 0.6
            self.override = np.array([0, 0, down * self.rng.uniform(0.2, 1) * self.limits[0][2], 0, 0, 0])
        self.left = max(0, self.left - 1)
        return self.left > 0
