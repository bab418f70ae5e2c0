"""Numbers and groups that people give for whole episodes: by a column of the dataset, or in a file."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_latentsafe.datasets.labels import read_frames

if TYPE_CHECKING:  # the package imports this module, and LeRobot's datasets are heavy
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata


def groups_of(meta: "LeRobotDatasetMetadata", by: str, episodes: np.ndarray | Sequence[int]) -> dict[str, list[int]]:
    """Group -> those of some episodes that are in it.

    Args:
        by: a column of the dataset's episodes, or of its frames, whose first one speaks for the episode; or a JSON file
            that maps a group to its episodes, such as {"weak": [0, 1], "strong": [2]}.

    Raises:
        ValueError: there is no such column, the file is no such map, or it leaves episodes out.
    """
    if Path(by).suffix == ".json":
        return _from_file(Path(by), episodes)
    if by in meta.episodes.column_names:
        named = {int(e): meta.episodes[int(e)][by] for e in episodes}
    elif by in meta.features and meta.features[by]["dtype"] not in ("image", "video"):
        frames = read_frames(meta.root, [by])
        first = {int(e): i for e, i in zip(*np.unique(frames["episode_index"], return_index=True))}
        named = {int(e): frames[by][first[int(e)]] for e in episodes}
    else:
        columns = [name for name in meta.episodes.column_names if "/" not in name]
        raise ValueError(
            f"--by={by}: {meta.repo_id} tells nothing of that name of its episodes; its columns are "
            f"{', '.join(columns)}, {', '.join(sorted(meta.features))}. Or give a JSON file that maps each group to "
            'its episodes: {"weak": [0, 1], "strong": [2]}'
        )
    groups: dict[str, list[int]] = {}
    for episode, value in named.items():
        groups.setdefault(_name(value), []).append(episode)
    return groups


def _name(value: Any) -> str:
    values = np.ravel(np.asarray(value, dtype=object)).tolist()
    return ", ".join(map(str, values))


def _from_file(file: Path, episodes: np.ndarray | Sequence[int]) -> dict[str, list[int]]:
    wanted = {int(episode) for episode in episodes}
    groups = _read(file, "--by", '{"weak": [0, 1], "strong": [2]}')
    if not groups or not all(isinstance(some, list) and all(type(e) is int for e in some) for some in groups.values()):
        raise ValueError(f'--by={file} maps no group to a list of episodes; expected {{"weak": [0, 1], "strong": [2]}}')
    listed = [episode for some in groups.values() for episode in some]
    left = sorted(wanted - {*listed})
    if left or len(listed) != len({*listed}):
        what = f"leaves out {len(left)} held-out episodes, such as {left[0]}" if left else "names an episode twice"
        raise ValueError(f"--by={file} {what}; each belongs to one group (or leave it out: --dataset.episodes)")
    return {name: [episode for episode in some if episode in wanted] for name, some in groups.items()}


def weights_of(file: Path, episodes: np.ndarray | Sequence[int]) -> dict[int, float]:
    """Episode -> its weight, from JSON, {"0": 1.5, ...}, or an .npy file (N,) by the episode's number.

    Raises:
        ValueError: the file is neither, leaves an episode out, or holds a weight that is no number above 0.
    """
    if file.suffix == ".npy":
        try:
            numbers = np.load(file, allow_pickle=False)
        except (OSError, ValueError, EOFError) as e:
            raise ValueError(f"--weights={file} is not readable ({e}); expected an array of a weight an episode") from e
        found = dict(enumerate(numbers.tolist())) if numbers.ndim == 1 else {}
    else:
        read = _read(file, "--weights", '{"0": 1.5, "1": 0.7}')
        found = {int(name): weight for name, weight in read.items() if name.isdecimal()}
    for episode in map(int, episodes):
        weight = found.get(episode)
        number = isinstance(weight, int | float) and not isinstance(weight, bool)
        if not number or not 0 < weight < math.inf:
            raise ValueError(
                f"--weights={file} gives episode {episode} the weight {weight!r}; expected a number above 0 for each "
                "held-out episode, its likelihood where the filter is to be used over that in these recordings"
            )
    return {int(episode): float(found[int(episode)]) for episode in episodes}


def _read(file: Path, option: str, example: str) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as e:
        raise ValueError(f"{option}={file} is not a readable JSON file ({e}); expected {example}") from e
    if not isinstance(content, dict):
        raise ValueError(f"{option}={file} holds a {type(content).__name__}; expected {example}")
    return content
