"""Small things that tests build: configurations, batches, policies."""

import dataclasses
import json
import shutil
import threading
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_latentsafe import LatentSafeConfig
from lerobot_latentsafe.critic import FallbackConfig, ReachabilityConfig
from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.decision import LawConfig
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.margin import MarginConfig
from lerobot_latentsafe.runtime.files import locked_folder
from lerobot_latentsafe.units import TrainedOn
from lerobot_latentsafe.world_models import RSSMConfig

GROUPS = {"margin": MarginConfig, "fallback": FallbackConfig, "law": LawConfig, "trained_on": TrainedOn}

REPO_ID = "me/car"
ACTION_DIM = 2
CANDIDATES = [[-1.25, 1.0], [0.0, 1.0], [1.25, 1.0]]


def rssm_config(**changes):
    sizes = dict(deterministic=16, stochastic=4, hidden=16, units=16, state_units=8, clip_length=8)
    return RSSMConfig(**{**sizes, **changes})


def reachability_config(**changes):
    sizes = dict(
        critic_hidden=(16,), actor_hidden=(16,), steps=20, pool=512, horizon=4, batch_size=32, refresh=10
    )  # fmt: skip
    return ReachabilityConfig(**{**sizes, **changes})


TOKEN_SIZE, COMPONENTS = 32, 8


def tokens(**changes):
    """Recipe of a token cache with the offline encoder."""
    from functools import partial

    from lerobot_latentsafe.datasets.cache_recipes import Tokens

    return partial(Tokens, **{"config": perception_config(), **changes})


def perception_config(**changes):
    from lerobot_latentsafe.encoders.perception import PerceptionConfig

    return PerceptionConfig(**{"encoder": "efficientnet_lite0", "components": COMPONENTS, **changes})


DINO = ("Dinov2Config", "Dinov2WithRegistersConfig", "DINOv3ViTConfig")
"""Names in transformers of the kinds of DINO."""


def save_dino(folder, kind=DINO[0]):
    """A DINO of a few random weights, saved as on the Hub; the name to load it by."""
    transformers = pytest.importorskip("transformers")
    torch.manual_seed(0)
    options = dict(hidden_size=32, num_hidden_layers=1, num_attention_heads=2, intermediate_size=64)
    if kind != "Dinov2Config":
        options["num_register_tokens"] = 4
    transformers.AutoModel.from_config(getattr(transformers, kind)(**options)).save_pretrained(folder)
    return str(folder)


def gru_config(**changes):
    from lerobot_latentsafe.world_models import GRUConfig

    sizes = dict(perception=perception_config(), image_size=TOKEN_SIZE, hidden=16, units=16, clip_length=8, observed=3)
    return GRUConfig(**{**sizes, **changes})


def dino_wm_config(**changes):
    from lerobot_latentsafe.world_models import DinoWMConfig

    sizes = dict(
        perception=perception_config(), image_size=TOKEN_SIZE, clip_length=8, dim=32, depth=2, heads=2, head_dim=8,
        mlp=32, embedding=4, summary=8, frame_skip=1, merge_patches=1, frame_token=False, token_weight=1.0,
        change_weight=0.7, observed=3,
    )  # fmt: skip
    return DinoWMConfig(**{**sizes, **changes})


def config(**changes):
    """A filter's configuration; entries of its groups are given by `<group>_<entry>`, such as law_epsilon."""
    options = dict(
        world_model=rssm_config(), reachability=reachability_config(), fallback_action_candidates=CANDIDATES,
        device="cpu", push_to_hub=False,
    )  # fmt: skip
    options |= changes
    for group, kind in GROUPS.items():
        entries = {name: options.pop(name) for name in list(options) if name.startswith(f"{group}_")}
        options[group] = kind(**{name.removeprefix(f"{group}_"): value for name, value in entries.items()})
    return LatentSafeConfig(**options)


def metadata(root, repo_id=REPO_ID):
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    return LeRobotDatasetMetadata(repo_id, root=root)


def altered_dataset(root, copy, fps=None, action_names=None):
    """Metadata of a copy of a cached dataset, as if recorded with another robot; its cache belongs to it."""
    from lerobot_latentsafe.datasets.frame_cache import dataset_fingerprint

    shutil.copytree(root, copy)
    info = json.loads((copy / "meta" / "info.json").read_text())
    info["fps"] = fps or info["fps"]
    info["features"]["action"]["names"] = action_names or info["features"]["action"]["names"]
    (copy / "meta" / "info.json").write_text(json.dumps(info))
    meta = metadata(copy)
    rewrite_json(copy / "frame_cache" / "manifest.json", fingerprint=dataset_fingerprint(meta))
    return meta


def new_policy(meta, **changes):
    """An untrained filter, as lerobot-train would make it."""
    from lerobot.policies.factory import make_policy

    return make_policy(config(**changes), ds_meta=meta)


