#!/usr/bin/env python
"""A filter of the bag at work: a diffusion policy and operators, bare and shielded from the same starts.

Nothing is trained. Runs scripts/bag_policies.py and scripts/bag_operators.py, small enough for two cores, and writes
outputs/demo_bag/report.html and outputs/demo_bag/metrics.json. Numbers of full size are in results/bag.
"""

import argparse
import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from lerobot_latentsafe.evaluation import report as html
from lerobot_latentsafe.evaluation.demo import Demo

OPERATORS = {"closed_end": "pulls the closed end up", "open_end": "lifts the open end"}


def run(demo: Demo, filter: str, base: str, law: str, n: int) -> None:
    """Both experiments, side by side on two cores."""
    few = max(1, n // 2)
    policies = (
        f"diffusion policy: {n} starts, bare and shielded",
        *("python", "scripts/bag_policies.py", f"--weak={base}", "--filters", filter, "--laws", law),
        *(f"--n={n}", "--n_videos=3", f"--output={demo.out}/policies.json"),
    )
    operators = (
        f"operators: {few} lifts by either end, bare and shielded",
        *("python", "scripts/bag_operators.py", "--filters", filter, "--laws", law, "--operators"),
        *(*OPERATORS, f"--n={few}", f"--output={demo.out}/operators.json"),
    )
    with ThreadPoolExecutor(2) as cores:
        for done in [cores.submit(demo.run, *step) for step in (policies, operators)]:
            done.result()


def cells(out: Path, law: str) -> dict[str, dict]:
    """Who acted -> what came of it."""
    policies, operators = (json.loads((out / f"{name}.json").read_text()) for name in ("policies", "operators"))
    found = {"diffusion policy": policies["weak"]["bare"], "the same, shielded": policies["weak"][law]["pooled"]}
    for name, does in OPERATORS.items():
        found[f"operator {does}"] = operators[name]["bare"]
        found[f"the same operator ({name}), shielded"] = operators[name][law]["pooled"]
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
    weak = json.loads((out / "policies.json").read_text())["weak"][law]
    (p_value,) = (cell["paired_p"] for name, cell in weak.items() if name != "pooled")
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
                "A robot should lift an open bag without spilling. A diffusion policy has learnt from careless "
                "demonstrations, and an operator pulls as if the bag were sealed. The filter sees two cameras and the "
                "arm's own state; it lets them act, and takes over when nothing else would keep the candies inside."
            ),
            html.heading("Bare and shielded from the same starts"),
            html.table(header, rows),
            html.paragraph(
                "Shares with 95% Wilson intervals. Exact test of the paired difference of the policy's spills: "
                f"p = {p_value:.1g}."
            ),
            *(
                html.video(path, "bare | shielded; orange: the filter acts")
                for path in sorted(out.glob("videos/*.mp4"))
            ),
            html.picture(out / "severity.png", "How many runs of the policy spill at least p% of the candies."),
            html.heading("What the filter sees coming"),
            html.picture(
                out / "operators.png",
                "V along operators' lifts. Orange: the filter acts. Grey lines: a candy first falls out.",
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
    print(f"\nspills of the policy, bare against shielded: p = {p_value:.1g}")
    print(f"{metrics['minutes']} minutes. Open {out / 'report.html'}; numbers in {out / 'metrics.json'}")


def main() -> None:
    from lerobot.configs.policies import PreTrainedConfig

    from lerobot_latentsafe.checkpoint import resolve_checkpoint

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/demo_bag"))
    parser.add_argument("--policy", required=True, help="the filter: a folder, a Hub id or a committed name")
    parser.add_argument("--base", required=True, help="the policy to be shielded, likewise")
    parser.add_argument("--n", type=int, default=20, help="starts of the policy; operators get half as many")
    arguments = parser.parse_args()
    law = PreTrainedConfig.from_pretrained(resolve_checkpoint(arguments.policy)).law
    resolve_checkpoint(arguments.base)
    if arguments.out.exists():
        shutil.rmtree(arguments.out)
    demo = Demo(arguments.out)
    run(demo, arguments.policy, arguments.base, law, arguments.n)
    report(arguments.out, law, demo.seconds)


if __name__ == "__main__":
    main()
