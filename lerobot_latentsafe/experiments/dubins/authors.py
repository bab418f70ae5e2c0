"""The authors' public code (CMU-IntentLab/latent-safety), which is no part of this package: from a user's clone."""

import argparse
import importlib
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np

from lerobot_latentsafe.datasets.clips import ClipReader

CAMERA = "observation.image"


def authors_modules(path: Path, device: str = "cpu") -> SimpleNamespace:
    """Import the authors' modules `models`, `tools` and `dreamer_offline`, made to run on a device, such as the CPU."""
    missing = [name for name in ("configs.yaml", "dreamerv3-torch", "scripts") if not (path / name).exists()]
    if missing:
        raise SystemExit(f"--authors={path} lacks {', '.join(missing)}; give a clone of CMU-IntentLab/latent-safety")
    sys.path[:0] = [str(path / folder) for folder in ("dreamerv3-torch", "scripts", ".")]
    try:
        dreamer, models, networks, tools = map(
            importlib.import_module, ("dreamer_offline", "models", "networks", "tools")
        )
    except ImportError as e:
        raise SystemExit(f"the authors' code needs {e.name}: pip install gym ruamel.yaml tensorboard wandb") from e
    # Two defaults name the GPU and are not reached by their `device` option.
    networks.MLP.__init__.__defaults__ = tuple(device if d == "cuda" else d for d in networks.MLP.__init__.__defaults__)
    return SimpleNamespace(models=models, tools=tools, dreamer=dreamer)


def authors_config(tools: ModuleType, path: Path, device: str = "cpu") -> argparse.Namespace:
    """Their configs.yaml as their scripts read it, on a device and without videos."""
    yaml = importlib.import_module("ruamel.yaml")  # which they need, and we do not
    defaults = yaml.YAML(typ="safe", pure=True).load((path / "configs.yaml").read_text())["defaults"]
    config = argparse.Namespace(**{key: tools.args_type(value)(value) for key, value in defaults.items()})
    config.device, config.video_pred_log, config.num_actions = device, False, 1
    return config


def authors_frames(reader: ClipReader) -> dict[str, np.ndarray]:
    """Recorded frames under the names and in the shapes their scripts give them."""
    labels, n = reader.labels, len(reader.labels.episode)
    over = labels.terminal == 1
    return {
        "image": np.moveaxis(np.asarray(reader.cache.percepts[CAMERA]), 1, -1),
        "obs_state": reader.cache.state,
        "action": reader.cache.action[:, :1],
        "is_first": np.append(True, np.diff(labels.episode) != 0),
        "is_last": over,
        "is_terminal": over,
        "failure": (labels.failure == 1).astype(np.float32),
        "discount": np.ones(n, np.float32),
        "reward": np.zeros(n, np.float32),
    }