def train_stage_one(meta, folder, steps=5, **changes):
    """A few gradient steps on world model and margin, then save as lerobot-train does."""
    from lerobot_latentsafe.runtime.hub import save_policy

    torch.manual_seed(0)
    policy = new_policy(meta, **changes).train()
    optimizer = torch.optim.Adam(policy.get_optim_params(), 1e-3)
    for _ in range(steps):
        loss, _ = policy.forward({"index": torch.randint(meta.total_frames, (16,))})
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    save_policy(policy, Path(folder))
    return folder


def save_franka_filter(folder, scene="blocks", **changes):
    """A filter of the simulated Franka's two cameras with random weights, saved as if it were trained."""
    from lerobot.configs.types import FeatureType, PolicyFeature

    from lerobot_latentsafe.franka.actions import ACTION_NAMES, STATE_NAMES, action_limits
    from lerobot_latentsafe.franka.scenes import SCENES
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
    from lerobot_latentsafe.runtime.hub import save_policy

    torch.manual_seed(0)
    cameras = [f"observation.images.{name}" for name in ("front", "wrist")]
    low, high = action_limits(SCENES[scene].fps)
    images = {key: PolicyFeature(FeatureType.VISUAL, (3, 32, 32)) for key in cameras}
    options = dict(
        fallback_action_candidates=None, fallback_frozen_commands=["gripper.pos"], law_lookahead=0,
        trained_on_cameras=cameras, trained_on_fps=SCENES[scene].fps, trained_on_stage="critic",
        input_features={**images, "observation.state": PolicyFeature(FeatureType.STATE, (len(STATE_NAMES),))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (len(ACTION_NAMES),))},
        trained_on_state_names=STATE_NAMES, trained_on_action_names=ACTION_NAMES,
        trained_on_action_low=low.tolist(), trained_on_action_high=high.tolist(),
        trained_on_action_varies=[True] * len(ACTION_NAMES), trained_on_state_mean=[0.0] * len(STATE_NAMES),
        trained_on_state_std=[1.0] * len(STATE_NAMES),
    )  # fmt: skip
    save_policy(LatentSafePolicy(config(**{**options, **changes})), Path(folder))
    return folder


ARM = ["lift.pos", "elbow.pos", "gripper.pos"]
"""Joint targets in degrees, and of a gripper."""
ARM_POSE = [-71.0, 68.0, 20.0]


def save_arm_filter(folder, names=ARM, meanings=None, **changes):
    """A filter of an arm that takes joint targets, with random weights, saved as if it were trained.

    Its data went from 30 degrees below ARM_POSE to 30 above, by at most 6 degrees at once; 99% of them by 3.
    """
    from lerobot.configs.types import FeatureType, PolicyFeature

    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
    from lerobot_latentsafe.runtime.hub import save_policy

    torch.manual_seed(0)
    n, key = len(names), "observation.images.front"
    pose, meanings = np.resize(ARM_POSE, n), meanings or dict.fromkeys(names, "target")
    moves = lambda target, other: [target if meanings[name] == "target" else other for name in names]  # noqa: E731
    options = dict(
        fallback_action_candidates=None, law_lookahead=0, trained_on_cameras=[key], trained_on_fps=30,
        trained_on_stage="critic",
        input_features={
            key: PolicyFeature(FeatureType.VISUAL, (3, 32, 32)),
            "observation.state": PolicyFeature(FeatureType.STATE, (n,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (n,))},
        trained_on_state_names=list(names), trained_on_action_names=list(names), trained_on_meanings=meanings,
        trained_on_action_low=(pose - 30).tolist(), trained_on_action_high=(pose + 30).tolist(),
        trained_on_action_varies=[True] * n, trained_on_displacement_low=moves(-6.0, 0.0),
        trained_on_displacement_high=moves(6.0, 0.0), trained_on_displacement_scale=moves(3.0, 1.0),
        trained_on_state_low=(pose - 30).tolist(), trained_on_state_high=(pose + 30).tolist(),
        trained_on_state_step=[2.0] * n, trained_on_state_mean=pose.tolist(), trained_on_state_std=[10.0] * n,
    )  # fmt: skip
    save_policy(LatentSafePolicy(config(**{**options, **changes})), Path(folder))
    return folder


def diffusion_config(action_dim=ACTION_DIM, **changes):
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig

    options = dict(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (2,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (action_dim,))},
        horizon=8, n_action_steps=4, down_dims=(16, 32), diffusion_step_embed_dim=16, noise_scheduler_type="DDIM",
        num_train_timesteps=10, num_inference_steps=2, drop_n_last_frames=0, device="cpu",
    )  # fmt: skip
    return DiffusionConfig(**{**options, **changes})


