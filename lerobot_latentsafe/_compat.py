"""Every place that leans on the insides of LeRobot 0.6: look here first when a new version breaks something."""

import logging
import sys
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, NamedTuple

import pyarrow.parquet as pq
from lerobot.utils.constants import ACTION
from lerobot.utils.import_utils import require_package
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.datasets.dataset_writer import DatasetWriter
    from lerobot.policies.pretrained import PreTrainedPolicy

RECORDING = {
    ("lerobot.scripts.lerobot_record", "record_loop"): ("dataset", "start_episode_t"),
    ("lerobot.rollout.strategies.episodic", "_policy_loop"): ("dataset", "start_t"),
}
"""LeRobot's loops that record an episode, or nothing if their dataset is None -> names of it and of when they began."""
BETWEEN = {
    ("lerobot.rollout.strategies.episodic", "_reset_loop"),
    ("lerobot.rollout.strategies.episodic", "run"),
    ("lerobot.rollout.strategies.core", "_return_to_initial_position"),
}
"""Those that move a robot between episodes."""

EVALUATION = "lerobot.scripts.lerobot_eval"
"""LeRobot's evaluation in simulation, which begins each episode by `policy.reset()`."""
ROLLOUT = "lerobot.rollout"
"""LeRobot's loops that run a policy on a robot; they do the same."""

ADAPTER = "adapter_config.json"
"""The file beside a policy's config.json that makes it a PEFT adapter."""

NOT_AVERAGED = "_ddp_params_and_buffers_to_ignore"
"""The attribute in which torch's DistributedDataParallel, which LeRobot wraps policies in, looks for names."""


def send_no_gradients() -> None:
    """Keep gradients on this rank where DistributedDataParallel is in its forward pass, as in its `no_sync`.

    LeRobot's training enters no `no_sync` and gives the wrapper to nobody.
    """
    if (wrapper := DistributedDataParallel._active_ddp_module) is not None:
        wrapper.require_backward_grad_sync = False


def quiet_decoder() -> None:
    """torchcodec without system FFmpeg logs a page of traceback; LeRobot then falls back to pyav by itself."""
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)


def _callers() -> Iterator[FrameType]:
    """The frames of whoever is at work just now, the innermost first."""
    frame = sys._getframe(1)
    while frame is not None:
        yield frame
        frame = frame.f_back


def training_run() -> "TrainPipelineConfig | None":
    """The options of the lerobot-train that is at work just now, if any: LeRobot hands them to no policy."""
    for frame in _callers():
        for options in (frame.f_locals.get("cfg"), frame.f_locals.get("self")):
            if type(options).__name__ == "TrainPipelineConfig":
                return options
    return None


def called_from(module: str) -> bool:
    """Whether a module of LeRobot, or one in a package of it, is at work just now."""
    names = (frame.f_globals.get("__name__", "") for frame in _callers())
    return any(name == module or name.startswith(f"{module}.") for name in names)


class Loop(NamedTuple):
    """A loop of LeRobot's that drives a robot.

    Attributes:
        episode: the number of the one that it records; None between episodes.
        began: when, by LeRobot's clock; it tells two loops that record the same episode.
    """

    episode: int | None
    began: float | None


def calling_loop() -> Loop | None:
    """The loop that records, or moves a robot between episodes, if one of them is calling: LeRobot tells no robot."""
    for frame in _callers():
        spec = frame.f_globals.get("__spec__")  # its name is the module's even if that is run as a program
        place = getattr(spec, "name", None) or frame.f_globals.get("__name__"), frame.f_code.co_name
        if place in RECORDING:
            dataset, began = (frame.f_locals.get(name) for name in RECORDING[place])
            return Loop(None if dataset is None else dataset.num_episodes, began)
        if place in BETWEEN:
            return Loop(None, None)
    return None


def drop_episode_statistics(root: Path, features: list[str]) -> None:
    """Remove what a dataset's episodes still say of features that `remove_feature` took out.

    LeRobot leaves their statistics there, and then refuses to aggregate those of pictures.
    """
    for file in root.glob("meta/episodes/*/*.parquet"):
        table = pq.read_table(file)
        left_over = tuple(f"stats/{feature}/" for feature in features)
        pq.write_table(table.drop_columns([c for c in table.column_names if c.startswith(left_over)]), file)


WRITER = "lerobot.datasets.lerobot_dataset.DatasetWriter"
"""The class by which a dataset that is being recorded writes."""


def episode_to_write(writer: "DatasetWriter") -> dict:
    """The episode that is being recorded: feature -> its frames, `episode_index`, and `size`, which counts frames."""
    if writer.episode_buffer is None:
        writer.episode_buffer = writer._create_episode_buffer()
    return writer.episode_buffer


