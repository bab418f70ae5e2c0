"""A filter of the bag at work: a policy, if one is given, and operators, bare and shielded from the same starts."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from lerobot_latentsafe.experiments.bag.demo_filter import FilterSizes, train_filter
from lerobot_latentsafe.experiments.demo import (
    NO_GUARANTEE,
    SIDE_BY_SIDE,
    Demo,
    durations,
    told,
    where_the_minutes_went,
)
from lerobot_latentsafe.experiments.filter_settings import law_of
from lerobot_latentsafe.model_card import rate_in_words
from lerobot_latentsafe.reports import html
from lerobot_latentsafe.runtime.locations import resolve_checkpoint

MODULES = ("lerobot_latentsafe.registration", "lerobot_latentsafe.modeling_latentsafe", "lerobot.policies.factory")
"""What all commands import, but MuJoCo."""
USUAL_MINUTES = {"policies": 2.3, "closed_end": 0.4, "open_end": 0.3}
"""Of CPU time, for the progress bar."""
OPERATORS = {"closed_end": "pulls the closed end up", "open_end": "lifts the open end"}


def run_experiments(demo: Demo, filter: str, base: str | None, law: str, n: int) -> None:
    """The experiments, side by side on two cores."""
    few = max(1, n // 2)
    options = ("--filters", filter, "--laws", law)
    steps = [
        (
            f"{name}: {few} lifts by an operator who {does}, bare and shielded",
            *("python", "scripts/bag_operators.py", *options, "--operators", name),
            *(f"--n={few}", f"--output={demo.out}/{name}.json"),
        )
        for name, does in OPERATORS.items()
    ]
    if base is not None:  # first, for it takes longest
        steps.insert(0, (
            f"policies: {n} starts of the policy, bare and shielded",
            *("python", "scripts/bag_policies.py", f"--weak={base}", *options),
            *(f"--n={n}", "--n_videos=2", f"--output={demo.out}/policies.json"),
        ))  # fmt: skip
    with ThreadPoolExecutor(2) as cores:
        for done in [cores.submit(demo.run, *step) for step in steps]:
            done.result()


def run_demo(out: Path, filter: str, base: str | None, n: int, encoder: str | None, sizes: FilterSizes) -> None:
    """Run the experiments, and write report.html and metrics.json.

    Args:
        out: folder; what is there is deleted.
        filter, base: paths of the filter, and of a policy to shield.
        n: starts of the policy; operators get half as many.
        encoder: by which a filter is trained first, which takes the place of `filter`; None: none is trained.
        sizes: of that training.
    """
    if encoder is None:  # whatever is wrong is said before anything is deleted
        law_of(filter)
    else:
        sizes = sizes.fitting(encoder)
    if base is not None:
        resolve_checkpoint(base)
    if out.exists():
        shutil.rmtree(out)
    demo = Demo(out, MODULES, USUAL_MINUTES if encoder is None else None)
    if encoder is not None:
        filter = train_filter(demo, encoder, sizes)
    law = law_of(filter).name
    run_experiments(demo, filter, base, law, n)
    demo.finish()
    demo.say("write the report")
    report(out, law, demo.seconds, demo.minutes)


def cells(out: Path, law: str) -> dict[str, dict]:
    """Who acted -> what came of it."""
    found = {}
    if (out / "policies.json").exists():
        policy = json.loads((out / "policies.json").read_text())["weak"]
        found = {"policy": policy["bare"], "the same, shielded": policy[law]["pooled"]}
    for name, does in OPERATORS.items():
        operator = json.loads((out / f"{name}.json").read_text())[name]
        found[f"operator {does}"] = operator["bare"]
        found[f"the same operator ({name}), shielded"] = operator[law]["pooled"]
    return found


HEADER = ["", "spilled any candy", "share of candies lost", "safe success", "steps overridden"]


def report(out: Path, law: str, seconds: float, minutes: dict[str, float]) -> None:
    """Print the table; write metrics.json and report.html."""
    found = cells(out, law)
    rows = [
        [
            who, rate_in_words(cell["spilled"]), f"{cell['mean_share_lost']:.1%}", rate_in_words(cell["success"]),
            f"{cell['overridden_share']:.1%}" if "overridden_share" in cell else "",
        ]
        for who, cell in found.items()
    ]  # fmt: skip
    lifts = json.loads((out / "closed_end.json").read_text())["closed_end"][law]
    (p_value,) = (cell["paired_p"] for name, cell in lifts.items() if name != "pooled")
    kept = ("spilled", "success", "mean_share_lost", "overridden_share")
    metrics = {
        **{who: {key: cell[key] for key in kept if key in cell} for who, cell in found.items()},
        "spilled_p_value": p_value,
        **durations(seconds, minutes),
    }
    (out / "metrics.json").write_text(json.dumps(metrics, indent=2))
    title = "A latent safety filter keeps candies in an open bag"
    html.write_report(out / "report.html", title, page(out, rows, p_value, minutes))
    print()
    for row in [HEADER, *rows]:
        print(f"{row[0]:<45}", *(f"{cell:<30}" for cell in row[1:]))
    print(f"\nspills of lifts by the closed end, bare against shielded: p = {p_value:.1g}")
    print(told(out, metrics))


def page(out: Path, rows: list[list[str]], p_value: float, minutes: dict[str, float]) -> list[str]:
    """The parts of report.html."""
    seen = "V along lifts. Orange: the filter acts. Grey: a candy falls out."
    spills = "How many runs of the policy spill at least p% of the candies."
    return [
        html.paragraph(
            "A robot should lift an open bag without spilling, but operators, and policies that learned from them, "
            "may pull as if it were sealed. The filter sees two cameras and the arm's own state; it lets them act, "
            "and takes over when nothing else would keep the candies inside. Who lifts the open end it should "
            "leave alone."
        ),
        html.heading("Bare and shielded from the same starts"),
        html.table(HEADER, rows),
        html.paragraph(
            "Shares with 95% Wilson intervals. Exact test of the paired difference of the spills of lifts by the "
            f"closed end: p = {p_value:.1g}."
        ),
        *(html.video(path, SIDE_BY_SIDE) for path in sorted(out.glob("videos/*.mp4"))),
        *(html.picture(path, spills) for path in out.glob("policies.png")),
        html.heading("What the filter sees coming"),
        *(html.picture(out / f"{name}.png", seen) for name in OPERATORS),
        *where_the_minutes_went(minutes),
        html.paragraph(f"A few runs for a demonstration; results/bag holds the full ones. {NO_GUARANTEE}", note=True),
    ]
