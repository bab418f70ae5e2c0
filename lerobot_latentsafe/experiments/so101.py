"""ACT policies and operators push the cube with the SO-101, bare and under filters, from the same starts; and what the
policies command."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STATE
from tqdm import trange

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.envs.configuration_envs import LatentSafeSO101Env
from lerobot_latentsafe.evaluation.rollouts import Episodes, count_reasons, run_episodes, steps
from lerobot_latentsafe.evaluation.statistics import paired_p_value, wilson
from lerobot_latentsafe.experiments.scene_world import OperatorActor, SceneWorld
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.so101.actions import CAMERAS, EPISODE_SECONDS, FPS, NAMES, REST
from lerobot_latentsafe.so101.operators import Targets, begin
from lerobot_latentsafe.so101.scene import STATE, PushScene

FIRST_SEED = 100_000_000
"""Of the starts: none that a dataset was recorded from."""
JOINTS = slice(STATE.index(NAMES[0]), None)


def compare_policies(bases: Mapping[str, str], filters: Sequence[str], n: int, law: LawOptions) -> dict[str, dict]:
    """Each policy bare, under each filter, and under all of them together, as `latentsafe eval-shield` writes it.

    Args:
        bases: name -> path of the policy.
        filters: paths.
        n: starts.
        law: changes of the filters' law.
    """
    table = {}
    for name, path in bases.items():
        bare, runs = run(BasePolicy.load(path), n), {}
        for filter in filters:
            runs[filter] = run(load_filter(filter, law=law, base_policy=path), n)
            print(f"{name} under {filter}: {in_short(bare)} bare, {in_short(runs[filter])} shielded", flush=True)
        table[name] = {
            "bare": bare.rates(),
            "shielded": Episodes.joined(list(runs.values())).rates(),
            "filters": {filter: {**shielded.rates(), **_beside(bare, shielded)} for filter, shielded in runs.items()},
        }
    return table


def compare_laws(base: str, filters: Sequence[str], laws: Sequence[str], n: int) -> dict[str, dict]:
    """A policy bare, and under each filter by each law, from n starts.

    Args:
        base, filters: paths.

    Returns:
        `bare`, and law -> filter's path: rates, and under a filter those that `compare_policies` gives beside them.
    """
    bare = run(BasePolicy.load(base), n)
    table: dict[str, dict] = {"bare": bare.rates()}
    for law in laws:
        table[law] = {}
        for filter in filters:
            shielded = run(load_filter(filter, law=LawOptions(name=law), base_policy=base), n)
            print(f"{law} of {filter}: {in_short(bare)} bare, {in_short(shielded)} shielded", flush=True)
            table[law][filter] = {**shielded.rates(), **_beside(bare, shielded)}
    return table


def compare_operators(filters: Sequence[str], n: int, law: LawOptions) -> dict[str, dict]:
    """The reckless and the careful operator from n starts, bare and under each filter.

    Returns:
        operator -> bare, or the filter's path: rates of falls and successes, and the share of steps overridden.
    """
    scene, table = PushScene(), dict[str, dict]()
    for behavior in ("reckless", "careful"):
        cells: dict[str, LatentSafePolicy | None] = {
            "bare": None,
            **{path: load_filter(path, law=law) for path in filters},
        }
        table[behavior] = {}
        for name, filter in cells.items():
            rows = [operate(scene, filter, behavior, FIRST_SEED + i) for i in trange(n, desc=f"{behavior}, {name}")]
            table[behavior][name] = {
                **{key: wilson(sum(row[key] for row in rows), n) for key in ("violation", "success")},
                "overridden_share": float(np.mean([row["overridden"] for row in rows])),
            }
    return table


def operate(scene: PushScene, filter: LatentSafePolicy | None, behavior: str, seed: int) -> dict:
    """One episode of an operator, who keeps the arm where it is at the end."""
    scene.reset(seed)
    operator = kept(begin(behavior, scene, np.random.default_rng([3, seed])))
    world = SceneWorld(scene, round(EPISODE_SECONDS * FPS), () if filter is None else CAMERAS)
    done = list(steps(world, OperatorActor(operator, filter)))
    fell = any(step.info["failure"] for step in done)
    overridden = [step.decision is not None and step.decision.intervened.item() for step in done]
    return {
        "violation": fell,
        "success": bool(done[-1].info["is_success"] and not fell),
        "overridden": float(np.mean(overridden)),
    }


def kept(targets: Targets) -> Iterator[np.ndarray]:
    """The targets, and the last of them ever after."""
    last = REST
    for last in targets:
        yield last
    while True:
        yield last


def run(policy: BasePolicy | LatentSafePolicy, n: int) -> Episodes:
    """Episodes from the first n starts."""
    return run_episodes(policy, LatentSafeSO101Env(), n, FIRST_SEED)


def _beside(bare: Episodes, shielded: Episodes) -> dict:
    reasons = [reason for trace in shielded.traces for reason in trace["reason"]]
    return {
        "violation_p_value": paired_p_value(bare.violation, shielded.violation),
        "reasons": count_reasons(reasons),
    }


def in_short(runs: Episodes) -> str:
    """Falls, successes and stalls in words."""
    n = len(runs.success)
    return f"{runs.violation.sum()} of {n} fall, {runs.success.sum()} succeed, {runs.stall.sum()} stall"


def ranges_left(path: str, dataset: LeRobotDataset, n: int) -> dict:
    """How far a bare policy's commands and displacements leave what its dataset shows, in shares of that range.

    Args:
        path: of the policy.
        dataset: that it learned from.
        n: starts.
    """
    runs = run(BasePolicy.load(path), n)
    action = np.concatenate([trace["action"] for trace in runs.traces])
    joints = np.concatenate([np.array(trace["state"])[:-1, JOINTS] for trace in runs.traces])
    shown, pose = (np.array(dataset.hf_dataset.with_format("numpy")[key]) for key in (ACTION, OBS_STATE))
    return {
        "commands": _left(action, shown),
        "displacements": _left(action - joints, shown - pose),
        "steps": len(action),
        "outcome": in_short(runs),
    }


def _left(values: np.ndarray, shown: np.ndarray) -> dict:
    """Of values (N, 6): shares of steps that leave the range of those shown (M, 6), at all and by more; by how much."""
    low, high = shown.min(0), shown.max(0)
    beyond = np.maximum(np.maximum(low - values, values - high), 0) / (high - low)
    worst = beyond.max(1)
    return {
        "leave_it": float((worst > 0).mean()),
        **{f"by_more_than_{share:g}": float((worst > share).mean()) for share in (0.02, 0.05, 0.1, 0.2)},
        "beyond": {f"p{q}": float(np.percentile(worst, q)) for q in (50, 90, 99, 100)},
        "each": {name: float(part) for name, part in zip(NAMES, (beyond > 0).mean(0))},
    }
