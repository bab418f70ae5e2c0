"""What a filter takes over from the dataset that it is trained on, and checks against every later one."""

import logging
from dataclasses import replace
from typing import Any

import numpy as np

from lerobot_latentsafe.datasets.contract import ACTION, STATE, Contract, DatasetContractError
from lerobot_latentsafe.limits import AT_REST
from lerobot_latentsafe.looks import Response, by_tick
from lerobot_latentsafe.meanings import Command, contradictions, settle, tell_meanings
from lerobot_latentsafe.units import TrainedOn

logger = logging.getLogger(__name__)

CONSTANT_BAND = 0.05
"""Relative half-width of the range of a command that never varies in the data."""
RANGE_SLACK = 0.25
"""Share of the range trained on by which another dataset's actions may exceed it."""
SCALE_PERCENTILE = 99
"""Of the size of displacements: what is 1 inside. A single jerk of the operator must not make all else inaudible."""
SMALL = 0.05
"""Share of a command's range by which it may always change from tick to tick: that is no jump."""
RARE, ABSURD = 1e-3, 10.0
"""Of the rarest such share of frames, what lies beyond all others by over so many times their range is a glitch."""


def adopt_dataset(known: TrainedOn, contract: Contract) -> TrainedOn:
    """What is known with what a dataset tells beyond it.

    Args:
        known: what a filter was trained on, or nothing yet.

    Raises:
        MeaningError: what a command means cannot be told, or is not what the filter was trained on.
        ValueError: the dataset is of another robot or rate, its actions never change, or leave the range trained on.
    """
    found: dict[str, Any] = {
        "fps": contract.fps, "action_names": contract.action_names, "state_names": contract.state_names
    }  # fmt: skip
    for name, value in found.items():
        trained = getattr(known, name)
        if trained is not None and trained != value:
            raise ValueError(
                f"{contract.repo_id} has {name} = {value}, this filter was trained with {trained}; "
                "train a new filter or use a dataset recorded with the same robot and rate"
            )
    adopted = replace(known, **found, robot_type=known.robot_type or contract.robot_type)
    if known.action_low is None:
        adopted = _first_dataset(adopted, contract)
    elif known.meanings is not None:
        _check_meanings(known, contract)
    _check_range(adopted, contract)
    return adopted


def told_by(contract: Contract) -> list[Command]:
    """Each command of a dataset and what it means, as far as names and data tell."""
    return tell_meanings(contract.state_names, contract.action_names, contract.state, contract.action, contract.episode)


def meanings_of(contract: Contract, by_hand: dict[str, str] | None = None) -> list[Command]:
    """Each command of a dataset and what it means.

    Args:
        by_hand: command -> meaning, of those that names and data do not tell, or tell wrongly.

    Raises:
        MeaningError: one cannot be told.
    """
    return settle(told_by(contract), by_hand, contract.state_names, contract.repo_id)


def _first_dataset(trained_on: TrainedOn, contract: Contract) -> TrainedOn:
    """With what all later datasets must agree with: meanings, ranges, means and deviations."""
    commands = meanings_of(contract, trained_on.meanings)
    for command in commands:
        logger.info("%s is a %s", command.name, command.described)
    logger.info("if that is wrong, say what they are with --policy.trained_on.meanings")
    refuse_glitches(contract)
    state = contract.state
    adopted = replace(
        _with_ranges(trained_on, contract, commands),
        meanings={c.name: c.described for c in commands},
        state_mean=state.mean(0, dtype=np.float64).tolist(),
        state_std=state.std(0, dtype=np.float64).clip(min=1e-3).tolist(),
    )
    return with_limits(adopted, contract)


def with_limits(known: TrainedOn, contract: Contract) -> TrainedOn:
    """With how far, how fast and how suddenly states and commands go, where that is not known yet."""
    adds_up = np.array([c.meaning in ("delta", "velocity") for c in known.commands])
    state, rest = contract.state, _largest_step(contract)
    small = SMALL * (np.array(known.action_high) - np.array(known.action_low))
    limits: dict[str, np.ndarray] = {
        "state_low": state.min(0),
        "state_high": state.max(0),
        "state_step": rest,
        "action_step": np.maximum(_largest_change(contract, 1), small),
        "action_jerk": np.maximum(_largest_change(contract, 2), small),
    }
    if contract.state_names:
        limits["unanswered"] = _unanswered(contract, AT_REST * rest, adds_up)
    return replace(known, **{name: v.tolist() for name, v in limits.items() if getattr(known, name) is None})


def refuse_glitches(contract: Contract) -> None:
    """Refuse single numbers that are absurd beside all others: whatever lies between would count as in range.

    Raises:
        DatasetContractError: naming the number, its frame and the remedy.
    """
    features = {ACTION: (contract.action, contract.action_names), STATE: (contract.state, contract.state_names)}
    for key, (values, names) in features.items():
        rare = max(1, int(RARE * len(values)))
        ordered = np.sort(values.astype(np.float64), 0)
        low, high = ordered[rare : len(values) - rare][[0, -1]] if len(values) > 2 * rare else ordered[[0, -1]]
        far = np.maximum(values - high, low - values) > ABSURD * np.where(high > low, high - low, np.inf)
        for row, column in np.argwhere(far)[:1]:
            episode = contract.episode[row]
            frame = row - np.argmax(contract.episode == episode)
            raise DatasetContractError(
                f"{names[column]} of {key} is {values[row, column]:g} in frame {frame} of episode {episode} of "
                f"{contract.repo_id}, and from {low[column]:g} to {high[column]:g} in nearly all others: what lies "
                "between would count as in range. If it is a glitch, correct it, or leave it out: lerobot-edit-dataset "
                f"--operation.type=delete_episodes --operation.episode_indices='[{episode}]'"
            )


