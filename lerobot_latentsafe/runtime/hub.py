"""Saving a policy with what LeRobot's commands expect beside it, and pushing it to the Hub."""

from pathlib import Path
from tempfile import TemporaryDirectory

import httpx
from huggingface_hub import HfApi
from huggingface_hub.errors import HfHubHTTPError, OfflineModeIsEnabled
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from safetensors.torch import load_file, save_file

from lerobot_latentsafe.runtime.checkpoint import WEIGHTS, seal_again, writing_checkpoint

HUB_FAILURES = (HfHubHTTPError, OfflineModeIsEnabled, httpx.HTTPError, OSError, RuntimeError)
"""What huggingface_hub raises when the Hub does not answer or refuses; RuntimeError where weights are uploaded."""


class HubUnreachableError(ConnectionError):
    """The Hub did not answer; nothing local was touched."""


def save_policy(policy: PreTrainedPolicy, output_dir: str | Path, half: bool = False) -> None:
    """Write a policy with the processors LeRobot's commands expect, sealed if it seals itself.

    Args:
        half: store 16-bit weights.

    Raises:
        CheckpointWriteError: such as on a full disk; what was there before is as it was.
    """
    with writing_checkpoint(output_dir) as folder:
        policy.save_pretrained(folder)
        for pipeline in make_pre_post_processors(policy.config):
            pipeline.save_pretrained(folder)
        if half:
            halve_weights(folder)
        else:
            seal_again(folder)


def halve_weights(folder: str | Path) -> None:
    """Rewrite every model.safetensors below a folder in 16 bits, and seal again those that were sealed."""
    for file in Path(folder).rglob(WEIGHTS):
        tensors = {k: v.half() if v.is_floating_point() else v for k, v in load_file(file).items()}
        save_file(tensors, file, metadata={"format": "pt"})
    seal_again(Path(folder))


def push_policy(policy: PreTrainedPolicy, repo_id: str, dataset_repo_id: str, private: bool = False) -> str:
    """Upload a policy: weights, config, processors, what it comes with, and a card. Returns the URL.

    The repository is created before anything is prepared, so that a Hub that is down is noticed at once.

    Raises:
        HubUnreachableError: the Hub did not answer or refused.
    """
    api = HfApi()
    try:
        repo_id = api.create_repo(repo_id, private=private, exist_ok=True).repo_id
    except HUB_FAILURES as e:
        raise HubUnreachableError(
            f"cannot create {repo_id} on {api.endpoint} ({type(e).__name__}: {e}). Check the connection and "
            "`hf auth login`; the policy on disk is untouched, push it again later"
        ) from e
    policy.config.repo_id = repo_id
    with TemporaryDirectory() as folder:
        save_policy(policy, Path(folder))
        card = policy.generate_model_card(dataset_repo_id, policy.name, policy.config.license, policy.config.tags)
        card.save(Path(folder) / "README.md")
        try:
            commit = api.upload_folder(repo_id=repo_id, folder_path=folder, commit_message=f"Push {policy.name} policy")
        except HUB_FAILURES as e:
            raise HubUnreachableError(
                f"upload to {repo_id} broke off ({type(e).__name__}: {e.__cause__ or e}); the policy on disk is "
                f"untouched and {repo_id} is as it was, for all files come at once: push again by the same command"
            ) from e
    return str(commit.repo_url)
