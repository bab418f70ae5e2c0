"""What the law `nearest` changes beside `reachability`: who fails, succeeds and stalls, and how much is changed."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from lerobot.envs.configs import EnvConfig

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.encoders.perception import Perception
from lerobot_latentsafe.envs.configuration_envs import LatentSafeBlocksEnv, LatentSafeDubinsEnv
from lerobot_latentsafe.evaluation.rollouts import Actor, PolicyActor, VectorWorld, World, run_episodes
from lerobot_latentsafe.evaluation.statistics import paired_p_value, provenance, run_resumable, wilson, write_rows
from lerobot_latentsafe.experiments.bag import operators
from lerobot_latentsafe.experiments.bag.runs import STEPS
from lerobot_latentsafe.experiments.blocks.table2 import CURVE_SEED
from lerobot_latentsafe.experiments.filter_settings import FilterSetting, as_job, fingerprint
from lerobot_latentsafe.experiments.scene_world import OperatorActor, SceneWorld
from lerobot_latentsafe.franka.bag import BagScene
from lerobot_latentsafe.franka.behaviors import begin
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.nearest import Distance

LAWS = ("reachability", "nearest")
TIMED = {
    **{law: LawOptions(name=law) for law in LAWS},
    "nearest, compiled": LawOptions(name="nearest", engine="onnx"),
}
"""Whose ticks are timed. Filters that draw futures cannot be compiled: torch decides for them."""
OUTCOMES = ("violation", "success", "stall")
TICKS_SEED = 1_000
"""Of the episodes that are timed, counted from a study's first seed."""
WARM_UP = 3
"""Ticks of an episode that are not timed."""


class Study(NamedTuple):
    """Who is shielded by which filter.

    Attributes:
        filter: path.
        drivers: name -> path of a policy; of the bag, name of an operator.
        env: where policies drive; None: an operator and the bag.
        first_seed: of the starts. Settings are chosen on others.
        together: episodes side by side at most, as `latentsafe eval-shield` runs them.
    """

    filter: str
    drivers: dict[str, str]
    env: type[EnvConfig] | None
    first_seed: int
    together: int


STUDIES = {
    "car": Study(
        "dubins",
        {name: f"dubins_diffusion_{name}" for name in ("reckless", "careful")},
        LatentSafeDubinsEnv,
        960_000,
        50,
    ),
    "bag": Study("bag", {name: name for name in ("closed_end", "side_to_side_0.15")}, None, 320_000, 1),
    # From the starts on which thresholds of SQRL are compared, see `blocks.table2`.
    "blocks": Study("blocks", {"dreamer": "blocks_dreamer"}, LatentSafeBlocksEnv, CURVE_SEED, 10),
}


def jobs_of(name: str, driver: str, n: int) -> dict[str, list[dict]]:
    """`bare` and each law -> jobs for so many starts, of one driver of a study."""
    study = STUDIES[name]
    settings = {"bare": None, **{law: FilterSetting.of(study.filter, LawOptions(name=law)) for law in LAWS}}
    made_of = None if study.env is None else fingerprint(study.drivers[driver])
    job = {"study": name, "driver": driver, "made_of": made_of}
    parts = [{"seed": study.first_seed + i, "n": min(study.together, n - i)} for i in range(0, n, study.together)]
    return {law: [{**job, "filter": as_job(s), **part} for part in parts] for law, s in settings.items()}


def run(job: dict) -> dict:
    """Episodes from n starts.

    Returns:
        episodes: of each violation, success, stall; and of each step under a filter: changed, adjusted (see
        `FilterDecision`), and deviation from the proposal in standardised units.
    """
    torch.set_num_threads(1)
    study, setting = STUDIES[job["study"]], FilterSetting.from_job(job["filter"])
    if study.env is None:
        return {"episodes": [outcome(operators.run({**job, "operator": study.drivers[job["driver"]]}))]}
    return {"episodes": drive(study.env(), study.drivers[job["driver"]], setting, job["n"], job["seed"])}


