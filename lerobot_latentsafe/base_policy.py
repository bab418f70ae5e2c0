"""The policy to be shielded: any LeRobot policy with its own processors."""

from pathlib import Path

from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline
from safetensors import SafetensorError
from torch import Tensor

from lerobot_latentsafe._compat import queued_actions
from lerobot_latentsafe.action_chunks import ChunksAhead
from lerobot_latentsafe.runtime.checkpoint import CheckpointError, read_config, resolve_checkpoint


class BasePolicy:
    """Any LeRobot policy with its own processors, as the thing to be shielded.

    Args:
        policy: what acts.
        preprocessor, postprocessor: LeRobot's pipelines of that policy.
        ahead: if not 0, its chunks are made off the control thread; see `ChunksAhead`.
    """

    def __init__(
        self, policy: PreTrainedPolicy, preprocessor: PolicyProcessorPipeline, postprocessor: PolicyProcessorPipeline,
        ahead: int = 0,
    ):  # fmt: skip
        _refuse_filter(policy.config, policy.name)
        self.policy, self.preprocessor, self.postprocessor = policy, preprocessor, postprocessor
        self.chunks = ChunksAhead(policy, ahead) if ahead else None

    @classmethod
    def load(cls, path: str | Path, device: str = "cpu", ahead: int = 0) -> "BasePolicy":
        """The policy of a folder, a Hub id or the name of a committed checkpoint.

        Raises:
            CheckpointError: no policy there, or one that cannot be read.
            ValueError: it is itself a filter.
        """
        folder = resolve_checkpoint(path)
        config = read_config(folder, device)
        _refuse_filter(config, path)
        try:
            policy = get_policy_class(config.type).from_pretrained(folder, config=config, strict=True)
        except (SafetensorError, RuntimeError) as e:
            raise CheckpointError(
                f"base policy {folder}: weights unreadable or not its own ({e}); copy it again"
            ) from e
        preprocessor, postprocessor = make_pre_post_processors(
            config, pretrained_path=folder, preprocessor_overrides={"device_processor": {"device": device}}
        )
        return cls(policy, preprocessor, postprocessor, ahead)

    @property
    def config(self) -> PreTrainedConfig:
        """The policy's."""
        return self.policy.config

    def reset(self) -> None:
        """Start an episode."""
        self.policy.reset()
        if self.chunks is not None:
            self.chunks.reset()
        self.preprocessor.reset()
        self.postprocessor.reset()

    def propose(self, observation: dict[str, Tensor]) -> Tensor:
        """Action (B, A) in robot units, through the base policy's own processors."""
        act = self.policy.select_action if self.chunks is None else self.chunks.act
        return self.postprocessor(act(self.preprocessor(dict(observation))))

    def replan(self, executed: Tensor) -> None:
        """Drop the rest of a planned chunk: after an intervention it belongs to a state that never came.

        A policy that remembers its actions, and says so by a method `was_overridden`, is told what was done instead:
        (B, A) in robot units.
        """
        if hasattr(self.policy, "was_overridden"):
            return self.policy.was_overridden(executed)
        if self.chunks is not None:
            self.chunks.replan()
        elif (queue := queued_actions(self.policy)) is not None:
            queue.clear()
        else:
            self.policy.reset()

    def save(self, folder: Path) -> None:
        """Write weights, config and processors to a folder."""
        self.policy.save_pretrained(folder)
        self.preprocessor.save_pretrained(folder)
        self.postprocessor.save_pretrained(folder)


def _refuse_filter(config: PreTrainedConfig, path: str | Path) -> None:
    if config.type == "latentsafe":
        raise ValueError(
            f"base policy {path} is itself a latentsafe filter; shields do not nest. "
            "Give --base_policy_path the policy to be shielded"
        )