def write_into(writer: "DatasetWriter", folder: Path) -> None:
    """Have a dataset's writer write into another folder than its dataset's, pictures and metadata included."""
    writer._root = writer._meta.root = folder


def close_files(writer: "DatasetWriter") -> None:
    """Make the episode that was just saved readable; the next one begins files of its own, as if recording went on.

    LeRobot keeps its tables open, and its metadata in memory, until the last episode.
    """
    meta = writer._meta
    writer.close_writer()
    meta._close_writer()
    meta.episodes = [{name: value for name, (value,) in meta.latest_episode.items()}]
    meta.latest_episode = writer._latest_episode = None


def read_anew(writer: "DatasetWriter") -> None:
    """Have a dataset that was recorded read its metadata from its folder."""
    writer._meta.episodes = None


def is_lerobots(policy: "PreTrainedPolicy") -> bool:
    """Whether LeRobot wrote the policy's class, so that what is said here of its insides holds."""
    return type(policy).__module__.startswith("lerobot.policies.")


def forget_plan(policy: "PreTrainedPolicy") -> None:
    """Have a policy plan anew from what it sees next.

    `reset` drops whatever a policy plans, under whatever name: queues, averages, the start of a search. It also drops
    what the policy saw. LeRobot's policies keep that in `_queues`, and get it back. One that remembers more than it
    saw (lingbot_va takes its plan for what was executed) begins anew.
    """
    seen = observation_queues(policy) if is_lerobots(policy) else {}
    policy.reset()
    if seen:
        policy._queues.update(seen)


def queued_actions(policy: "PreTrainedPolicy") -> deque | None:
    """The queue that a LeRobot policy plays its chunks from, if it has one.

    Some have two (pi0): `_action_queue` is then the one that is played.
    """
    queue = getattr(policy, "_action_queue", None)
    if queue is not None:
        return queue
    return (getattr(policy, "_queues", None) or {}).get(ACTION)


def observation_queues(policy: "PreTrainedPolicy") -> dict[str, deque]:
    """What a LeRobot policy remembers of what it saw: key -> the last ones."""
    return {key: past for key, past in (getattr(policy, "_queues", None) or {}).items() if key != ACTION}


def set_observation_queues(policy: "PreTrainedPolicy", queues: dict[str, deque]) -> None:
    """Give a policy such a memory."""
    policy._queues = queues


def plans_apart(policy: "PreTrainedPolicy") -> bool:
    """Whether `predict_action_chunk` leaves the policy as it was, so that a copy of it can plan in another thread."""
    return queued_actions(policy) is not None and policy.config.type != "lingbot_va"


def planned_actions(config: "PreTrainedConfig") -> int:
    """How many actions, one a tick, a policy plans from now on; it plays the first of them, see `played_actions`."""
    if getattr(config, "n_action_repeats", 1) > 1 or not getattr(config, "use_mpc", True):
        return 1  # tdmpc: its plan is not of ticks, or is a single action
    if hasattr(config, "horizon"):  # of a diffusion policy, counted from its first observation on
        return config.horizon - config.n_obs_steps + 1
    return getattr(config, "chunk_size", played_actions(config))


def played_actions(config: "PreTrainedConfig") -> int:
    """How many actions of a plan a policy plays before it plans again."""
    return getattr(config, "n_action_steps", getattr(config, "action_chunk_size", 1))


def plan_chunk(policy: "PreTrainedPolicy", batch: dict) -> Tensor:
    """All actions that a policy plans, not only those that it plays: (B, N, A)."""
    config = policy.config
    played = getattr(config, "n_action_steps", None)
    if played is not None:  # some cut their plan to what is played
        config.n_action_steps = planned_actions(config)
    try:
        chunk = policy.predict_action_chunk(batch)
    finally:
        if played is not None:
            config.n_action_steps = played
    return chunk.transpose(0, 1) if config.type == "tdmpc" else chunk  # tdmpc: (N, B, A)


def merged_adapter(policy: "PreTrainedPolicy", folder: Path) -> "PreTrainedPolicy":
    """A policy with a PEFT adapter of it merged into its weights: a policy like any other.

    Raises:
        ImportError: peft is not installed.
        ValueError: an adapter that is not a change of weights.
    """
    require_package("peft", extra="peft")
    from peft import PeftModel

    adapted = PeftModel.from_pretrained(policy, str(folder))
    if not hasattr(adapted, "merge_and_unload"):
        raise ValueError(f"the adapter {folder} cannot be merged into weights; shield a policy with a LoRA adapter")
    return adapted.merge_and_unload().eval()
