"""What each command of a robot means: told by its name, by the data, or by the user.

A *target* is where a number of the state is to be: a joint angle, a gripper's width. A *delta* says by how much to
move, a *velocity* how fast. Anything else (a switch, a constant) is *other*. Standing still is zero for a delta and a
velocity; for a target it is the present state, so a filter must know which is which before anything moves.
"""

import re
from dataclasses import dataclass

import numpy as np

MEANINGS = ("target", "delta", "velocity", "other")
WORDS = {"delta": {"delta", "deltas", "displacement"}, "velocity": {"vel", "velocity", "vx", "vy", "vz", "vtheta"}}
"""Words in a command's name that settle its meaning."""
FOLLOWS = 0.5
"""A target's next state is nearer to it, on average, than this share of the target's standard deviation."""
CHANGES = 0.25
"""A delta's state changes by it: least share of the changes that it explains."""
NEAR = 0.1
"""Of a number that hardly moves: it is nearer to its target than this share of its size."""
PAIRS = 200_000
"""Pairs of frames that are looked at, at most."""


class MeaningError(ValueError):
    """What a command means cannot be told, or contradicts what is known."""


@dataclass(frozen=True)
class Command:
    """A command and what it means.

    Attributes:
        name: of the command.
        meaning: one of MEANINGS; None where neither name nor data tell.
        of_state: the number of the state that a target is of.
    """

    name: str
    meaning: str | None
    of_state: str | None = None

    @property
    def described(self) -> str:
        """As a configuration holds it: the meaning, and of a target of a number of another name also that name."""
        elsewhere = self.meaning == "target" and self.of_state != self.name
        return f"target {self.of_state}" if elsewhere else str(self.meaning)


def parse(name: str, described: str, state_names: list[str]) -> Command:
    """A command of a configuration.

    Raises:
        MeaningError: no such meaning, or a target of a number that the state does not have.
    """
    meaning, _, other = described.partition(" ")
    if meaning not in MEANINGS or (other and meaning != "target"):
        raise MeaningError(
            f"--policy.trained_on.meanings says that {name} is {described!r}; expected one of {', '.join(MEANINGS)}, "
            "or 'target <name of a number of the state>'"
        )
    of_state = (other or name) if meaning == "target" else None
    if of_state is not None and of_state not in state_names:
        raise MeaningError(
            f"--policy.trained_on.meanings says that {name} is a target of {of_state}, which the state does not have: "
            f"it has {', '.join(state_names) or 'no numbers'}. Write 'target <name>', or another meaning"
        )
    return Command(name, meaning, of_state)


def tell_meanings(
    state_names: list[str], action_names: list[str], state: np.ndarray, action: np.ndarray, episode: np.ndarray
) -> list[Command]:
    """What names and data tell of each command.

    Args:
        state, action, episode: (N, S), (N, A) and (N,) of all frames, in order.

    Returns:
        A command each; `meaning` is None where it cannot be told.
    """
    now = np.flatnonzero(episode[1:] == episode[:-1])
    now = now[np.linspace(0, len(now) - 1, min(len(now), PAIRS)).astype(int)] if len(now) else now
    before, after, sent = state[now], state[now + 1], action[now]
    told = []
    for i, name in enumerate(action_names):
        meaning = _by_name(name)
        of_state = _counterpart(i, name, state_names, action_names)
        if meaning is None and of_state is not None:
            meaning = _by_data(before[:, of_state], after[:, of_state], sent[:, i])
        if meaning is None and (of_state is None or state_names[of_state] != name):
            meaning = _unpaired(before, after, sent[:, i])
        told.append(Command(name, meaning, state_names[of_state] if meaning == "target" else None))
    return _as_their_neighbours(told, state_names)


def _by_name(name: str) -> str | None:
    words = set(re.split(r"[^a-z0-9]+", name.lower()))
    return next((meaning for meaning, known in WORDS.items() if words & known), None)


def _counterpart(i: int, name: str, state_names: list[str], action_names: list[str]) -> int | None:
    """The number of the state that a command may be a target of: that of the same name, else that at its place."""
    if name in state_names:
        return state_names.index(name)
    alike = len(state_names) == len(action_names) and not set(state_names) & set(action_names)
    return i if alike else None