def drive(env: EnvConfig, base: str, setting: FilterSetting | None, n: int, seed: int) -> list[dict]:
    """Episodes of a policy in an environment, bare or under a filter, from n starts; see `run`."""
    policy = operators.load(setting, base)
    runs = run_episodes(policy, env, n, seed)
    rows: list[dict] = [{name: bool(getattr(runs, name)[i]) for name in OUTCOMES} for i in range(n)]
    if not isinstance(policy, LatentSafePolicy):
        return rows
    distance = Distance(policy.model.units)
    for row, trace in zip(rows, runs.traces):
        done, wanted = (np.array(trace[name], np.float32) for name in ("action", "proposed"))
        away = distance(done, wanted).round(4).tolist()
        row |= {"changed": trace["intervened"], "adjusted": trace["adjusted"], "deviation": away}
    return rows


def outcome(row: dict) -> dict:
    """An episode of the bag, see `drive`: what became of it, and what was changed."""
    spilled, success = row["lost"] > 0, bool(row["success"])
    outcome = {"violation": spilled, "success": success and not spilled, "stall": not (success or spilled)}
    return {**outcome, "changed": row["intervened"], "adjusted": row["adjusted"], "deviation": row["deviation"]}


def cell(rows: list[dict]) -> dict:
    """Outcomes with Wilson intervals; and under a filter what it changed, over all steps of all episodes."""
    found = {name: wilson(sum(row[name] for row in rows), len(rows)) for name in OUTCOMES}
    changed, adjusted, away = (
        np.concatenate([np.array(row.get(name, []), float) for row in rows])
        for name in ("changed", "adjusted", "deviation")
    )
    if not len(changed):
        return found
    return {
        **found,
        "steps": len(changed),
        "changed_share": float(changed.mean()),
        "fallback_share": float((changed - adjusted).mean()),
        "deviation": float(away.mean()),
        "deviation_of_changed": float(away[changed > 0].mean()) if changed.any() else 0.0,
    }


def against(cells: dict[str, dict], rows: dict[str, list[dict]]) -> dict:
    """The law `nearest` beside `reachability`: deviations and shares as ratios, and a paired test of violations."""
    ours, theirs = cells["nearest"], cells["reachability"]
    names = ("deviation", "deviation_of_changed", "changed_share", "fallback_share")
    return {
        **{name: ours[name] / theirs[name] if theirs[name] else None for name in names},
        "violation_p_value": paired_p_value(*(np.array([row["violation"] for row in rows[law]]) for law in LAWS)),
    }


# -- what a tick costs ---


class Timed(NamedTuple):
    """An episode that goes on in turn with others.

    Attributes:
        policy: CPU seconds of each proposal, part of those of the tick.
    """

    world: World
    actor: Actor
    policy: list[float]


def begin_timed(name: str, driver: str, law: LawOptions, seed: int) -> Timed:
    """An episode of a study under a law."""
    study = STUDIES[name]
    proposing: list[float] = []
    if study.env is None:
        scene = BagScene()
        scene.reset(seed)
        behavior, speed = operators.OPERATORS[driver]
        operator = begin(behavior, scene, speed, np.random.default_rng([0, seed]))
        return Timed(SceneWorld(scene, STEPS), OperatorActor(operator, load_filter(study.filter, law=law)), proposing)
    policy = load_filter(study.filter, law=law, base_policy=BasePolicy.load(study.drivers[driver]))
    policy.base.propose = timed(policy.base.propose, proposing)
    return Timed(VectorWorld(study.env(), [seed]), PolicyActor(policy), proposing)


def timed(function: Callable, costs: list[float]) -> Callable:
    """The function, whose CPU seconds are appended."""

    def call(*given: object) -> object:
        began = time.process_time()
        result = function(*given)
        costs.append(time.process_time() - began)
        return result

    return call


