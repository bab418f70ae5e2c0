#!/usr/bin/env python
"""A filter of the bag at work: a policy, if one is given, and operators, bare and shielded from the same starts.

Nothing is trained. Runs scripts/bag_operators.py and scripts/bag_policies.py, small enough for two cores, and writes
outputs/demo_bag/report.html and outputs/demo_bag/metrics.json. Numbers of full size are in results/bag.
"""

import argparse
import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from lerobot_latentsafe.experiments.demo import Demo
from lerobot_latentsafe.reports import html as html

OPERATORS = {"closed_end": "pulls the closed end up", "open_end": "lifts the open end"}


def run(demo: Demo, filter: str, base: str | None, law: str, n: int) -> None:
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
            *(f"--n={n}", "--n_videos=3", f"--output={demo.out}/policies.json"),
        ))  # fmt: skip
    with ThreadPoolExecutor(2) as cores:
        for done in [cores.submit(demo.run, *step) for step in steps]:
            done.result()


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


def report(out: Path, law: str, seconds: float) -> None:
    """Print the table; write metrics.json and report.html."""
    found = cells(out, law)
    header = ["", "spilled any candy", "share of candies lost", "safe success", "steps overridden"]
    rows = [
        [
            who, html.share(cell["spilled"]), f"{cell['mean_share_lost']:.1%}", html.share(cell["success"]),
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
        "minutes": round(seconds / 60, 1),
    }
    (out / "metrics.json").write_text(json.dumps(metrics, indent=2))
    html.write_report(
        out / "report.html",
        "A latent safety filter keeps candies in an open bag",
        [
            html.paragraph(
                "A robot should lift an open bag without spilling, but operators, and policies that learned from them, "
                "may pull as if it were sealed. The filter sees two cameras and the arm's own state; it lets them act, "
                "and takes over when nothing else would keep the candies inside. Who lifts the open end it should "
                "leave alone."
            ),
            html.heading("Bare and shielded from the same starts"),
            html.table(header, rows),
            html.paragraph(
                "Shares with 95% Wilson intervals. Exact test of the paired difference of the spills of lifts by the "
                f"closed end: p = {p_value:.1g}."
            ),
            *(
                html.video(path, "bare | shielded; orange: the filter acts")
                for path in sorted(out.glob("videos/*.mp4"))
            ),
            *(
                html.picture(path, "How many runs of the policy spill at least p% of the candies.")
                for path in out.glob("policies.png")
            ),
            html.heading("What the filter sees coming"),
            *(
                html.picture(out / f"{name}.png", "V along lifts. Orange: the filter acts. Grey: a candy falls out.")
                for name in OPERATORS
            ),
            html.paragraph(
                "A few runs for a demonstration; results/bag holds the full ones. A learned filter is not a certified "
                "safety device: it carries no guarantee.",
                note=True,
            ),
        ],
    )
    print()
    for row in [header, *rows]:
        print(f"{row[0]:<45}", *(f"{cell:<30}" for cell in row[1:]))
    print(f"\nspills of lifts by the closed end, bare against shielded: p = {p_value:.1g}")
    print(f"{metrics['minutes']} minutes. Open {out / 'report.html'}; numbers in {out / 'metrics.json'}")


def main() -> None:
    from lerobot_latentsafe.runtime.checkpoint import read_config, resolve_checkpoint

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/demo_bag"))
    parser.add_argument("--policy", default="bag", help="the filter: a folder, a Hub id or a committed name")
    parser.add_argument("--base", help="a policy to be shielded, likewise")
    parser.add_argument("--n", type=int, default=12, help="starts of the policy; operators get half as many")
    arguments = parser.parse_args()
    law = read_config(resolve_checkpoint(arguments.policy)).law
    if arguments.base:
        resolve_checkpoint(arguments.base)
    if arguments.out.exists():
        shutil.rmtree(arguments.out)
    demo = Demo(arguments.out)
    run(demo, arguments.policy, arguments.base, law, arguments.n)
    report(arguments.out, law, demo.seconds)


if __name__ == "__main__":
    main()
