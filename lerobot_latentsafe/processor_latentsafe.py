"""Processors of the filter: rename, batch, device; the numbers are scaled inside the model.

Outer processors must not scale: inside, the base policy has its own, and the filter compares actions in robot units.
"""

from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig


def make_latentsafe_pre_post_processors(
    config: LatentSafeConfig,
    dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None,
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """LeRobot's default pipelines with every normalisation mode set to identity."""
    return make_default_pre_post_processors(config, dataset_stats)
