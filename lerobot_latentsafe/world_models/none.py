"""No world model: what a guard has, which checks what it sees and imagines nothing."""

from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.world_models.base import WorldModel, WorldModelConfig


@WorldModelConfig.register_subclass("none")
@dataclass
class NoneConfig(WorldModelConfig):
    """Nothing to set; pictures are made as small as those that a guard looks at."""

    image_size: int = 32
    clip_length: int = 2

    def build(self, image_keys: list[str], state_dim: int, action_dim: int) -> "NoWorldModel":
        """Nothing with fresh weights."""
        return NoWorldModel(self, image_keys, action_dim)


class NoWorldModel(WorldModel):
    """Its latent is the last action, its features one number that is always zero."""

    config: NoneConfig
    feature_dim = 1

    def __init__(self, config: NoneConfig, image_keys: list[str], action_dim: int):
        super().__init__()
        self.config, self.image_keys, self.action_dim = config, sorted(image_keys), action_dim

    def initial(self, batch_size: int) -> Latent:
        """No action yet: (B, A)."""
        return {"action": torch.zeros(batch_size, self.action_dim)}

    def step(self, latent: Latent, action: Tensor) -> Latent:
        """The action (B, A)."""
        return {"action": action}

    def correct(self, predicted: Latent, percepts: dict[str, Tensor], state: Tensor) -> Latent:
        """What was predicted."""
        return predicted

    def features(self, latent: Latent) -> Tensor:
        """Zero: (..., 1)."""
        return torch.zeros_like(latent["action"][..., :1])

    def ended(self, latent: Latent) -> Tensor:
        """Never: bool (...,)."""
        return torch.zeros_like(latent["action"][..., 0], dtype=torch.bool)

    def error(self, latent: Latent, percepts: dict[str, Tensor], state: Tensor) -> Tensor:
        """Not a number, as nothing is foretold: (B,)."""
        return torch.full_like(state[:, 0], torch.nan)

    def loss(self, clip: Clip) -> tuple[Tensor, Tensor, dict[str, float]]:
        """There is nothing to train.

        Raises:
            ValueError: with the remedy.
        """
        raise ValueError(
            "--policy.world_model.type is 'none', which has nothing to train; give rssm, gru or dino_wm, or make a "
            "guard without training: latentsafe guard --dataset.repo_id=... --output_dir=..."
        )
