"""The policy to be shielded: any LeRobot policy with its own processors."""

import logging
from collections.abc import Sequence
from pathlib import Path

import torch
from lerobot.configs.parser import parse_arg
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline, RelativeActionsProcessorStep
from lerobot.utils.constants import OBS_STATE
from lerobot.utils.import_utils import require_package
from safetensors import SafetensorError, safe_open
from torch import Tensor

from lerobot_latentsafe._compat import ADAPTER, forget_plan, is_lerobots, merged_adapter, queued_actions
from lerobot_latentsafe.action_chunks import ChunksAhead
from lerobot_latentsafe.origin import Origin, inverse, order
from lerobot_latentsafe.runtime.checkpoint import BASE_FOLDER, WEIGHTS, read_config, read_json
from lerobot_latentsafe.runtime.locations import CONFIG, CheckpointError, inside, named_by, resolve_checkpoint
from lerobot_latentsafe.runtime.processors import DownloadedCodeError, load_processors, no_downloaded_code

logger = logging.getLogger(__name__)

ADAPTER_WEIGHTS = "adapter_model.safetensors"


class BasePolicy:
    """Any LeRobot policy with its own processors, as the thing to be shielded.

    Args:
        policy: what acts.
        preprocessor, postprocessor: LeRobot's pipelines of that policy.
        ahead: if not 0, its chunks are made off the control thread; see `ChunksAhead`.
        origin: what is known of the data it was trained on; by default what its configuration says.

    Attributes:
        planned: (B, N, A) in robot units, what comes after the action that was proposed last, of a chunk that was
            planned just then and can be read; else None.
        coming: (B, N, A) in robot units, what comes after it, of a chunk of any age; None if that is not known.

    Raises:
        ValueError: it is itself a filter, or cannot choose one action at a time.
    """

    def __init__(
        self, policy: PreTrainedPolicy, preprocessor: PolicyProcessorPipeline, postprocessor: PolicyProcessorPipeline,
        ahead: int = 0, origin: Origin | None = None,
    ):  # fmt: skip
        _refuse_filter(policy.config, policy.name)
        _check_one_action_at_a_time(policy.config, preprocessor, ahead)
        self.policy, self.preprocessor, self.postprocessor = policy, preprocessor, postprocessor
        self.origin = origin or Origin.of(policy.config)
        self.chunks = ChunksAhead(policy, ahead) if ahead else None
        self._state_order: list[int] | None = None
        self._action_order: list[int] | None = None
        self._said_reset = False
        self._reads_plans = True
        self.planned: Tensor | None = None
        self.coming: Tensor | None = None

    @classmethod
    def load(cls, path: str | Path, device: str = "cpu", ahead: int = 0) -> "BasePolicy":
        """The policy of a folder, a Hub id or the name of a committed checkpoint; or a PEFT adapter of one, merged.

        Raises:
            CheckpointError: no policy there, one that cannot be read, or one that asks for code to be run.
            ValueError: it is itself a filter, or cannot choose one action at a time.
        """
        folder = resolve_checkpoint(path)
        config = read_config(folder, device)
        _refuse_filter(config, path)
        policy = _load_policy(folder, config)
        preprocessor, postprocessor = load_processors(config, folder, device)
        return cls(policy, preprocessor, postprocessor, ahead, Origin.of(config, folder))

    @property
    def config(self) -> PreTrainedConfig:
        """The policy's."""
        return self.policy.config

    def speak(self, action_names: Sequence[str] | None, state_names: Sequence[str] | None) -> None:
        """From now on take states, and give actions, in the order of these names, as far as the policy's are known.

        Raises:
            ValueError: the policy names other actions or states.
        """
        self._action_order = order(self.origin.action_names, action_names, "the base policy commands")
        self._state_order = inverse(order(self.origin.state_names, state_names, "the base policy reads the state"))
        if self._action_order or self._state_order:
            logger.warning("the base policy has its numbers in another order than the filter: they are put in order")

    def reset(self) -> None:
        """Start an episode."""
        self.policy.reset()
        if self.chunks is not None:
            self.chunks.reset()
        self.preprocessor.reset()
        self.postprocessor.reset()
        self.planned = self.coming = None

    def propose(self, observation: dict[str, Tensor]) -> Tensor:
        """Action (B, A) in robot units, through the base policy's own processors; see `planned` for what comes then."""
        observation = dict(observation)
        if self._state_order is not None:
            observation[OBS_STATE] = observation[OBS_STATE][:, self._state_order]
        act = self.policy.select_action if self.chunks is None else self.chunks.act
        queue = self._queue()
        left = len(queue or ())
        action = self._finished(act(self.preprocessor(observation)))
        if isinstance(action, Tensor):  # a plain one, which is not the policy's to change later
            action = action.detach().clone().as_subclass(Tensor)
        queue = self._queue()
        self.planned = self._read(queue, action) if queue and len(queue) >= left else None
        self.coming = self._still_to_come(len(queue or ())) if self.planned is None else self.planned
        return action

    def _still_to_come(self, n: int) -> Tensor | None:
        """What is left of a chunk that was read before, if it is the n actions that wait to be played."""
        known = self.coming is not None and n > 0 and self.coming.shape[1] == n + 1
        return self.coming[:, 1:] if known else None

    def _finished(self, action: Tensor) -> Tensor:
        """Actions (..., A) of the policy's own units in robot units, in the filter's order."""
        action = self.postprocessor(action)
        return action if self._action_order is None else action[..., self._action_order]

    def _queue(self) -> Sequence[Tensor] | None:
        """What is to come of a chunk that is played, (B, A) each in the policy's own units, if that can be read."""
        if not self._reads_plans:
            return None
        return queued_actions(self.policy) if self.chunks is None else self.chunks.playing

    def _read(self, queue: Sequence[Tensor], action: Tensor) -> Tensor | None:
        """What is to come after an action (B, A), in robot units (B, N, A).

        None of a policy whose processors take one action at a time, or whose queue holds something else than actions.
        """
        try:
            plan = self._finished(torch.stack([*queue], 1))
            if plan.dim() != 3 or plan.shape[::2] != action.shape or plan.is_complex():
                raise ValueError(f"planned {tuple(plan.shape)} of {plan.dtype}, expected (robots, steps, numbers)")
            return plan
        except Exception as e:
            self._reads_plans = False
            logger.warning("chunks of the base policy (%s) cannot be read: %s", self.config.type, e)
            return None

    @property
    def is_told(self) -> bool:
        """Whether the policy remembers its actions, and wants to be told of each that was not done."""
        return hasattr(self.policy, "was_overridden")

    def replan(self, executed: Tensor) -> None:
        """Drop the rest of a planned chunk: after an intervention it belongs to a state that never came.

        A policy that remembers its actions, and says so by a method `was_overridden`, is told what was done instead:
        (B, A) in robot units.
        """
        self.coming = None
        if self.is_told:
            theirs = inverse(self._action_order)
            return self.policy.was_overridden(executed if theirs is None else executed[:, theirs])
        if self.chunks is not None:
            return self.chunks.replan()
        if not is_lerobots(self.policy) and not self._said_reset:
            self._said_reset = True
            logger.warning(
                "how the base policy (%s) forgets a plan is not known: after an override it is reset, and begins as if "
                "the episode did. Give it a method was_overridden(executed) if it should remember",
                self.config.type,
            )
        forget_plan(self.policy)

    def save(self, folder: Path) -> None:
        """Write weights, config, processors and what is known of its data to a folder."""
        if self.chunks is not None:
            self.chunks.settle()
        self.policy.save_pretrained(folder)
        self.preprocessor.save_pretrained(folder)
        self.postprocessor.save_pretrained(folder)
        self.origin.save(folder)


