"""Configuration of the task policy that is learned in imagination, as a LeRobot policy."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode

from lerobot_latentsafe.policies.dreamer.behavior import BehaviorConfig


@PreTrainedConfig.register_subclass("latentsafe_dreamer")
@dataclass
class LatentSafeDreamerConfig(PreTrainedConfig):
    """An actor-critic in the imagination of a world model; trained by `latentsafe train-dreamer`.

    Attributes:
        behavior: sizes, learning and rewards of the actor-critic.
        world_model_path: folder of the world model: a latentsafe filter whose critic need not be trained.
        task, cameras, fps, state_names, action_names: what the world model must be of; taken over from the first one.
    """

    behavior: BehaviorConfig = field(default_factory=BehaviorConfig)
    world_model_path: str | None = None
    task: str | None = None
    cameras: list[str] | None = None
    fps: float | None = None
    state_names: list[str] | None = None
    action_names: list[str] | None = None

    # The world model scales state and actions with numbers of its own.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION", "ENV"), NormalizationMode.IDENTITY)
    )

    @property
    def observation_delta_indices(self) -> None:
        """It is not trained by lerobot-train."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """It is not trained by lerobot-train."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """It is not trained by lerobot-train."""
        return None

    def get_optimizer_preset(self) -> None:
        """It is not trained by lerobot-train."""
        return None

    def get_scheduler_preset(self) -> None:
        """It is not trained by lerobot-train."""
        return None

    def validate_features(self) -> None:
        """Features come from the world model."""
