"""Recording episodes in this process, or in others while this one trains: the same episodes wherever it is done."""

from collections.abc import Iterator
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.collection.franka import SOURCES
from lerobot_latentsafe.envs.franka_env import BlocksEnv
from lerobot_latentsafe.experiments.blocks.replay import record
from lerobot_latentsafe.franka.actions import ACTION_NAMES, action_limits
from lerobot_latentsafe.franka.behaviors import Actions, begin
from lerobot_latentsafe.policies.dreamer.modeling_dreamer import LatentSafeDreamerPolicy
from lerobot_latentsafe.runtime.checkpoint import read_config

STRAYING = 2
"""In one of so many of the policy's episodes the hand is led astray."""
Job = tuple[int, Path | None]
"""An episode's number, and the folder of the policy that acts in it; None: a scripted operator does."""


class Recorder:
    """Records one episode after the other.

    Args:
        seed: of all of them.
        image_size: side of the pictures that are kept.
    """

    def __init__(self, seed: int, image_size: int):
        self.seed, self.image_size = seed, image_size
        self.env, self.source = BlocksEnv(), SOURCES["blocks_demos"]
        self.folder: Path | None = None

    def __call__(self, job: Job) -> dict[str, np.ndarray]:
        """Arrays of the episode, see `record`."""
        episode, folder = job
        if folder is None:
            rng = np.random.default_rng([self.seed, episode])
            actions = begin(self.source.behavior(episode), self.env.scene, None, rng)
            operator = _Scripted(actions, self.env.scene.fps, rng)
        else:
            torch.manual_seed(number(self.seed, 1, episode))
            rng = np.random.default_rng([self.seed, 1, episode]) if episode % STRAYING == 0 else None
            operator = _Exploring(self._policy(folder), rng)
        return record([self.env], [1_000_000 * self.seed + episode], operator, self.image_size)[0]

    def _policy(self, folder: Path) -> LatentSafeDreamerPolicy:
        if folder != self.folder:
            policy = LatentSafeDreamerPolicy.from_pretrained(folder, config=read_config(folder, "cpu"))
            self.policy, self.folder = policy.eval(), folder
        return self.policy


class Recorders:
    """A `Recorder` here, or one in each of `workers` processes.

    Attributes:
        env: an environment like those of the episodes.
    """

    def __init__(self, seed: int, image_size: int, workers: int):
        self.here, self.pool = Recorder(seed, image_size), None
        self.env = self.here.env
        if workers:
            self.pool = get_context("spawn").Pool(workers, _start, (seed, image_size))

    def __call__(self, episodes: list[int], folder: Path | None) -> Iterator[dict[str, np.ndarray]]:
        """Begin to record; episodes come in their order, as soon as there are."""
        jobs: list[Job] = [(episode, folder) for episode in episodes]
        return self.pool.imap(_record, jobs) if self.pool else map(self.here, jobs)

    def close(self) -> None:
        """End the processes."""
        self.env.close()
        if self.pool:
            self.pool.terminate()
            self.pool.join()


class _Straying:
    """Leads a hand astray now and then, for some steps at up to full speed, as a filter's fallback will do.

    Attributes:
        move: where to now, (3,) in [-1, 1]; None: nowhere.
    """

    def __init__(self, rng: np.random.Generator, rate: float):
        self.rng, self.rate, self.left, self.move = rng, rate, 0, None

    def advance(self) -> None:
        """Go on to the next step."""
        if self.left == 0 and self.rng.random() < self.rate:
            move = self.rng.uniform(-1, 1, 3)
            self.left = int(self.rng.integers(2, 7))
            self.move = move / np.abs(move).max() * self.rng.choice([0.5, 1.0])
        elif self.left == 0:
            self.move = None
        self.left = max(0, self.left - 1)


class _Scripted:
    """A scripted operator, whose hand does not always do what it means.

    While its fingers are open it is jostled; at any time it may be led astray. So a learner sees how to come back. When
    the operator has finished it holds still.

    Attributes:
        meant: the action (1, 7) of this step before that.
    """

    def __init__(self, operator: Actions, fps: int, rng: np.random.Generator):
        self.operator, self.rng, self.straying = operator, rng, _Straying(rng, 0.04)
        self.limits = action_limits(fps)
        self.meant = np.zeros((1, len(ACTION_NAMES)), np.float32)

    def __call__(self, batch: dict[str, Tensor]) -> np.ndarray:
        meant = next(self.operator, np.append(np.zeros(6), self.meant[0, 6]))
        self.meant, done = meant[None].astype(np.float32), meant.copy()
        self.straying.advance()
        if self.straying.move is not None:
            done[:3] = self.straying.move * self.limits[1][:3]
        elif meant[6] > 0.5 and self.rng.random() < 0.3:
            done[:3] += self.rng.normal(0, 0.006, 3)
            done[5] += self.rng.normal(0, 0.05)
        return np.clip(done, *self.limits)[None]


class _Exploring:
    """The policy, exploring.

    Args:
        rng: its hand is led astray now and then; None: it is not.
    """

    def __init__(self, policy: LatentSafeDreamerPolicy, rng: np.random.Generator | None):
        policy.reset()
        self.policy, self.straying = policy, None if rng is None else _Straying(rng, 0.06)

    def __call__(self, batch: dict[str, Tensor]) -> np.ndarray:
        action = self.policy.act(batch, explore=True)
        if self.straying is not None:
            self.straying.advance()
            if self.straying.move is not None:
                moved = self.policy.executed.clone()
                moved[:, :3] = torch.from_numpy(self.straying.move).to(moved)
                action = self.policy.model.units.denormalise_action(moved)
                self.policy.was_overridden(action)
        return action.cpu().numpy()


_recorder: Recorder
"""Of this process, if it is a worker."""


def _start(seed: int, image_size: int) -> None:
    global _recorder
    torch.set_num_threads(1)
    _recorder = Recorder(seed, image_size)


def _record(job: Job) -> dict[str, np.ndarray]:
    return _recorder(job)


def number(*parts: int) -> int:
    """A seed that depends on all parts."""
    return int(np.random.SeedSequence(parts).generate_state(1)[0])
