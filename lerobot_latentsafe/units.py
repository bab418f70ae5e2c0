"""Units and ranges: what a dataset tells a filter of its robot, and how numbers go in and out of the models.

Robot units at the border; inside, actions in [-1, 1] by the dataset's range and states in standard deviations.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

STAGES = ("untrained", "world_model", "critic")
CONSTANT_BAND = 0.05
"""Relative half-width of the range of a command that never varies in the data."""
RANGE_SLACK = 0.25
"""Share of the range trained on by which another dataset's actions may exceed it."""


@dataclass
class TrainedOn:
    """What the weights were trained on, and how far; filled in by the training commands, in robot units.

    Attributes:
        stage: how far training has come: untrained, world_model, critic.
        target: what the critic was trained for: `reachability` (Eq. 5) or `risk` (SQRL).
        task: what the world model was trained to imagine, in words, where a policy of the same task must share it.
        cameras: the image features the filter reads, by default all of the dataset's.
        robot_type: LeRobot's name of the robot that recorded the dataset.
        fps: frames a second.
        state_names, action_names: of the numbers of `observation.state` and `action`, in order.
        action_low, action_high: least and largest command of the data.
        action_varies: False for commands that the data never vary; the filter keeps those and knows nothing else of
            them.
        state_mean, state_std: of the data.
    """

    stage: str = "untrained"
    target: str = "reachability"
    task: str | None = None
    cameras: list[str] | None = None
    robot_type: str | None = None
    fps: int | None = None
    state_names: list[str] | None = None
    action_names: list[str] | None = None
    action_low: list[float] | None = None
    action_high: list[float] | None = None
    action_varies: list[bool] | None = None
    state_mean: list[float] | None = None
    state_std: list[float] | None = None

    def __post_init__(self) -> None:
        if self.stage not in STAGES:
            raise ValueError(f"stage is {self.stage!r}; expected one of {', '.join(STAGES)}")

    def has_reached(self, stage: str) -> bool:
        """Whether training has come at least this far."""
        return STAGES.index(self.stage) >= STAGES.index(stage)

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Command -> least and largest value in the data; empty before training."""
        return dict(zip(self.action_names or [], zip(self.action_low or [], self.action_high or [])))


class Units(nn.Module):
    """Numbers of a robot to numbers of the models, and back.

    Args:
        trained_on: names, ranges, means and deviations.
        frozen_commands: commands that a fallback never changes, such as `gripper.pos`.
    """

    action_low: Tensor
    action_high: Tensor
    action_varies: Tensor
    state_mean: Tensor
    state_std: Tensor
    frozen: Tensor

    def __init__(self, trained_on: TrainedOn, frozen_commands: list[str]):
        super().__init__()
        self.action_names, self.state_names = trained_on.action_names or [], trained_on.state_names or []
        for name in ("action_low", "action_high", "state_mean", "state_std"):
            number = torch.tensor(getattr(trained_on, name), dtype=torch.float32)
            self.register_buffer(name, number, persistent=False)
        self.register_buffer("action_varies", torch.tensor(trained_on.action_varies), persistent=False)
        frozen = torch.tensor([name in frozen_commands for name in self.action_names])
        self.register_buffer("frozen", frozen, persistent=False)

    @property
    def device(self) -> torch.device:
        """Where the numbers lie."""
        return self.action_low.device

    def normalise_action(self, action: Tensor) -> Tensor:
        """Robot units -> [-1, 1] by the dataset's range: (..., A)."""
        return 2 * (action - self.action_low) / (self.action_high - self.action_low) - 1

    def denormalise_action(self, action: Tensor) -> Tensor:
        """[-1, 1] -> robot units: (..., A)."""
        return self.action_low + (action + 1) / 2 * (self.action_high - self.action_low)

    def normalise_state(self, state: Tensor) -> Tensor:
        """Robot units -> standard deviations from the mean: (..., S)."""
        return (state.float() - self.state_mean) / self.state_std

    def first_action(self, action: Tensor) -> Tensor:
        """What counts as having led to the first frame of an episode: no motion, frozen commands as in `action`."""
        return torch.where(self.frozen, action, 0.0)

    def hold_action(self, batch_size: int) -> Tensor:
        """What to do when nothing can be known: zero motion, or the nearest the range allows: (B, A) in robot units."""
        middle = (self.action_low + self.action_high) / 2
        still = torch.zeros_like(middle).clamp(self.action_low, self.action_high)
        return torch.where(self.action_varies, still, middle).repeat(batch_size, 1)

    def commands_seen(self, state: Tensor) -> Tensor:
        """What a normalised state (B, S) tells of commands of the same name, such as `gripper.pos`.

        Returns:
            (B, A) in robot units, in range; NaN for commands that the state does not tell.
        """
        seen = state.new_full((len(state), len(self.action_low)), torch.nan)
        for i, name in enumerate(self.action_names):
            if name in self.state_names:
                j = self.state_names.index(name)
                seen[:, i] = state[:, j] * self.state_std[j] + self.state_mean[j]
        return seen.clamp(self.action_low, self.action_high)


