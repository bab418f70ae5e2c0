"""Pushing a filter to the Hub."""

from pathlib import Path
from tempfile import TemporaryDirectory

from lerobot.policies.pretrained import PreTrainedPolicy

from lerobot_latentsafe.training import save_filter


class HubUnreachableError(ConnectionError):
    """The Hub did not answer; nothing local was touched."""


def push_filter(policy: PreTrainedPolicy, repo_id: str, dataset_repo_id: str, private: bool = False) -> str:
    """Upload a filter or task policy: weights, config, processors, the base policy or world model it comes with, and a
    card. Returns the URL.

    The repository is created before anything is prepared, so that a Hub that is down is noticed at once.

    Raises:
        HubUnreachableError: the Hub did not answer or refused.
    """
    import httpx
    from huggingface_hub import HfApi
    from huggingface_hub.errors import HfHubHTTPError, OfflineModeIsEnabled

    policy.require_stage("world_model")
    failures = (HfHubHTTPError, OfflineModeIsEnabled, httpx.HTTPError, OSError)
    api = HfApi()
    try:
        repo_id = api.create_repo(repo_id, private=private, exist_ok=True).repo_id
    except failures as e:
        raise HubUnreachableError(
            f"cannot create {repo_id} on {api.endpoint} ({type(e).__name__}: {e}). Check the connection and "
            "`hf auth login`; the filter on disk is untouched, push it again later"
        ) from e
    policy.config.repo_id = repo_id
    with TemporaryDirectory() as folder:
        save_filter(policy, Path(folder))
        card = policy.generate_model_card(dataset_repo_id, "latentsafe", policy.config.license, policy.config.tags)
        card.save(Path(folder) / "README.md")
        try:
            commit = api.upload_folder(repo_id=repo_id, folder_path=folder, commit_message=f"Push {policy.name} policy")
        except failures as e:
            raise HubUnreachableError(
                f"upload to {repo_id} broke off ({type(e).__name__}: {e}); the filter on disk is untouched, push again"
            ) from e
    return str(commit.repo_url)
