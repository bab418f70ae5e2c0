"""What the simulated Franka does, measured on fresh seeds: the parts of results/franka."""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from scipy.optimize import minimize
from scipy.stats import mannwhitneyu

from lerobot_latentsafe.collection.franka import SOURCES, collect_franka
from lerobot_latentsafe.datasets.labels import FAILING, FailureLabels
from lerobot_latentsafe.evaluation.rollouts import steps
from lerobot_latentsafe.evaluation.statistics import provenance, wilson, write_json
from lerobot_latentsafe.experiments.scene_world import OperatorActor, SceneWorld
from lerobot_latentsafe.franka import bag
from lerobot_latentsafe.franka.actions import MAX_SPEED
from lerobot_latentsafe.franka.bag import BagScene
from lerobot_latentsafe.franka.behaviors import begin, grasp
from lerobot_latentsafe.franka.blocks import BlocksScene
from lerobot_latentsafe.franka.scene import FrankaScene, SceneState

OUT = Path("results/franka")
FIRST_SEED = 100_000
"""Settings were chosen on smaller seeds."""


def episode(scene: FrankaScene, behavior: str, seed: int, speed: float | None = None) -> Iterator[dict]:
    """Truth after each step of an episode of six (bag) or three (blocks) seconds."""
    scene.reset(seed)
    operator = OperatorActor(begin(behavior, scene, speed, np.random.default_rng([0, seed])))
    world = SceneWorld(scene, 90 if isinstance(scene, BagScene) else 60, cameras=())
    for step in steps(world, operator):
        yield step.info


def spills(n: int) -> dict:
    """Lifts by each part of the bag."""
    return {name: share_spilling(name, None, n) for name in ("closed_end", "middle", "open_end")}


def swings(n: int) -> dict:
    """Side to side, slow and fast."""
    return {f"{speed} m/s": share_spilling("side_to_side", speed, n) for speed in (0.04, 0.08, 0.15, 0.25, 0.30)}


def share_spilling(behavior: str, speed: float | None, n: int) -> dict:
    """Episodes in which any candy was spilled, and how many candies on average."""
    scene = BagScene()
    counts = [max(t["spilled"] for t in episode(scene, behavior, FIRST_SEED + i, speed)) for i in range(n)]
    row = {"any_candy": wilson(sum(c > 0 for c in counts), n), "mean_candies": float(np.mean(counts))}
    print(behavior, speed, row, flush=True)
    return row


