"""World models behind one contract; importing this registers their configurations."""

from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.world_models.base import WorldModel, WorldModelConfig
from lerobot_latentsafe.world_models.dino_wm import DinoWM, DinoWMConfig
from lerobot_latentsafe.world_models.gru import FrameGRU, GRUConfig
from lerobot_latentsafe.world_models.none import NoneConfig, NoWorldModel
from lerobot_latentsafe.world_models.rssm import RSSM, RSSMConfig

__all__ = [
    "RSSM",
    "Clip",
    "DinoWM",
    "DinoWMConfig",
    "FrameGRU",
    "GRUConfig",
    "Latent",
    "NoWorldModel",
    "NoneConfig",
    "RSSMConfig",
    "WorldModel",
    "WorldModelConfig",
]