def _largest_change(contract: Contract, order: int) -> np.ndarray:
    """The largest difference, of first or second order, of each command from tick to tick: (A,)."""
    changes = np.abs(np.diff(contract.action, order, axis=0))[contract.episode[order:] == contract.episode[:-order]]
    return changes.max(0, initial=0.0)


def _unanswered(contract: Contract, rest: np.ndarray, adds_up: np.ndarray) -> np.ndarray:
    """How far each command goes at most while the state stays as it is: (A,); see `looks.Response`."""
    state, action = contract.state, contract.action
    response, most = Response(rest.astype(np.float32), adds_up), np.zeros(action.shape[1], np.float32)
    sent = np.full_like(action[:1], np.nan)
    for frames in by_tick(contract.episode):
        there = (frames >= 0)[:, None]
        sent = np.broadcast_to(sent, (len(frames), action.shape[1]))
        went = response.unanswered(np.where(there, state[frames], np.nan), sent)
        most = np.maximum(most, np.where(there, went, 0.0).max(0))
        sent = action[frames]
    return most


def _largest_step(contract: Contract) -> np.ndarray:
    """By how much each number of the state changes from frame to frame, but for a glitch in a thousand: (S,)."""
    steps = np.abs(np.diff(contract.state, axis=0))[contract.episode[1:] == contract.episode[:-1]]
    return np.percentile(steps, 99.9, axis=0) if len(steps) else np.full(contract.state.shape[1], np.inf)


def displacements(contract: Contract, commands: list[Command]) -> np.ndarray:
    """Targets minus present state (N, A); zero for commands that are no targets."""
    moves = np.zeros_like(contract.action)
    for i, command in enumerate(commands):
        if command.of_state is not None:
            moves[:, i] = contract.action[:, i] - contract.state[:, contract.state_names.index(command.of_state)]
    return moves


def _with_ranges(trained_on: TrainedOn, contract: Contract, commands: list[Command]) -> TrainedOn:
    """With ranges of commands; one that never varies gets a band around it, so that float noise is not out of range."""
    low, high = contract.action.min(0), contract.action.max(0)
    moves, is_target = displacements(contract, commands), np.array([c.meaning == "target" for c in commands])
    least, largest = moves.min(0).clip(max=0), moves.max(0).clip(min=0)
    scale = np.percentile(np.abs(moves), SCALE_PERCENTILE, axis=0)
    noise = 0.02 * scale.max(initial=0.0)  # a joint that never moves is not blown up
    varies = high - low > 1e-6
    if not varies.any():
        raise ValueError(f"the actions of {contract.repo_id} never change: {low.tolist()}; record episodes that move")
    band = np.where(varies, 0.0, CONSTANT_BAND * np.maximum(np.abs(low), 1.0))
    return replace(
        trained_on,
        action_varies=(varies | (is_target & (largest - least > 1e-6))).tolist(),
        action_low=(low - band).tolist(),
        action_high=(high + band).tolist(),
        displacement_low=np.where(is_target, np.minimum(least, -noise), 0.0).tolist(),
        displacement_high=np.where(is_target, np.maximum(largest, noise), 0.0).tolist(),
        displacement_scale=np.where(is_target, np.maximum(scale, max(noise, 1e-6)), 1.0).tolist(),
    )


def _check_meanings(trained_on: TrainedOn, contract: Contract) -> None:
    """Refuse a dataset whose commands mean something else than those trained on."""
    if wrong := contradictions(trained_on.commands, told_by(contract)):
        raise ValueError(
            f"{contract.repo_id} is of a robot that takes other commands: {'; '.join(wrong)}. Use a dataset of the "
            "same kind of commands, or train a new filter"
        )


def _check_range(trained_on: TrainedOn, contract: Contract) -> None:
    """Refuse actions far outside of the range that the filter was trained on: they would be clipped, unseen."""
    low, high = contract.action.min(0), contract.action.max(0)
    for (name, (trained_low, trained_high)), l, h in zip(trained_on.ranges.items(), low, high):
        slack = RANGE_SLACK * (trained_high - trained_low)
        if l < trained_low - slack or h > trained_high + slack:
            raise ValueError(
                f"{name} of {contract.repo_id} reaches from {l:g} to {h:g}, this filter was trained on "
                f"{trained_low:g} to {trained_high:g}: another unit, or another robot? Convert the actions, or train a "
                "new filter"
            )


def check_candidates(candidates: list[list[float]] | None, trained_on: TrainedOn, repo_id: str) -> None:
    """Refuse a discrete action set (K, A) that leaves the range of a dataset; of targets it holds displacements.

    Raises:
        ValueError: naming the candidate and the range.
    """
    ranges = list(trained_on.motion_ranges.values())
    for candidate in candidates or []:
        inside = all(low - 1e-4 <= a <= high + 1e-4 for (low, high), a in zip(ranges, candidate))
        if len(candidate) != len(ranges) or not inside:
            raise ValueError(
                f"action candidate {candidate} is outside of what {repo_id} covers: "
                f"{[low for low, _ in ranges]} to {[high for _, high in ranges]}"
            )