def variants(n: int) -> dict:
    """Whether the grasp lifts each variant of the bag."""
    row = {}
    for variant in bag.VARIANTS:
        scene = BagScene(variant)
        last = [[*episode(scene, "open_end", FIRST_SEED + i)][-1] for i in range(n)]
        sealed = [max(t["spilled"] for t in episode(scene, "closed_end", FIRST_SEED + i)) for i in range(n // 2)]
        row[variant] = {
            "lifted": wilson(sum(t["lifted"] for t in last), n),
            "open_end_spilled": wilson(sum(t["spilled"] > 0 for t in last), n),
            "closed_end_spilled": wilson(sum(c > 0 for c in sealed), n // 2),
        }
        print(variant, row[variant], flush=True)
    return row


def explosions(n: int) -> dict:
    """Random episodes in which MuJoCo warned, or anything moved faster than 30 m/s (rad/s)."""
    scene, exploded, fastest, failed = BagScene(), [], [], 0
    for i in range(n):
        speed, any_failure = 0.0, False
        for truth in episode(scene, "random", FIRST_SEED + i):
            speed = max(speed, np.abs(scene.data.qvel).max())
            any_failure |= truth["failure"]
            if scene.exploded() and FIRST_SEED + i not in exploded:
                exploded.append(FIRST_SEED + i)
        fastest.append(speed)
        failed += any_failure
    levels = dict(zip(("p50", "p99", "max"), np.percentile(fastest, [50, 99, 100]).tolist()))
    return {"episodes": n, "exploded": len(exploded), "of_seeds": exploded, "fastest": levels, "failing": failed}


def retreats(rng: np.random.Generator, n_random: int = 6) -> Iterator[np.ndarray]:
    """Constant velocities (3,) in m per step to try from a state: hold, lower, lower sideways, random."""
    fastest = MAX_SPEED / 15
    yield np.zeros(3)
    for share in (0.33, 0.67, 1.0):
        yield np.array([0, 0, -share * fastest])
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        yield fastest * np.array([0.67 * x, 0.67 * y, -1])
    yield from fastest * rng.uniform([-1, -1, -1], [1, 1, 0.33], (n_random, 3))


def recoverable(scene: BagScene, state: SceneState, rng: np.random.Generator) -> bool:
    """Whether some retreat from a state spills nothing within 25 steps."""
    for velocity in retreats(rng):
        scene.set_state(state)
        for _ in range(25):
            scene.step(np.array([*velocity, 0, 0, 0, 0.0]))
            if scene.truth()["spilled"]:
                break
        else:
            return True
    return False


def doomed(n: int) -> dict:
    """Steps between the last state from which some retreat spills nothing and the first candy seen outside."""
    scene, rng, leads = BagScene(), np.random.default_rng(0), []
    for i in range(n):
        states = []
        for truth in episode(scene, "closed_end", FIRST_SEED + i):
            if truth["spilled"]:
                break
            states.append(scene.get_state())
        lead = 0
        while lead < len(states) and not recoverable(scene, states[-1 - lead], rng):
            lead += 1
        leads.append(lead)
        print("lead of doomed over visible, steps:", lead, flush=True)
    return {"lifts": n, "median_lead_steps": float(np.median(leads)), "lead_steps": leads, "retreats_tried": 14}


def leak(n: int) -> dict:
    """Equally many closed-end and open-end grasps; proprioception when the fingers have closed."""
    scene, seen, closed = BagScene(), [], []
    for i in range(n):
        rng, end = np.random.default_rng([1, i]), i % 2
        scene.reset(FIRST_SEED + i // 2)
        for action in grasp(scene, bag.TAIL if end else bag.MOUTH, rng):
            scene.step(action)
        seen.append(scene.proprioception())
        closed.append(end)
    x, y, half = np.array(seen, float), np.array(closed), n // 2
    auc = area_under_curve(y[half:], logistic_scores(x[:half], y[:half], x[half:]))
    return {"grasps": n, "held_out": n - half, "auc": auc, "distance_from_chance": abs(auc - 0.5)}


def logistic_scores(x: np.ndarray, y: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Scores (M,) of a logistic regression with an L2 penalty of 1 on standardised features."""
    mean, std = x.mean(0), x.std(0) + 1e-9
    x, test = (np.hstack([(a - mean) / std, np.ones((len(a), 1))]) for a in (x, test))
    sign = 2 * y - 1
    loss = lambda w: np.logaddexp(0, -sign * (x @ w)).sum() + 0.5 * w[:-1] @ w[:-1]  # noqa: E731
    return test @ minimize(loss, np.zeros(x.shape[1])).x


def area_under_curve(truth: np.ndarray, scores: np.ndarray) -> float:
    """Chance that a positive scores higher than a negative."""
    positive, negative = scores[truth == 1], scores[truth == 0]
    return float(mannwhitneyu(positive, negative).statistic / len(positive) / len(negative))


def plucks(n: int) -> dict:
    """Careful and careless plucking."""
    scene, row = BlocksScene(), {}
    for behavior in ("pluck_careful", "pluck_careless"):
        ends = [[*episode(scene, behavior, FIRST_SEED + i)] for i in range(n)]
        touched = sum(not e[-1]["failure"] and max(t["tilt"] for t in e) > 0.05 for e in ends)
        row[behavior] = {
            "success": wilson(sum(e[-1]["is_success"] for e in ends), n),
            "toppled": wilson(sum(e[-1]["failure"] for e in ends), n),
            "tilted_without_failing": wilson(touched, n),
            "steps_from_tipping_to_failure": float(
                np.median([t for t in map(_tipping, ends) if t is not None] or [-1])
            ),
        }
        print(behavior, row[behavior], flush=True)
    return row


def _tipping(truths: list[dict]) -> int | None:
    """Steps from the tilt a block does not come back from (0.25 rad) to the failure."""
    tilt = np.array([t["tilt"] for t in truths])
    return int(np.argmax(tilt > 1.0) - np.argmax(tilt > 0.25)) if tilt.max() > 1.0 else None


def render(n: int) -> dict:
    """Wall time of one 224 x 224 image of the grasped bag, ours against a model with default <visual>."""
    scene = BagScene()
    scene.reset(FIRST_SEED)
    for action in grasp(scene, bag.MIDDLE, np.random.default_rng(0)):
        scene.step(action)
    defaults = mujoco.MjModel.from_xml_string(mujoco.MjSpec.from_string("<mujoco/>").to_xml()).vis.quality
    ours = seconds_a_frame(scene.render, n)
    quality = scene.model.vis.quality
    for name in ("shadowsize", "offsamples", "numslices", "numstacks", "numquads"):
        setattr(quality, name, getattr(defaults, name))
    scene.close()  # the settings are read when the context is made
    default = seconds_a_frame(scene.render, max(2, n // 50))
    return {
        "pixels": scene.image_size,
        "ours_ms": 1e3 * ours, "default_ms": 1e3 * default, "times_faster": default / ours,
        "frames_a_second": 1 / ours, "mujoco": mujoco.__version__,
    }  # fmt: skip


def seconds_a_frame(draw, n: int) -> float:
    """Wall seconds of an image, the two cameras in turn, after one each to warm up."""
    draw("front"), draw("wrist")
    began = time.perf_counter()
    for i in range(n):
        draw(("front", "wrist")[i % 2])
    return (time.perf_counter() - began) / n


def recording(n: int) -> dict:
    """All threads' CPU time, after one recording to warm up; label balance of what was recorded."""
    row = {}
    for source in ("bag_mix", "blocks_demos"):
        with tempfile.TemporaryDirectory() as folder:
            collect_franka(source, "me/warm", f"{folder}/warm", 1, 1)
            began = time.process_time()
            dataset = collect_franka(source, "me/timed", f"{folder}/timed", n, 0)
            seconds = (time.process_time() - began) / n
            labels = FailureLabels.load(dataset.root)
            failing = np.unique(labels.episode[labels.failure == 1])
            row[source] = {
                "cpu_seconds_an_episode": seconds,
                "episodes": n,
                "frames": dataset.num_frames,
                "failing_episodes": len(failing),
                "failing_frames": int((labels.failure == 1).sum()),
            }
        print(source, row[source], flush=True)
    return row


def balance(n: int) -> dict:
    """What each dataset recorded by scripts/collect_franka.sh holds; its first n episodes at most."""
    rows = {}
    for name in SOURCES:
        columns = LeRobotDataset(f"latentsafe/{name}", root=Path("data") / name).hf_dataset.with_format("numpy")
        episode = np.asarray(columns["episode_index"])
        kept = episode < n
        failing = (np.asarray(columns["failure"]).reshape(-1) == FAILING) & kept
        success = np.asarray(columns["next.success"]).reshape(-1) & kept
        rows[name] = {
            "episodes": len(set(episode[kept])),
            "frames": int(kept.sum()),
            "failing_episodes": len(set(episode[failing])),
            "failing_frames": int(failing.sum()),
            "successful_episodes": len(set(episode[success])),
        }
        print(name, rows[name], flush=True)
    return rows


PARTS = {
    "spills": (spills, 100), "swings": (swings, 50), "variants": (variants, 50), "explosions": (explosions, 1000),
    "doomed": (doomed, 20), "leak": (leak, 400), "plucks": (plucks, 100), "render": (render, 400),
    "recording": (recording, 20), "balance": (balance, 10_000),
}  # fmt: skip


def measure(part: str, n: int | None = None) -> None:
    """Measure a part, over n episodes or its own default, and write results/franka/<part>.json."""
    function, default = PARTS[part]
    n, began = n or default, time.process_time()
    row = function(n)
    minutes = (time.process_time() - began) / 60
    # The datasets are recorded with the seed that latentsafe collect takes by default.
    seeds = [0] if part == "balance" else [FIRST_SEED, FIRST_SEED + n - 1]
    write_json(OUT / f"{part}.json", {**row, **provenance(seeds, minutes)})
    print(part, {k: v for k, v in row.items() if not isinstance(v, dict)}, f"{minutes:.1f} CPU minutes", flush=True)