def adopt_dataset(known: TrainedOn, meta: Any, stats: dict) -> TrainedOn:
    """What is known with what a dataset tells beyond it.

    Args:
        known: what a filter was trained on, or nothing yet.
        meta: LeRobotDatasetMetadata, or what has its repo_id, robot_type, fps and features.
        stats: its statistics: feature -> min, max, mean, std.

    Raises:
        ValueError: the dataset is of another robot or rate, its actions never change, or leave the range trained on.
    """
    action, state = meta.features["action"], meta.features["observation.state"]
    found: dict[str, Any] = {
        "fps": int(meta.fps),
        "action_names": list(action["names"] or []),
        "state_names": list(state["names"] or []),
    }
    for name, value in found.items():
        trained = getattr(known, name)
        if trained is not None and trained != value:
            raise ValueError(
                f"{meta.repo_id} has {name} = {value}, this filter was trained with {trained}; "
                "train a new filter or use a dataset recorded with the same robot and rate"
            )
    adopted = replace(known, **found, robot_type=known.robot_type or meta.robot_type)
    low, high = _list(stats["action"]["min"]), _list(stats["action"]["max"])
    if known.action_low is None:
        state_std = [max(s, 1e-3) for s in _list(stats["observation.state"]["std"])]
        state_mean = _list(stats["observation.state"]["mean"])
        adopted = replace(_with_ranges(adopted, meta.repo_id, low, high), state_mean=state_mean, state_std=state_std)
    _check_range(adopted, meta.repo_id, low, high)
    return adopted


def _with_ranges(trained_on: TrainedOn, repo_id: str, low: list[float], high: list[float]) -> TrainedOn:
    """With ranges of commands; one that never varies gets a band around it, so that float noise is not out of range."""
    varies = [h - l > 1e-6 for l, h in zip(low, high)]
    if not any(varies):
        raise ValueError(f"the actions of {repo_id} never change: {low}; record episodes that move")
    band = [0.0 if v else CONSTANT_BAND * max(abs(l), 1.0) for v, l in zip(varies, low)]
    return replace(
        trained_on,
        action_varies=varies,
        action_low=[l - b for l, b in zip(low, band)],
        action_high=[h + b for h, b in zip(high, band)],
    )


def _check_range(trained_on: TrainedOn, repo_id: str, low: list[float], high: list[float]) -> None:
    """Refuse actions far outside of the range that the filter was trained on: they would be clipped, unseen."""
    for (name, (trained_low, trained_high)), l, h in zip(trained_on.ranges.items(), low, high):
        slack = RANGE_SLACK * (trained_high - trained_low)
        if l < trained_low - slack or h > trained_high + slack:
            raise ValueError(
                f"{name} of {repo_id} reaches from {l:g} to {h:g}, this filter was trained on {trained_low:g} to "
                f"{trained_high:g}: another unit, or another robot? Convert the actions, or train a new filter"
            )


def check_candidates(candidates: list[list[float]] | None, trained_on: TrainedOn, repo_id: str) -> None:
    """Refuse a discrete action set (K, A) that leaves the range of a dataset.

    Raises:
        ValueError: naming the candidate and the range.
    """
    for candidate in candidates or []:
        bounds = list(zip(trained_on.action_low, candidate, trained_on.action_high))
        inside = all(low - 1e-4 <= a <= high + 1e-4 for low, a, high in bounds)
        if len(candidate) != len(trained_on.action_low) or not inside:
            raise ValueError(
                f"action candidate {candidate} is outside of what {repo_id} covers: "
                f"{trained_on.action_low} to {trained_on.action_high}"
            )


def _list(values) -> list[float]:
    return [float(v) for v in torch.as_tensor(values).flatten()]
