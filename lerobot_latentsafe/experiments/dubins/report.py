"""What the report on a filter says of the car beyond other environments: where it went, and the exact safe set."""

from pathlib import Path

from lerobot_latentsafe.experiments.dubins.figures import trajectories, value_slices
from lerobot_latentsafe.experiments.dubins.monitor import LatentMonitor
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reports import figures, html


def car_parts(policy: LatentSafePolicy, result: dict | None, folder: Path) -> list[str]:
    """Parts of the page; see `reports.filter_report.Extra`."""
    parts = []
    if result is not None:
        figures.save(trajectories(result["episodes"]), folder / "paths.png")
        parts.append(
            html.picture(folder / "paths.png", "Where the car went. Red entered the disc; orange: the filter acts.")
        )
    figures.save(value_slices({"latent": LatentMonitor(policy.model)}), folder / "slices.png")
    return [
        *parts,
        html.heading("The safe set it learnt from images"),
        html.picture(
            folder / "slices.png",
            "The value over the car's position for two headings. Solid: where the filter draws the line; dashed: the "
            "exact one, known for this simulated car only.",
        ),
    ]
