"""What the numbers of a dataset are called: one distinct name a number, whatever its file says."""

from typing import Any


def settled_names(state: Any, action: Any, n_state: int, n_action: int) -> tuple[list[str], list[str]]:
    """Names of the numbers of a state and of an action, distinct in each.

    A command is paired with the number of the state of its name. So where there are as many of both and one of them
    has no usable names, both have the same.

    Args:
        state, action: `names` of the features as a dataset's info gives them: a list, a nested one, a dict, or nothing.
        n_state, n_action: how many numbers there are.
    """
    state_names, action_names = usable_names(state, n_state), usable_names(action, n_action)
    if n_state == n_action:
        state_names, action_names = state_names or action_names, action_names or state_names
    prefixes = ("motor", "motor") if n_state == n_action else ("state", "action")
    return (
        state_names or [f"{prefixes[0]}_{i}" for i in range(n_state)],
        action_names or [f"{prefixes[1]}_{i}" for i in range(n_action)],
    )


def usable_names(names: Any, n: int) -> list[str] | None:
    """The names of n numbers, or None if they are not one a number and distinct."""
    for found in (flat_names(names), flat_names(names, prefixed=True)):
        if len(found) == n and len(set(found)) == n and all(found):
            return found
    return None


def flat_names(names: Any, prefixed: bool = False) -> list[str]:
    """Names in one list, of `{"motors": [...]}`, `[[...]]`, `{"x.pos": 0, ...}` or one string.

    Args:
        prefixed: put the key of a dict before its names, which tells `left` from `right`.
    """
    if names is None:
        return []
    if isinstance(names, dict):
        if all(isinstance(place, int) for place in names.values()):
            return sorted(names, key=names.get)
        before = (lambda key: f"{key}.") if prefixed else (lambda key: "")
        return [before(key) + name for key, value in names.items() for name in flat_names(value, prefixed)]
    if isinstance(names, list | tuple):
        return [name for value in names for name in flat_names(value, prefixed)]
    return [str(names).strip()]
