"""Every place that leans on the insides of LeRobot 0.6: look here first when a new version breaks something."""

import logging
import re
import sys
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow.parquet as pq

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.policies.pretrained import PreTrainedPolicy

RECORDING = re.compile(r"Recording episode (\d+)$")
"""What LeRobot's loops log when an episode begins."""
RESETTING = "Reset the environment"
"""What they log between episodes."""
RETURNING = "Returning robot to initial position"
"""What they log before they move the robot back."""

NOT_AVERAGED = "_ddp_params_and_buffers_to_ignore"
"""The attribute in which torch's DistributedDataParallel, which LeRobot wraps policies in, looks for names."""


def quiet_decoder() -> None:
    """torchcodec without system FFmpeg logs a page of traceback; LeRobot then falls back to pyav by itself."""
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)


def training_run() -> "TrainPipelineConfig | None":
    """The options of the lerobot-train that is at work just now, if any: LeRobot hands them to no policy."""
    frame = sys._getframe(1)
    while frame is not None:
        for options in (frame.f_locals.get("cfg"), frame.f_locals.get("self")):
            if type(options).__name__ == "TrainPipelineConfig":
                return options
        frame = frame.f_back
    return None


def drop_episode_statistics(root: Path, features: list[str]) -> None:
    """Remove what a dataset's episodes still say of features that `remove_feature` took out.

    LeRobot leaves their statistics there, and then refuses to aggregate those of pictures.
    """
    for file in root.glob("meta/episodes/*/*.parquet"):
        table = pq.read_table(file)
        left_over = tuple(f"stats/{feature}/" for feature in features)
        pq.write_table(table.drop_columns([c for c in table.column_names if c.startswith(left_over)]), file)


def queued_actions(policy: "PreTrainedPolicy") -> deque | None:
    """The queue that a LeRobot policy plays its chunks from, if it has one."""
    queues = getattr(policy, "_queues", None)
    if isinstance(queues, dict) and "action" in queues:
        return queues["action"]
    return getattr(policy, "_action_queue", None)


def observation_queues(policy: "PreTrainedPolicy") -> dict[str, deque]:
    """What a LeRobot policy remembers of observations and actions: key -> the last ones."""
    return getattr(policy, "_queues", {})


def set_observation_queues(policy: "PreTrainedPolicy", queues: dict[str, deque]) -> None:
    """Give a policy such a memory."""
    policy._queues = queues


def planned_actions(config: "PreTrainedConfig") -> int:
    """How many actions from now on a policy plans, of which it plays the first `n_action_steps`."""
    if hasattr(config, "horizon"):  # of a diffusion policy, counted from its first observation on
        return config.horizon - config.n_obs_steps + 1
    return getattr(config, "chunk_size", getattr(config, "n_action_steps", 1))