def save_diffusion(folder, action_dim=ACTION_DIM):
    """A DiffusionPolicy with random weights, saved with its processors as lerobot-train saves them."""
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
    from lerobot.policies.factory import make_pre_post_processors

    torch.manual_seed(1)
    config = diffusion_config(action_dim)
    bound = {key: torch.ones(n) for key, n in (("observation.state", 2), ("observation.environment_state", 2))}
    stats = {key: {"min": -1.1 * one, "max": 1.1 * one} for key, one in bound.items()}
    one = torch.ones(action_dim)  # the turn rate varies, the speed is constant
    stats["action"] = {"min": torch.cat([-1.25 * one[:1], one[1:]]), "max": torch.cat([1.25 * one[:1], one[1:]])}
    DiffusionPolicy(config).save_pretrained(folder)
    for pipeline in make_pre_post_processors(config, dataset_stats=stats):
        pipeline.save_pretrained(folder)
    return folder


def observation(states):
    """LeRobot batch that the car's environment gives in states (N, 3)."""
    seen = car.observe(np.atleast_2d(np.asarray(states, float)), car.Renderer())
    return {
        "observation.image": torch.from_numpy(seen["image"]).permute(0, 3, 1, 2) / 255.0,
        "observation.state": torch.from_numpy(seen["heading"]),
        "observation.environment_state": torch.from_numpy(seen["position"]),
    }


def drive(policy, n_steps=6, start=((-0.9, 0.1, 0.0), (-0.7, -0.3, 0.5))):
    """Decisions of a policy along an episode whose states do not depend on it."""
    states = np.asarray(start, float)
    policy.reset()
    decisions = []
    for t in range(n_steps):
        decisions.append(policy.decide(observation(states)))
        states = car.step(states, np.full(len(states), 0.5 * (-1) ** t))
    return decisions


def executed(decisions):
    """Actions of decisions: (T, B, A)."""
    return torch.stack([d.action for d in decisions])


def random_clip(batch=3, length=5, size=32, action_dim=ACTION_DIM, state_dim=2, key="observation.image"):
    """Noise in the shape of a training batch."""
    is_first = torch.zeros(batch, length, dtype=torch.bool)
    is_first[:, 0] = True
    return Clip(
        percepts={key: torch.rand(batch, length, 3, size, size)},
        state=torch.randn(batch, length, state_dim),
        action=torch.where(is_first[..., None], 0.0, 2 * torch.rand(batch, length, action_dim) - 1),
        is_first=is_first,
        valid=torch.ones(batch, length, dtype=torch.bool),
        failure=torch.randint(2, (batch, length)),
        terminal=torch.zeros(batch, length, dtype=torch.long),
    )


def rewrite_json(path, **changes):
    """Set top-level entries of a JSON file."""
    path = Path(path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def rewrite_group(folder, group, **changes):
    """Set entries of a group of a checkpoint's configuration."""
    file = Path(folder) / "config.json"
    rewrite_json(file, **{group: {**json.loads(file.read_text())[group], **changes}})


BLOCKS_FRAMES = 12


@contextmanager
def short_blocks():
    """Meanwhile episodes of the blocks have 12 frames, and the red blocks seem to fall after a quarter of a second."""
    from lerobot_latentsafe.franka import blocks
    from lerobot_latentsafe.franka.scenes import SCENES

    info = dataclasses.replace(SCENES["blocks"], episode_seconds=BLOCKS_FRAMES / SCENES["blocks"].fps)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SCENES, "blocks", info)
        patch.setattr(blocks.BlocksScene, "tilts", lambda self: np.full(2, 4 * self.data.time))
        yield


def dreamer_options(output_dir, **changes):
    """A run of `latentsafe train-dreamer` in seconds: two demonstrations, two rounds of two episodes."""
    from lerobot_latentsafe import LatentSafeDreamerConfig
    from lerobot_latentsafe.experiments.blocks.dreamer_training import TrainDreamer
    from lerobot_latentsafe.policies.dreamer.behavior import BehaviorConfig

    behavior = BehaviorConfig(hidden=16, bins=17, horizon=3, starts=8)
    model = config(
        world_model=rssm_config(image_size=16, classes=4, clip_length=6), fallback_action_candidates=None,
        fallback_frozen_commands=["gripper.pos"], law_lookahead=0, margin_layers=3,
    )  # fmt: skip
    policy = LatentSafeDreamerConfig(behavior=behavior, device="cpu", push_to_hub=False)
    options = dict(
        policy=policy, model=model, demonstrations=2, pretraining=3, steps=7, collect_every=2, n_envs=2, batch_size=4,
        save_every=2, log_every=1,
    )  # fmt: skip
    return TrainDreamer(output_dir=output_dir, **{**options, **changes})


@contextmanager
def written_elsewhere(folder):
    """Meanwhile something else writes an output folder."""
    entered, left = threading.Event(), threading.Event()

    def write():
        with locked_folder(folder):
            entered.set()
            left.wait()

    writer = threading.Thread(target=write)
    writer.start()
    entered.wait()
    try:
        yield
    finally:
        left.set()
        writer.join()
