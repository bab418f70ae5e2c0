"""Episodes of the blocks study, bare, filtered and under the privileged bound, and how long V warns before l does."""

from functools import cache, lru_cache

import numpy as np
import torch

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.envs.configuration_envs import LatentSafeBlocksEnv
from lerobot_latentsafe.envs.franka_env import BlocksEnv
from lerobot_latentsafe.evaluation.rollouts import Choice, PolicyActor, check_environment, steps
from lerobot_latentsafe.experiments.blocks.simulator_lookahead import SimulatorLookahead
from lerobot_latentsafe.experiments.blocks.worlds import EnvironmentsWorld
from lerobot_latentsafe.experiments.scene_world import FRONT, picture
from lerobot_latentsafe.franka.blocks import POINT_OF_NO_RETURN
from lerobot_latentsafe.franka.scene import FrankaScene
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.policies.dreamer.modeling_dreamer import stored_world_model
from lerobot_latentsafe.runtime.checkpoint import read_config
from lerobot_latentsafe.runtime.locations import resolve_checkpoint
from lerobot_latentsafe.safety_model import SafetyModel


@cache
def blocks_env() -> BlocksEnv:
    """The blocks of this process."""
    return BlocksEnv()


@lru_cache(maxsize=1)
def load(dreamer: str, filter: str | None, mode: str, epsilon: float | None) -> BasePolicy | LatentSafePolicy:
    """The task policy, under a filter if there is one, by their paths; of a risk critic, epsilon is -eps_risk."""
    torch.set_num_threads(1)
    if filter is None:
        return BasePolicy.load(dreamer)
    policy = load_filter(filter, law=LawOptions(mode=mode, epsilon=epsilon), base_policy=dreamer, device="cpu")
    check_environment(policy, LatentSafeBlocksEnv())
    return policy


def world_model_of(dreamer: str) -> str:
    """Path of a stored task policy's world model."""
    folder = resolve_checkpoint(dreamer)
    return stored_world_model(folder, read_config(folder))


class LookaheadActor:
    """A policy under the privileged bound: the simulator itself says which of its actions pass.

    Attributes:
        overridden: how many did not.
    """

    def __init__(self, policy: BasePolicy, scene: FrankaScene):
        self.policy, self.actor = policy, PolicyActor(policy)
        self.look_ahead, self.overridden = SimulatorLookahead(scene), 0

    def __call__(self, batch: dict) -> Choice:
        action, retreats = self.look_ahead(self.actor(batch).action[0])
        if retreats:
            self.overridden += 1
            self.policy.replan(torch.from_numpy(action).float()[None])
        return Choice(action[None])


def run(job: dict) -> dict:
    """One episode; the job holds seed, mode, and what `load` takes.

    Modes: bare; filter; lookahead, the filter that knows the simulator; monitor, in which a filter only looks on.

    Returns:
        success, the block was picked up and no red one fell (the paper's); violation; held, it is up at the end;
        leaning, the episode ended with a red block that has not fallen yet, but will; steps; overridden; of what was
        looked on at, also margin and value, l and V of each step, and foreseen, V of its proposal, which the law reads.
    """
    return run_filmed(job)[0]


@torch.no_grad()
def run_filmed(job: dict) -> tuple[dict, list[np.ndarray]]:
    """The row of `run`, and the front camera's pictures."""
    env, policy = blocks_env(), load(job["dreamer"], job["filter"], job["mode"], job["epsilon"])
    torch.manual_seed(job["seed"])
    world = EnvironmentsWorld([env], [job["seed"]])
    actor, bound = PolicyActor(policy), LookaheadActor(policy, env.scene) if job["mode"] == "lookahead" else None
    frames, latents, foreseen, overridden, lifted = [], [], [], 0, False
    for step in steps(world, bound or actor):
        frames.append(picture(step.seen[FRONT]))
        if step.decision is not None:
            overridden += bool(step.decision.intervened)
            latents.append(actor.latent)
            foreseen.append(step.decision.value.item())
        lifted |= step.info[0]["lifted"]
    (info,) = world.info
    failed = info["failure"]
    row = {
        "success": lifted and not failed, "violation": failed, "held": info["is_success"],
        "leaning": bool(info["tilt"] > POINT_OF_NO_RETURN) and not failed, "steps": env.steps,
        "overridden": bound.overridden if bound else overridden,
    }  # fmt: skip
    if job["mode"] == "monitor" and isinstance(policy, LatentSafePolicy):
        row |= {name: column.tolist() for name, column in zip(("margin", "value"), values_of(policy.model, latents))}
        row |= {"foreseen": foreseen}
    return row, frames


@torch.no_grad()
def values_of(model: SafetyModel, latents: list[Latent]) -> tuple[np.ndarray, np.ndarray]:
    """l and V at each latent of an episode itself, not one step on: (T,) each."""
    together = {key: torch.cat([latent[key] for latent in latents]) for key in latents[0]}
    return model.imagination.margin(together).cpu().numpy(), model.value(together).cpu().numpy()


def lead(margin: np.ndarray, value: np.ndarray, epsilon: float) -> int | None:
    """Steps from the first V <= epsilon to the first l < 0 of an episode (T,); negative: V comes later, or never.

    A V that never warns counts as warning at the end. None: l never sees a failure.
    """
    failing, warned = np.flatnonzero(margin < 0), np.flatnonzero(value <= epsilon)
    if not len(failing):
        return None
    return int(failing[0] - (warned[0] if len(warned) else len(value)))
