"""A guard made of a dataset alone, and a filter that learns what a guard knows: nothing is trained."""

from dataclasses import replace

from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.critic import ReachabilityConfig
from lerobot_latentsafe.datasets.adoption import adopt_dataset, with_limits
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.frame_cache import FOLDER, FrameCache
from lerobot_latentsafe.datasets.live_cameras import looks_of
from lerobot_latentsafe.decision import LawConfig
from lerobot_latentsafe.margin import MarginConfig
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.units import TrainedOn
from lerobot_latentsafe.world_models import NoneConfig


def new_guard(
    meta: LeRobotDatasetMetadata, contract: Contract, meanings: dict[str, str] | None = None,
    cameras: list[str] | None = None,
) -> LatentSafePolicy:  # fmt: skip
    """A guard of a dataset.

    Args:
        contract: of the episodes to learn from.
        meanings: command -> meaning, of those that names and data do not tell.
        cameras: those to guard; None: all.

    Raises:
        MeaningError: what a command means cannot be told.
        ValueError: no such camera, or actions that never change.
    """
    cache = FrameCache.open(meta.root, meta) if not meta.camera_keys and (meta.root / FOLDER).exists() else None
    shapes = contract.cameras if cache is None else {key: (3, *[cache.image_size] * 2) for key in cache.percepts}
    missing = [key for key in cameras or [] if key not in shapes]
    if missing or not shapes:
        raise ValueError(f"{contract.repo_id} lacks the camera {', '.join(missing) or 'images'}; it has {[*shapes]}")
    trained_on = adopt_dataset(TrainedOn(meanings=meanings, cameras=sorted(cameras or shapes)), contract)
    trained_on = replace(trained_on, stage="guard", looks=looks_of(meta, contract, trained_on, cache))
    inputs = {key: PolicyFeature(FeatureType.VISUAL, shapes[key]) for key in trained_on.cameras}
    if contract.state_names:
        inputs[OBS_STATE] = PolicyFeature(FeatureType.STATE, (len(contract.state_names),))
    config = LatentSafeConfig(
        world_model=NoneConfig(),
        margin=MarginConfig(hidden=1, layers=1),
        reachability=ReachabilityConfig(critic_hidden=(), actor_hidden=()),
        law=LawConfig(name="guard", lookahead=0),
        trained_on=trained_on,
        input_features=inputs,
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (len(contract.action_names),))},
        device="cpu",
        push_to_hub=False,
    )
    return LatentSafePolicy(config).eval()


def with_guard(policy: LatentSafePolicy, meta: LeRobotDatasetMetadata, contract: Contract) -> LatentSafePolicy:
    """A filter that knows what the cameras of a dataset look like, and its limits if it did not know them.

    Raises:
        ValueError: the dataset is of another robot, rate or range, or has no pictures of the filter's cameras.
    """
    known = adopt_dataset(policy.config.trained_on, contract)
    looks = looks_of(meta, contract, known)
    if looks is None:
        raise ValueError(
            f"{contract.repo_id} has no pictures of {', '.join(known.cameras)}: give the dataset with its videos, not "
            "its cache"
        )
    policy.config.change(trained_on=replace(with_limits(known, contract), looks=looks))
    return policy