def _by_data(before: np.ndarray, after: np.ndarray, sent: np.ndarray) -> str | None:
    """Target or delta of one number of the state, (N,) each; None where the data do not tell."""
    if len(sent) < 2:
        return None
    away, change = np.abs(sent - after).mean(), after - before
    by_it, towards_it = _explained(change, sent), _correlation(change, sent - before) ** 2
    if by_it > max(CHANGES, towards_it):
        return "delta"
    if away < FOLLOWS * sent.std() or away < NEAR * np.abs(after).mean():
        return "target"
    return "other" if len(np.unique(sent)) == 2 else None  # a switch


def _unpaired(before: np.ndarray, after: np.ndarray, sent: np.ndarray) -> str | None:
    """Of a command that no number of the state is the counterpart of: a switch, or what some number changes by."""
    if len(np.unique(sent)) <= 2:
        return "other"
    changes = (after - before).T
    return "delta" if any(_correlation(change, sent) ** 2 > CHANGES for change in changes) else None


def _explained(change: np.ndarray, sent: np.ndarray) -> float:
    """Share of the changes (N,) that are a multiple of what was sent: none where nothing is sent."""
    slope = (change * sent).sum() / max((sent**2).sum(), 1e-12)
    return 0.0 if slope <= 0 else 1 - ((change - slope * sent) ** 2).sum() / max((change**2).sum(), 1e-12)


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    if min(x.std(), y.std()) < 1e-9:
        return 0.0
    return float(np.corrcoef(x, y)[0, 1])


def _as_their_neighbours(told: list[Command], state_names: list[str]) -> list[Command]:
    """A number that never moves tells nothing; where all others of the same robot are targets, or deltas, so is it."""
    settled = {c.meaning for c in told if c.name in state_names and c.meaning in ("target", "delta")}
    if len(settled) != 1:
        return told
    meaning, doubtful = settled.pop(), lambda c: c.meaning is None and c.name in state_names
    of_state = lambda c: c.name if meaning == "target" else None  # noqa: E731
    return [Command(c.name, meaning, of_state(c)) if doubtful(c) else c for c in told]


def settle(
    told: list[Command], by_hand: dict[str, str] | None, state_names: list[str], repo_id: str
) -> list[Command]:  # fmt: skip
    """What each command means: what the user says, else what names and data tell.

    Args:
        told: by `tell_meanings`.
        by_hand: command -> meaning, as a configuration holds it.

    Raises:
        MeaningError: the user names a command that there is not, or one command's meaning is not known.
    """
    names, by_hand = [command.name for command in told], by_hand or {}
    unknown = [name for name in by_hand if name not in names]
    if unknown:
        raise MeaningError(
            f"--policy.trained_on.meanings names {', '.join(unknown)}; {repo_id} has the commands {', '.join(names)}"
        )
    settled = [parse(c.name, by_hand[c.name], state_names) if c.name in by_hand else c for c in told]
    doubtful = [c.name for c in settled if c.meaning is None]
    if doubtful:
        example = ", ".join(f"{name}: delta" for name in doubtful)
        raise MeaningError(
            f"neither names nor data of {repo_id} tell what {', '.join(doubtful)} means, so nothing is known of "
            f"how to stand still. Say it: --policy.trained_on.meanings='{{{example}}}' (target: where a number of the "
            "state is to be; delta: by how much to move; velocity: how fast; other: a switch or a constant)"
        )
    return settled


def contradictions(known: list[Command], told: list[Command]) -> list[str]:
    """Commands that are targets by what is known and motions by what these data tell, or the reverse, in words."""
    motions, said = ("delta", "velocity"), []
    for mine, theirs in zip(known, told):
        pair = mine.meaning, theirs.meaning
        if "target" in pair and (pair[0] in motions or pair[1] in motions):
            said.append(f"{mine.name} is a {pair[1]} by its data, a {pair[0]} by what the filter was trained on")
    return said
