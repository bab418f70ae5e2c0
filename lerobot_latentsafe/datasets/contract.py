"""stub"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_latentsafe.datasets.labels import read_frames


@dataclass(frozen=True)
class Contract:
    repo_id: str
    root: Path
    robot_type: str | None
    fps: float
    state_names: list
    action_names: list
    cameras: dict
    left_out: dict
    episode: np.ndarray
    state: np.ndarray
    action: np.ndarray

    @classmethod
    def read(cls, meta):
        frames = read_frames(meta.root, ["action", "observation.state"])
        n = len(frames["index"])
        state, action = (np.asarray(frames[k], np.float32).reshape(n, -1) for k in ("observation.state", "action"))
        names = [list(meta.features[k]["names"] or []) for k in ("observation.state", "action")]
        cameras = {
            k: (f["shape"][2], f["shape"][0], f["shape"][1]) for k, f in meta.features.items() if k in meta.camera_keys
        }
        return cls(
            meta.repo_id,
            Path(meta.root),
            meta.robot_type,
            meta.fps,
            *names,
            cameras,
            {},
            frames["episode_index"],
            state,
            action,
        )