def tick_cost(name: str, driver: str, n: int) -> dict:
    """CPU milliseconds of ticks under TIMED in turn: of the filter alone, and with the policy that it shields.

    A process has one encoder: once a filter is compiled, the encoder is, for the others, too.
    """
    took: dict[str, dict[str, list[float]]] = {law: {"filter": [], "with_policy": []} for law in TIMED}
    for seed in range(STUDIES[name].first_seed + TICKS_SEED, STUDIES[name].first_seed + TICKS_SEED + n):
        runs = {law: begin_timed(name, driver, options, seed) for law, options in TIMED.items()}
        costs: dict[str, list[float]] = {law: [] for law in TIMED}
        actors = {law: timed(runs[law].actor, costs[law]) for law in TIMED}
        while not any(of.world.over.all() for of in runs.values()):
            for law, of in runs.items():
                Perception.forget()  # or one would look at the tokens of the other
                of.world.step(actors[law](of.world.observe()).action)
        for law, of in runs.items():
            whole, proposing = np.array(costs[law]), np.array(of.policy or [0.0] * len(costs[law]))
            took[law]["with_policy"] += whole[WARM_UP:].tolist()
            took[law]["filter"] += (whole - proposing)[WARM_UP:].tolist()
    quantiles = {"p50": 0.5, "p99": 0.99}
    found = {
        law: {
            what: {q: 1e3 * float(np.quantile(seconds, share)) for q, share in quantiles.items()}
            for what, seconds in parts.items()
        }
        for law, parts in took.items()
    }
    for law, ratio in (("nearest", "ratio"), ("nearest, compiled", "ratio_compiled")):
        found[ratio] = {
            what: {q: found[law][what][q] / found["reachability"][what][q] for q in quantiles}
            for what in ("filter", "with_policy")
        }
    return {**found, "ticks": len(took["nearest"]["filter"])}


# -- the study ---


def study(counts: dict[str, int], n_timed: int, output: Path, workers: int = 1) -> None:
    """Run all cells and write the table, where rows of other studies stay; each episode is kept as it ends.

    Args:
        counts: name of a study -> starts.
        n_timed: episodes of each driver that are timed.
    """
    jobs = {(name, who): jobs_of(name, who, n) for name, n in counts.items() for who in STUDIES[name].drivers}
    every = [job for laws in jobs.values() for cell_jobs in laws.values() for job in cell_jobs]
    ran = iter(run_resumable(output.with_suffix(".jsonl"), every, run, workers))
    summary, minutes = {}, 0.0
    for (name, who), laws in jobs.items():
        parts = {law: [next(ran) for _ in cell_jobs] for law, cell_jobs in laws.items()}
        minutes += sum(part["cpu_s"] for of in parts.values() for part in of) / 60
        rows = {law: [row for part in of for row in part["episodes"]] for law, of in parts.items()}
        cells = {law: cell(of) for law, of in rows.items()}
        found = {**cells, "nearest_to_reachability": against(cells, rows)}
        found["tick_ms"] = tick_cost(name, who, n_timed)
        summary[f"{name}, {who}"] = found
        print(name, who, in_short(found), flush=True)
    seeds = [STUDIES[name].first_seed + end for name, n in counts.items() for end in (0, n - 1)]
    write_rows(output, summary, provenance(seeds, minutes))


def in_short(found: dict) -> str:
    """A driver's figures on one line."""
    outcomes = lambda of: " ".join(f"{name} {of[name]['k']}/{of[name]['n']}" for name in OUTCOMES)  # noqa: E731
    cells = "; ".join(f"{law}: {outcomes(found[law])}" for law in ("bare", *LAWS))
    away, ticks = found["nearest_to_reachability"]["deviation"], found["tick_ms"]["ratio"]
    return f"{cells}; deviation {away and round(away, 2)} x, tick p99 {ticks['filter']['p99']:.2f} x"
