"""A policy as the operator of a recording: what a filter is to judge is best seen while that acts."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES, OBS_STATE, OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.collection.interventions import Interventions, InterventionStyle
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.franka.actions import ACTION_NAMES, STATE_NAMES, action_limits
from lerobot_latentsafe.franka.bag import LOCATION_NAMES
from lerobot_latentsafe.franka.scene import CAMERAS
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.modeling_latentsafe import load_filter

LOCATION = {OBS_ENV_STATE: {"dtype": "float32", "shape": (len(LOCATION_NAMES),), "names": LOCATION_NAMES}}
"""Where the bag is, for policies that are told instead of looking."""
OBSERVED = {
    OBS_STATE: {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": STATE_NAMES},
    **{f"{OBS_IMAGES}.{name}": {"dtype": "image"} for name in CAMERAS},
}
"""What a policy is given of an observation."""


@torch.no_grad()
def check_policy(path: str, fps: int, image_size: int) -> None:
    """Refuse, before anything is recorded, a policy that cannot act here: it is asked about a black frame.

    Args:
        fps, image_size: of the robot, and of its square pictures.

    Raises:
        CheckpointError: there is none at this path; see `BasePolicy.load`.
        ValueError: it is a filter, acts at another rate or in another action space, or fails.
    """
    policy = BasePolicy.load(path)
    if policy.origin.fps not in (None, fps):
        raise ValueError(f"policy {path} acts at {policy.origin.fps} fps, the simulated robot at {fps}")
    black = np.zeros((image_size, image_size, 3), np.uint8)
    seen = {**dict.fromkeys([*STATE_NAMES, *LOCATION_NAMES], 0.0), **dict.fromkeys(CAMERAS, black)}
    try:
        policy.reset()
        action = policy.propose(_batch(seen))
    except Exception as e:
        raise ValueError(
            f"policy {path} cannot act on what the simulated Franka shows, which is {', '.join(OBSERVED)} "
            f"({type(e).__name__}: {e}). Give one that was trained on its recordings"
        ) from e
    if action.shape != (1, len(ACTION_NAMES)):
        raise ValueError(f"policy {path} gives {action.shape[-1]} commands, expected {', '.join(ACTION_NAMES)}")


def _batch(seen: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """An observation of a LeRobot robot as policies take it."""
    features = {**OBSERVED, **LOCATION} if {*LOCATION_NAMES} <= {*seen} else OBSERVED
    return prepare_observation_for_inference(build_dataset_frame(features, seen, OBS_STR), torch.device("cpu"))


class PolicyOperator:
    """Acts as a policy does in which somebody intervenes: what it does next it does in no other recording.

    Either when a filter would override it; or, for want of one that is any good yet, now and then.

    Args:
        path: of the policy; folder, Hub id or committed name.
        fps: of the robot.
        style: what an intervention is like.
        shield: path of a filter that says when to intervene.
    """

    def __init__(self, path: str, fps: int, style: InterventionStyle, shield: str | None = None):
        self.limits, self.style, self.filter = action_limits(fps), style, None
        if shield is None:
            self.policy = BasePolicy.load(path)
            return
        self.filter = load_filter(shield, law=LawOptions(mode="monitor"), base_policy=path)
        self.filter.shield.clock = standing_still  # the simulation waits for its operator
        self.policy = self.filter.base

    def begin(self, seed: int) -> None:
        """Start an episode; what follows depends on the seed and on what is seen."""
        torch.manual_seed(seed)
        (self.filter or self.policy).reset()
        self.interventions = Interventions(self.style, self.limits, np.random.default_rng([9, seed]))

    @torch.no_grad()
    def act(self, seen: Mapping[str, Any]) -> dict[str, float]:
        """The action for an observation of a LeRobot robot, clipped into its limits."""
        batch = _batch(seen)
        if self.filter is None:
            proposed, unsafe = self.policy.propose(batch), None
        else:
            decision = self.filter.decide(batch)
            proposed, unsafe = decision.proposed, bool(decision.unsafe)
        wanted = np.clip(proposed[0].double().numpy(), *self.limits)
        action, intervened = self.interventions(wanted, unsafe)
        executed = torch.from_numpy(action).float()[None]
        if intervened:
            self.policy.replan(executed)
        if self.filter is not None:
            self.filter.shield.was_executed(executed)
        return dict(zip(ACTION_NAMES, action.tolist()))