def base_to_shield(folder: Path, chosen: str | None) -> str | None:
    """The policy that a filter of this folder is to shield: what the user chose, or else the one in the folder.

    Args:
        chosen: of the configuration in use. What differs from the folder's own, or was typed, is the user's choice.

    Raises:
        CheckpointError: the folder's own configuration names another place, or nothing is there.
    """
    own = getattr(read_config(folder), "base_policy_path", None)
    if chosen is None or chosen != own or chosen == parse_arg("policy.base_policy_path"):
        return chosen
    base = inside(folder, BASE_FOLDER)
    if own != BASE_FOLDER or base is None or (base / ADAPTER).exists():
        raise CheckpointError(
            f"{folder / CONFIG} names the base policy {own}; expected {BASE_FOLDER}, a folder in {folder} that holds a "
            "whole policy. What a checkpoint's file names is not fetched, and not looked for elsewhere. If you want "
            "that policy shielded, say so yourself: --policy.base_policy_path=... in LeRobot's commands, "
            "--base_policy_path=... in ours, load_filter(..., base_policy=...) in Python"
        )
    return str(base)


def _load_policy(folder: Path, config: PreTrainedConfig) -> PreTrainedPolicy:
    kind = get_policy_class(config.type)
    try:
        with no_downloaded_code(config):
            if (folder / ADAPTER).exists():
                return _load_adapted(kind, folder, config)
            with safe_open(folder / WEIGHTS, "pt"):  # some policies of LeRobot go on with random weights
                pass
            return kind.from_pretrained(folder, config=config, strict=True)
    except (SafetensorError, RuntimeError, OSError, MemoryError) as e:
        raise CheckpointError(f"base policy {folder}: weights unreadable or not its own ({e}); copy it again") from e
    except ImportError as e:
        raise CheckpointError(f"base policy {folder} ({config.type}) needs a package that is not here: {e}") from e


