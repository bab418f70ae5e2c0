"""What a person writes in a notebook: load a filter, shield a policy, decide, look along an episode, train, evaluate.

from lerobot_latentsafe import evaluate_filter, load_filter

shielded = load_filter("dubins", base_policy="dubins_diffusion_reckless")
result = evaluate_filter(shielded, "latentsafe_dubins", n_episodes=20)
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts.lerobot_train import train

import lerobot_latentsafe.registration  # noqa: F401  (environments are looked up by name)
from lerobot_latentsafe._compat import quiet_decoder
from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.datasets.build_cache import build_frame_cache
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.folder import open_dataset
from lerobot_latentsafe.datasets.frame_cache import FOLDER
from lerobot_latentsafe.decision import FilterDecision, LawOptions
from lerobot_latentsafe.evaluation.along_episodes import EpisodeValues
from lerobot_latentsafe.evaluation.along_episodes import values_along as model_values_along
from lerobot_latentsafe.evaluation.rollouts import compare
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.reports.figures import write_videos
from lerobot_latentsafe.runtime.locations import resolve_checkpoint
from lerobot_latentsafe.runtime.processors import load_processors
from lerobot_latentsafe.training import train_reachability

quiet_decoder()  # a notebook has no other place to ask for it


def shield_policy(
    policy: PreTrainedPolicy | str | Path,
    filter: LatentSafePolicy | str | Path,
    *,
    preprocessor: PolicyProcessorPipeline | None = None,
    postprocessor: PolicyProcessorPipeline | None = None,
    law: LawOptions | None = None,
) -> LatentSafePolicy:
    """A policy behind a safety filter: it acts wherever the filter finds its action safe.

    Args:
        policy: an object of LeRobot; or its folder, Hub id or committed name.
        filter: a loaded filter; or its folder, Hub id or committed name.
        preprocessor, postprocessor: of the policy object; by default those of the checkpoint it was loaded from.
        law: changes of the filter's law, such as LawOptions(epsilon=0.3).

    Raises:
        ValueError: an object without processors that was loaded from nowhere, or of another action space.
    """
    if not isinstance(filter, LatentSafePolicy):
        filter = load_filter(filter, law=law)
    elif law is not None:
        filter.config.change(law=filter.config.law.changed(law))
    if isinstance(policy, PreTrainedPolicy):
        if preprocessor is None or postprocessor is None:
            if not policy.config.pretrained_path:
                raise ValueError(
                    f"this {policy.name} policy was loaded from no checkpoint, so its processors are not known; "
                    "give preprocessor= and postprocessor= (LeRobot's make_pre_post_processors makes them)"
                )
            folder = resolve_checkpoint(policy.config.pretrained_path)
            preprocessor, postprocessor = load_processors(policy.config, folder)
        policy = BasePolicy(policy, preprocessor, postprocessor)
    filter.attach(policy)
    return filter


def decide(filter: LatentSafePolicy, observation: Mapping[str, np.ndarray], action: Sequence[float]) -> FilterDecision:
    """The filter's decision on one action of one robot; it remembers what it is shown until `filter.reset()`.

    Args:
        observation: as LeRobot's datasets name it: pictures (H, W, 3), uint8, and observation.state (S,).
        action: (A,) in robot units.

    Returns:
        A batch of one: action, value, margin, intervened, reason.
    """
    arrays = {key: np.asarray(observation[key]) for key in observation}
    batch = prepare_observation_for_inference(arrays, filter.model.device)
    proposed = torch.as_tensor(np.asarray(action, np.float32))[None]
    return filter.shield(batch, proposed)


def values_along(
    filter: LatentSafePolicy, dataset: LeRobotDataset | str, episode: int, root: str | Path | None = None
) -> EpisodeValues:
    """V and l of each frame of a recorded episode, as the filter sees it from the first frame on.

    Args:
        dataset: a LeRobotDataset, or its id.
        root: its folder, if only the id is given and it is not in LeRobot's home.

    Raises:
        DatasetContractError: no dataset in that folder, or a broken one.
        ValueError: the dataset is of another robot, rate or camera than the filter's.
    """
    if not isinstance(dataset, LeRobotDataset):
        dataset = open_dataset(dataset, root)
    return model_values_along(filter.model, DatasetFrames(dataset.meta), episode)


def evaluate_filter(
    filter: LatentSafePolicy,
    env: EnvConfig | str,
    n_episodes: int = 50,
    seed: int = 0,
    video: str | Path | None = None,
    n_videos: int = 3,
) -> dict:
    """Run the shielded policy and the bare one from the same starts.

    Args:
        filter: with a base policy, see `shield_policy`.
        env: an environment, or its type, such as "latentsafe_dubins".
        video: a folder for videos of the first episodes, bare and shielded side by side.

    Returns:
        `bare` and `shielded`: success, violation, stall and incompletion as {k, n, low, high} with 95% Wilson
        intervals, and overridden_share; violation_p_value; reasons; episodes: both as `Episodes`.

    Raises:
        ValueError: nothing to shield, or an environment of another rate, action space or camera.
    """
    env = EnvConfig.get_choice_class(env)() if isinstance(env, str) else env
    result = compare(filter, env, n_episodes, seed, n_videos if video else 0)
    if video:
        write_videos(result["episodes"], video, env.fps)
    return result


def train_filter(
    repo_id: str,
    output_dir: str | Path,
    *,
    root: str | Path | None = None,
    config: LatentSafeConfig | None = None,
    steps: int = 3000,
    batch_size: int = 16,
    reachability_steps: int | None = None,
    seed: int = 0,
) -> LatentSafePolicy:
    """Train a filter on a labelled dataset: world model and margin by lerobot-train, then reachability.

    Args:
        repo_id, root: of a LeRobotDataset with failure labels (see `latentsafe label`), cached or not.
        output_dir: gets `cache/` (unless the dataset is cached), `world_model/` and `filter/`.
        config: world model, margin and law; by default an RSSM of 32 x 32 pixels for two cores.
        steps, batch_size: of lerobot-train.
        reachability_steps: gradient steps of the critic; by default the configuration's.

    Raises:
        DatasetContractError: a dataset that cannot be used as it is.
        UnlabelledDatasetError: no failure labels.
        FileExistsError: output_dir holds a filter already.
    """
    config = config or LatentSafeConfig(device="cpu", push_to_hub=False, scheduler_steps=steps)
    dataset, output_dir = open_dataset(repo_id, root), Path(output_dir)
    if not (Path(dataset.root) / FOLDER).exists():
        build_frame_cache(dataset, output_dir / "cache", config.world_model.image_size)
        dataset = open_dataset(f"{repo_id}_cache", output_dir / "cache")
    cache = str(dataset.root)
    run = TrainPipelineConfig(
        dataset=DatasetConfig(repo_id=dataset.repo_id, root=cache),
        policy=replace(config, frame_cache=cache),
        output_dir=output_dir / "world_model",
        job_name="latentsafe",
        steps=steps,
        save_freq=steps,
        batch_size=batch_size,
        seed=seed,
        num_workers=0,
        env_eval_freq=0,
    )
    train(run)
    checkpoint = output_dir / "world_model" / "checkpoints" / "last" / "pretrained_model"
    return train_reachability(checkpoint, dataset.meta, output_dir / "filter", seed, reachability_steps).eval()
