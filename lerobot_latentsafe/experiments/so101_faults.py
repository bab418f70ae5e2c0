"""What a shielded SO-101 does when something breaks: how far it moves at rest, how large its steps are in motion."""

from collections.abc import Callable
from contextlib import nullcontext

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.evaluation.faults import BROKEN, FAULTS, FAULTS_OF_DEGREES
from lerobot_latentsafe.experiments.scene_world import SceneWorld
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.so101.operators import begin
from lerobot_latentsafe.so101.scene import PushScene

SETTLED, MOVING, BROKEN_FOR = 10, 45, 8
"""Steps at rest, or of an operator's push, before something breaks; and steps for which it is broken."""
INCOMING = {**FAULTS, **FAULTS_OF_DEGREES}
NOTHING_IS_SAFE = 2.0
"""A threshold that V never exceeds."""


def fault_motions(path: str, seeds: range) -> dict[str, dict[str, float]]:
    """Every fault, on an arm at rest that is to stay, and in the middle of a push.

    Args:
        path: of a filter.
        seeds: of the starts.

    Returns:
        Fault -> the largest of all starts of: `moved_at_rest`, of any joint within BROKEN_FOR steps, degrees; and
        `step` and `step_nothing_safe`, the displacement that is commanded in motion, by the filter's own threshold and
        where the fallback must act, in shares of the largest displacement of the data.
    """
    policy, scene, table = load_filter(path), PushScene(), {}
    own = policy.config.law.epsilon
    for fault in [*INCOMING, *BROKEN]:
        rest = [_moved_at_rest(policy, scene, seed, fault) for seed in seeds]
        steps = {}
        for name, policy.config.law.epsilon in (("step", own), ("step_nothing_safe", NOTHING_IS_SAFE)):
            steps[name] = max(_largest_step(policy, scene, seed, fault) for seed in seeds)
        policy.config.law.epsilon = own
        table[fault] = {"moved_at_rest": max(rest), **steps}
        print(fault, {name: round(value, 3) for name, value in table[fault].items()}, flush=True)
    scene.close()
    return table


def _moved_at_rest(policy: LatentSafePolicy, scene: PushScene, seed: int, fault: str) -> float:
    scene.reset(seed)
    stay = scene.targets.copy()
    moved = []
    _drive(policy, scene, lambda: stay, SETTLED, fault, lambda *_: moved.append(scene.proprioception()))
    return float(np.abs(np.array(moved) - moved[0]).max())


def _largest_step(policy: LatentSafePolicy, scene: PushScene, seed: int, fault: str) -> float:
    scene.reset(seed)
    operator = begin("reckless", scene, np.random.default_rng(seed), False)
    trained_on, shares = policy.config.trained_on, []
    largest = np.maximum(np.abs(trained_on.displacement_low), trained_on.displacement_high)

    def note(action: np.ndarray, joints: np.ndarray) -> None:
        shares.append(np.abs(action - joints) / largest)

    _drive(policy, scene, lambda: next(operator, scene.targets), MOVING, fault, note)
    return float(np.max(shares))


def _drive(
    policy: LatentSafePolicy, scene: PushScene, wanted: Callable[[], np.ndarray], sound: int, fault: str,
    note: Callable[[np.ndarray, np.ndarray], object],
) -> None:  # fmt: skip
    """Steps under a filter that lets all pass, then steps under its own law, with a fault, each of which is noted."""
    policy.reset()
    world, law = SceneWorld(scene, sound + BROKEN_FOR), policy.config.law
    epsilon, law.epsilon = law.epsilon, -NOTHING_IS_SAFE
    for _ in range(sound):
        world.step(policy.shield(world.observe(), _row(wanted())).action.numpy())
    law.epsilon = epsilon
    with BROKEN[fault](policy.shield) if fault in BROKEN else nullcontext():
        for _ in range(BROKEN_FOR):
            given = {"observation": world.observe(), "proposed": _row(wanted())}
            joints = scene.proprioception()
            action = policy.shield(**INCOMING.get(fault, dict)(given)).action.numpy()
            note(action[0], joints)
            world.step(action)


def _row(targets: np.ndarray) -> Tensor:
    return torch.from_numpy(targets).float()[None]
