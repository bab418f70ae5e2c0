"""What a critic that takes constraints is trained on: where latents are, and random sets of the data's frames."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lerobot_latentsafe.constraints import KEY, ConstraintError, Likeness, LikenessConfig, random_sets
from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.datasets.labels import read_frames
from lerobot_latentsafe.datasets.names import usable_names
from lerobot_latentsafe.reachability import Starts
from lerobot_latentsafe.runtime.distributed import from_first_rank, share

HELD_OUT = 0.1
"""Share of the frames, the last ones, that tell how well it was fitted."""


def numbers_named(meta: Any, names: list[str]) -> np.ndarray:
    """The numbers of these names of all frames of a dataset, whatever feature holds them: (N, m - 1).

    Args:
        meta: LeRobotDatasetMetadata.

    Raises:
        ConstraintError: the dataset has no number of that name, or it is not finite; naming those that it has.
    """
    places: dict[str, tuple[str, int]] = {}
    for key, feature in meta.features.items():
        n = int(np.prod(feature["shape"]))
        if key != "action" and feature["dtype"].startswith("float") and key != "timestamp":
            places |= {name: (key, i) for i, name in enumerate(usable_names(feature.get("names"), n) or [])}
    unknown = [name for name in names if name not in places]
    if unknown:
        raise ConstraintError(
            f"--alike speaks of {', '.join(unknown)}, and {meta.repo_id} holds no numbers of that name beside its "
            f"actions; there are {', '.join(places) or 'none'}"
        )
    columns = read_frames(meta.root, {places[name][0] for name in names})
    found = np.stack([columns[key].reshape(len(columns[key]), -1)[:, i] for key, i in map(places.get, names)], -1)
    broken = np.flatnonzero(~np.isfinite(found).all(0))
    if len(broken):
        raise ConstraintError(f"--alike speaks of {names[broken[0]]}, which is not finite in {meta.repo_id}")
    return found.astype(np.float32)


def numbered(reader: ClipReader) -> ClipReader:
    """The same clips, in which a frame's number stands in for its label."""
    labels = replace(reader.labels, failure=np.arange(len(reader.labels.failure)))
    return ClipReader(labels, reader.cache, reader.length, reader.units, reader.skip, reader.state, reader.action)


def fit_likeness(
    likeness: Likeness, features: Tensor, where: Tensor, held_out: Tensor, generator: torch.Generator,
    steps: int = 1500, noise: float = 0.1,
) -> Tensor:  # fmt: skip
    """Fit what says where a latent is.

    Args:
        features: (N, D). where: (N, m - 1). held_out: bool (N,), those that are not fitted to.
        noise: on features that are scaled to unit deviation, as imagined ones are never quite right.

    Returns:
        (m - 1,), how far it errs in the median on those held out, as multiples of how far apart alike frames are.
    """
    likeness.mean.copy_(features.mean(0))
    likeness.deviation.copy_(features.std(0).clamp(min=1e-3))
    rows = (~held_out).nonzero()[:, 0]
    optimizer = torch.optim.AdamW(likeness.parameters(), 2e-3, weight_decay=0.01)
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = 2e-3 * min(1.0, 2 - 2 * step / steps)
        picked = rows[torch.randint(len(rows), (512,), generator=generator).to(rows.device)]
        shaken = noise * torch.randn(len(picked), features.shape[1], generator=generator).to(rows.device)
        loss = F.smooth_l1_loss(likeness(features[picked] + shaken * likeness.deviation), where[picked], beta=0.5)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        return (likeness(features[held_out]) - where[held_out]).abs().median(0).values


def learn_likeness(
    likeness: Likeness, config: LikenessConfig, numbers: np.ndarray, features: Tensor, frame: Tensor,
    generator: torch.Generator,
) -> tuple[LikenessConfig, Tensor]:  # fmt: skip
    """Learn where latents are from numbers of the recording.

    Args:
        numbers: (N, m - 1) of all frames of the dataset, see `numbers_named`.
        features, frame: (M, D) and (M,), of windows, and which frame each is.

    Returns:
        The configuration, with the range of the data; and where these windows are (M, m - 1).

    Raises:
        ConstraintError: the world model does not show a number of it.
    """
    names, apart = [*config.alike], np.array([*config.alike.values()], np.float32)
    where = torch.from_numpy(numbers / apart).to(features.device)[frame]
    held_out = frame >= (1 - HELD_OUT) * len(numbers)
    error = fit_likeness(likeness, features, where, held_out, generator)
    for tensor in likeness.state_dict().values():
        from_first_rank(tensor)
    for name, err, unit in zip(names, error.tolist(), apart.tolist()):
        print(f"alike: {name} is known to within {err * unit:.3g} (median of frames that were not fitted to)")
        if not err <= 0.5:
            raise ConstraintError(
                f"--alike says that frames are alike within {unit:g} of {name}, and the pictures tell it to within "
                f"{err * unit:.3g} only; give a larger distance, or leave {name} out"
            )
    likeness.requires_grad_(False)
    config = replace(config, low=numbers.min(0).tolist(), high=numbers.max(0).tolist())
    with torch.no_grad():
        return config, likeness(features)


def with_random_sets(starts: Starts, places: Tensor, generator: torch.Generator) -> Starts:
    """Starts of imagination, each with a random set of prototypes at places of the data (N, m - 1)."""
    places = places.cpu()

    def draw(count: int) -> dict[str, Tensor]:
        latent, sets = starts(count), share(random_sets(places, count, generator))
        return {**latent, KEY: sets.to(next(iter(latent.values())).device)}

    return draw
