"""Processors of the filter: rename, batch, device; the numbers are scaled inside the model.

Outer processors must not scale: inside, the base policy has its own, and the filter compares actions in robot units.
"""

from typing import Any

import torch
from lerobot.processor import (
    EnvTransition,
    PolicyAction,
    PolicyProcessorPipeline,
    ProcessorStep,
    ProcessorStepRegistry,
    TransitionKey,
    make_default_pre_post_processors,
)

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig


@ProcessorStepRegistry.register("latentsafe_no_proprioception")
class NoProprioceptionStep(ProcessorStep):
    """Lets frames pass that bring no observation: cached ones without proprioception, which are found by index."""

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """The same with an empty observation in place of none, which LeRobot's steps refuse."""
        return {**transition, TransitionKey.OBSERVATION: transition.get(TransitionKey.OBSERVATION) or {}}

    def transform_features(self, features: dict) -> dict:
        """The same features."""
        return features


def make_latentsafe_pre_post_processors(
    config: LatentSafeConfig,
    dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None,
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """LeRobot's default pipelines with every normalisation mode set to identity."""
    before, after = make_default_pre_post_processors(config, dataset_stats)
    if not config.robot_state_feature:
        before.steps = [NoProprioceptionStep(), *before.steps]
    return before, after