def _load_adapted(kind: type[PreTrainedPolicy], folder: Path, config: PreTrainedConfig) -> PreTrainedPolicy:
    """The policy that a PEFT adapter was trained on, with the adapter merged into it."""
    adapter = read_json(folder / ADAPTER)
    adapted, revision = adapter.get("base_model_name_or_path"), adapter.get("revision")
    if not adapted or not isinstance(adapted, str):
        raise CheckpointError(f"{folder / ADAPTER} names no base_model_name_or_path: write there what was adapted")
    imported = [name for name in ("auto_mapping", "megatron_config") if adapter.get(name)]
    if imported:  # peft imports the modules that these name
        raise DownloadedCodeError(f"{folder / ADAPTER} sets {', '.join(imported)}, which names code; expected null")
    fetch = f"hf download {adapted}" + (f" --revision={revision}" if revision else "")
    remedy = f"If you trust what it adapts: {fetch}, or write the name of a folder into {ADAPTER}"
    config.use_peft = False
    source = named_by(folder, adapted, remedy, revision)
    policy = kind.from_pretrained(source, config=config, strict=True)
    require_package("peft", extra="peft")
    with safe_open(folder / ADAPTER_WEIGHTS, "pt"):  # peft would take a pickle instead
        pass
    return merged_adapter(policy, folder)


def _refuse_filter(config: PreTrainedConfig, path: str | Path) -> None:
    if config.type == "latentsafe":
        raise ValueError(
            f"base policy {path} is itself a latentsafe filter; shields do not nest. "
            "Give --base_policy_path the policy to be shielded"
        )


def _check_one_action_at_a_time(config: PreTrainedConfig, preprocessor: PolicyProcessorPipeline, ahead: int) -> None:
    """Refuse a policy that LeRobot asks for whole chunks only; warn of one whose chunks are of the state then."""
    if getattr(getattr(config, "rtc_config", None), "enabled", False):
        raise ValueError(
            f"the base policy ({config.type}) has rtc_config.enabled: it then gives whole chunks only, and a filter "
            "judges each action when it is due. Set rtc_config to null in its config.json, or shield the robot instead "
            "(--robot.type=latentsafe_shielded)"
        )
    steps = getattr(preprocessor, "steps", ())
    if not any(isinstance(step, RelativeActionsProcessorStep) and step.enabled for step in steps):
        return
    if config.type == "groot" or ahead:
        raise ValueError(
            f"the base policy ({config.type}) plans actions relative to the state at the start of a chunk. They cannot "
            + ("be played later: give --policy.base_ahead=0" if ahead else "be chosen one at a time: shield the robot")
        )
    if getattr(config, "n_action_steps", 1) > 1:
        logger.warning(
            "the base policy's actions are relative to the state. LeRobot adds the state of the tick that an action is "
            "played at, not of the one that it was planned at: give it n_action_steps=1, or shield the robot and run "
            "LeRobot's --inference.type=rtc"
        )
