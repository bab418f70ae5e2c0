"""Processors of a policy's checkpoint, and what its settings name: looked at before LeRobot makes anything of them.

LeRobot imports whatever class a processor's file names, and lets `transformers` run Python files that lie beside
weights of the Hub. Nothing that was downloaded is run here.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline, ProcessorStepRegistry
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME

from lerobot_latentsafe.runtime.checkpoint import INTEGRITY, read_json
from lerobot_latentsafe.runtime.locations import CONFIG, CheckpointError

FILES = (f"{POLICY_PREPROCESSOR_DEFAULT_NAME}.json", f"{POLICY_POSTPROCESSOR_DEFAULT_NAME}.json")


class DownloadedCodeError(CheckpointError):
    """Something that was downloaded asks to be run."""


def load_processors(
    config: PreTrainedConfig, folder: Path, device: str | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """LeRobot's pipelines before and after a policy, from its folder.

    Args:
        device: to run on; by default the policy's.

    Raises:
        DownloadedCodeError: a step that is not in LeRobot's registry.
        CheckpointError: files that are missing, unreadable or not inside the folder.
    """
    check_processors(folder)
    overrides = {"device_processor": {"device": device or config.device}}
    try:
        with no_downloaded_code(config):
            return make_pre_post_processors(config, pretrained_path=folder, preprocessor_overrides=overrides)
    except CheckpointError:
        raise
    except Exception as e:  # each step has errors of its own
        raise CheckpointError(f"the processors of {folder} cannot be made ({e}); save the policy again") from e


def check_processors(folder: Path) -> None:
    """Refuse processors that are not LeRobot's or a plugin's, and files of theirs that lie elsewhere.

    Raises:
        DownloadedCodeError: a step that is not in LeRobot's registry.
        CheckpointError: files that are missing, unreadable or not inside the folder.
    """
    for name in FILES:
        file = folder / name
        if not file.exists():
            raise CheckpointError(
                f"{file} is missing. Save the policy with its processors, as lerobot-train does; of an older LeRobot: "
                f"python -m lerobot.processor.migrate_policy_normalization --pretrained-path={folder}"
            )
        for step in steps_of(file):
            _check_step(file, step)


def check_own_processors(config: PreTrainedConfig, folder: Path, renames: bool = False) -> None:
    """Refuse processors of a sealed policy that change what it sees.

    Those that its seal records are as they were. LeRobot's commands write them after the seal; of these none passes but
    what the configuration makes, so that nothing is scaled, cut or exchanged.

    Args:
        renames: whether names may be exchanged, as lerobot-train says anew by its --rename_map.

    Raises:
        DownloadedCodeError: a step that is not in LeRobot's registry.
        CheckpointError: naming the file.
    """
    recorded = read_json(folder / INTEGRITY).get("files") or {}
    for name, made in zip(FILES, make_pre_post_processors(config), strict=True):
        file = folder / name
        if not file.exists():
            continue  # LeRobot's commands ask for it; here nothing does
        steps = steps_of(file)
        for step in steps:
            _check_step(file, step)
        if name not in recorded and _effects(steps, renames) != _effects(made.get_config()["steps"], renames):
            raise CheckpointError(
                f"{file} is not sealed and changes what the policy sees; expected the steps that its {CONFIG} makes, "
                "which rename and scale nothing. Restore the file; give --rename_map where you use the policy"
            )


def _effects(steps: list[dict[str, Any]], renames: bool) -> list[tuple]:
    """What steps do to numbers and, unless that is meant, to names."""
    told = ("registry_name", "norm_map") if renames else ("registry_name", "norm_map", "rename_map")
    return [tuple({**step, **step.get("config", {})}.get(name) for name in told) for step in steps]


def steps_of(file: Path) -> list[dict[str, Any]]:
    """The steps that a processor's file lists.

    Raises:
        CheckpointError: it is no such file.
    """
    steps = read_json(file).get("steps")
    if not isinstance(steps, list) or not all(
        isinstance(s, dict) and isinstance(s.get("config", {}), dict) for s in steps
    ):
        raise CheckpointError(f"{file} lists no steps of a processor; save the policy again")
    return steps


def _check_step(file: Path, step: dict[str, Any]) -> None:
    name, state = step.get("registry_name"), step.get("state_file")
    if name not in ProcessorStepRegistry.list():
        asked = f"the step {name!r}" if name else f"the class {step.get('class')!r}"
        raise DownloadedCodeError(
            f"{file} asks for {asked}, which is not in LeRobot's registry of processors. Nothing that a file names is "
            "run: install the plugin that registers it (ProcessorStepRegistry.register), or save the policy "
            "again with registered steps"
        )
    if state is not None and not _is_file_name(state):
        raise CheckpointError(f"{file} reads {state!r}; expected the name of a safetensors file in {file.parent}")
    if state is not None and not (file.parent / state).exists():
        raise CheckpointError(f"{file.parent / state} is missing, which {file.name} names; copy the policy again")


def _is_file_name(name: Any) -> bool:
    """Whether this is the bare name of a safetensors file, on any system."""
    if not isinstance(name, str) or not name.endswith(".safetensors"):
        return False
    return PurePosixPath(name).name == name and PureWindowsPath(name).name == name


@contextmanager
def no_downloaded_code(config: PreTrainedConfig) -> Iterator[None]:
    """Meanwhile `transformers` runs no Python file of a repository, but of those that LeRobot itself names.

    LeRobot loads some tokenizers and encoders with `trust_remote_code=True`, by names from the policy's settings. Of
    such a setting the default is LeRobot's own choice, and whatever else stands there is the file's.

    Raises:
        DownloadedCodeError: inside the block, instead of running it.
    """
    try:
        from transformers import dynamic_module_utils
    except ImportError:  # not installed: nothing would run
        yield
        return
    trusted, fetch = (
        {f.default for f in fields(config) if isinstance(f.default, str)},
        dynamic_module_utils.get_cached_module_file,
    )

    def refuse(repository: Any, module_file: str, *given: Any, **options: Any) -> str:
        if str(repository) in trusted:
            return fetch(repository, module_file, *given, **options)
        raise DownloadedCodeError(
            f"this {config.type} policy asks to run {module_file} of {repository}. Nothing downloaded is run: if you "
            "trust it, load the policy yourself in Python and give the object to shield_policy"
        )

    dynamic_module_utils.get_cached_module_file = refuse
    try:
        yield
    finally:
        dynamic_module_utils.get_cached_module_file = fetch
