"""A filter of the bag that sees by an encoder of one's choice, from nothing: by the commands that users type."""

import math
from dataclasses import dataclass, replace
from typing import Self

from lerobot_latentsafe.encoders.patch_encoders import load_encoder
from lerobot_latentsafe.experiments.demo import Demo

SOURCES = ("bag_mix", "bag_branches", "bag_lifts")
"""What is recorded; see `collection/franka.py`."""
FEW = ("--batch_size=32", "--policy.margin.clips=2000", "--policy.reachability.pool=32768")
"""What of configs/bag_dino_wm.yaml takes long where a frame has many tokens."""


@dataclass(frozen=True, kw_only=True)
class FilterSizes:
    """How much a filter costs, and how good it can be.

    Attributes:
        episodes: of each source.
        image_size: pixels; None: the encoder's default.
        merge_patches: so many a side are one token.
        steps, critic_steps: gradient steps of the world model, and of the critic.
    """

    episodes: int = 20
    image_size: int | None = None
    merge_patches: int = 1
    steps: int = 400
    critic_steps: int = 2000

    def fitting(self, encoder: str) -> Self:
        """With an encoder's image size, if none is given, and tokens as large as 2 x 2 of them or more fill an image.

        What is not in the Hub's cache yet is downloaded.

        Raises:
            EncoderError: the encoder cannot be had.
            ValueError: its patches do not fill images of that size.
        """
        found = load_encoder(encoder)
        size = found.image_size if self.image_size is None else self.image_size
        side = math.isqrt(found.n_patches(size, size))
        merge = max(m for m in range(1, 5) if side % m == 0 and (side >= 2 * m or m == 1))
        return replace(self, image_size=size, merge_patches=merge)


def train_filter(demo: Demo, encoder: str, sizes: FilterSizes) -> str:
    """Record, encode and train.

    Args:
        encoder: its name.
        sizes: that fit it.

    Returns:
        The filter's folder.
    """
    dataset = _record(demo, sizes.episodes)
    cache, size = demo.out / "tokens", sizes.image_size
    cached = "--dataset.repo_id=demo/bag_cache", f"--dataset.root={cache}"
    demo.run(
        f"cache: what {encoder} says of each frame",
        *("latentsafe", "cache", f"--encoder={encoder}", f"--image_size={size}", *dataset, f"--output_dir={cache}"),
    )
    demo.run(
        f"world model: DINO-WM and a failure margin, {sizes.steps} steps",
        *("lerobot-train", "--config_path=configs/bag_dino_wm.yaml", *cached, f"--policy.frame_cache={cache}"),
        *(f"--policy.world_model.image_size={size}", f"--policy.world_model.merge_patches={sizes.merge_patches}"),
        *(f"--steps={sizes.steps}", *FEW),
        *(f"--policy.scheduler_steps={sizes.steps}", f"--output_dir={demo.out}/world_model"),
    )
    trained = demo.out / "world_model" / "checkpoints" / "last" / "pretrained_model"
    demo.run(
        "margin: fitted anew to the labels",
        *("latentsafe", "train-margin", f"--policy.path={trained}", *cached, f"--output_dir={demo.out}/margin"),
    )
    demo.run(
        f"reachability: in imagination, {sizes.critic_steps} steps",
        *("latentsafe", "train-reachability", f"--policy.path={demo.out}/margin", *cached),
        *(f"--steps={sizes.critic_steps}", f"--output_dir={demo.out}/filter"),
    )
    return str(demo.out / "filter")


def _record(demo: Demo, n: int) -> tuple[str, str]:
    """Record n episodes of each source in one dataset; returns the options that name it."""
    for source in SOURCES:
        demo.run(
            f"collect {source}: {n} episodes",
            *("latentsafe", "collect", f"--source={source}", f"--dataset.repo_id=demo/{source}"),
            *(f"--dataset.root={demo.out}/{source}", f"--dataset.num_episodes={n}"),
        )
    demo.run(
        "merge",
        *("lerobot-edit-dataset", "--operation.type=merge", "--new_repo_id=demo/bag", f"--new_root={demo.out}/bag"),
        f"--operation.repo_ids=[{', '.join(f'demo/{source}' for source in SOURCES)}]",
        f"--operation.roots=[{', '.join(f'{demo.out}/{source}' for source in SOURCES)}]",
    )
    return "--dataset.repo_id=demo/bag", f"--dataset.root={demo.out}/bag"
