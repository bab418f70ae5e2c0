"""The report on a filter: what it is, what it changes, and what it saw and feared when it acted."""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from lerobot.envs.configs import EnvConfig

from lerobot_latentsafe.calibration import Calibration, in_words
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.evaluation.nearest_frames import NearestFrames
from lerobot_latentsafe.evaluation.rollouts import Episodes, check_environment, compare, count_reasons
from lerobot_latentsafe.evaluation.statistics import provenance, wilson
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.model_card import fallback, how_epsilon_was_set, rate_in_words, threshold
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reports import figures, html
from lerobot_latentsafe.reports.recorded_episodes import RecordedEpisodes

SHOWN, LOOKED_THROUGH, IMAGINED, PRINTED = 3, 12, 16, 8
"""Episodes shown, among how many they are picked, steps of imagination, pictures on paper."""

Extra = Callable[[LatentSafePolicy, dict | None, Path], list[str]]
"""What a study adds to the report on its environment: filter, comparison (see `compare`) or None, and a folder for
pictures, to parts of the page."""

INTRODUCTION = (
    "A safety filter watches what a robot sees. At every step it imagines, with a model of the world learnt from "
    "recordings, what the robot's next action leads to, and asks how close to failure things would get even if "
    "everything were done to avoid it from then on. That number is the value V: positive means that some way out is "
    "left. While V is above a threshold the robot's own policy acts; at or below it, the filter's fallback takes over."
)


def write_filter_report(
    path: Path, policy: LatentSafePolicy, env: EnvConfig | None, n_episodes: int, seed: int,
    recorded: DatasetFrames | None = None, extra: Extra | None = None,
    misses: dict[str, dict[str, int]] | None = None,
) -> None:  # fmt: skip
    """Write the report.

    Args:
        env: with a base policy, the policy is run there first, bare and shielded from the same starts.
        recorded: a dataset; what `latentsafe record` stored is shown, and where the world model cannot draw, its frames
            illustrate what was imagined, beside those of the episodes that are run.
        extra: what to add of the environment.
        misses: study -> cause -> episodes that were not warned of in time; see `evaluation.misses`.

    Raises:
        ValueError: nothing is run, and the dataset was not recorded under a filter.
    """
    policy.model.require_trained_for_law()
    if recorded is not None and env is None and not RecordedEpisodes.is_one(recorded):
        raise ValueError(
            f"{recorded.meta.repo_id} was not recorded under a filter (latentsafe record), so nothing tells what one "
            "changed; record under it, give --env.type as well, or ask latentsafe check-labels what it thinks of these"
        )
    seen = None if policy.model.world_model.draws else NearestFrames(policy.model)
    if seen is not None and recorded is not None:
        seen.add_dataset(recorded)
    with TemporaryDirectory() as folder:
        parts = [html.paragraph(INTRODUCTION), *_about(policy), *_misses(misses or {}, Path(folder))]
        if env is not None:
            parts += _evaluation(policy, env, n_episodes, seed, Path(folder), seen, extra)
        if recorded is not None and RecordedEpisodes.is_one(recorded):
            parts += _recording(RecordedEpisodes(policy.model, recorded), policy, Path(folder), seen)
        made = provenance(seeds=[seed])
        parts += [
            html.paragraph(
                "A learned filter is not a certified safety device: it carries no guarantee, and knows only what its "
                "recordings covered.",
                note=True,
            ),
            html.paragraph(f"Made by {made['command']} at commit {made['commit']}, {made['date']}."),
        ]
        html.write_report(path, "What this safety filter does", parts)


def _evaluation(
    policy: LatentSafePolicy, env: EnvConfig, n_episodes: int, seed: int, folder: Path,
    seen: NearestFrames | None, extra: Extra | None,
) -> list[str]:  # fmt: skip
    """What the filter changes in an environment, and what it knows of it."""
    check_environment(policy, env)
    parts, result = [], None
    if policy.base is not None:
        result = compare(policy, env, n_episodes, seed, min(n_episodes, LOOKED_THROUGH), seen)
        parts += _comparison(result, folder)
        parts += _episodes(result["episodes"], policy, env, folder, seen)
    if extra is not None:
        parts += extra(policy, result, folder)
    return parts


def _about(policy: LatentSafePolicy) -> list[str]:
    config, trained_on, outdated = policy.config, policy.config.trained_on, policy.outdated()
    set_how = how_epsilon_was_set(config.calibration, outdated)
    ranges = [f"{name} from {low:.3g} to {high:.3g}" for name, (low, high) in trained_on.ranges.items()]
    rows = [
        ["sees", f"{', '.join(trained_on.cameras)}; {', '.join(trained_on.state_names)}"],
        ["acts on", ", ".join(ranges)],
        ["rate", f"{trained_on.fps} steps a second"],
        ["failure means", f"the recordings' label {config.margin.failure_specification!r}"],
        ["threshold", f"epsilon = {threshold(config.law)}, set {set_how}"],
        ["fallback", fallback(config.law)],
        ["mode", "overrides unsafe actions" if config.law.mode == "filter" else "only watches"],
    ]
    found = None if outdated else Calibration.read(config.calibration)
    promise = [] if found is None else [html.heading("How often it misses"), html.paragraph(in_words(found))]
    return [html.heading("The filter"), html.table(["", ""], rows), *promise]


def _misses(misses: dict[str, dict[str, int]], folder: Path) -> list[str]:
    """Which part of the filter is to blame for what was missed: a bar for each study."""
    if not misses:
        return []
    figures.save(figures.causes_of_misses(misses), folder / "misses.png")
    caption = (
        "Recorded failures that were not warned of in time. Doomed: they failed at once. Fallback: V fell to epsilon, "
        "but late. Margin: blind to the failure. World model: imagined otherwise than it came. Value: it saw a way out."
    )
    return [html.heading("Where misses come from"), html.picture(folder / "misses.png", caption)]


def _comparison(result: dict, folder: Path) -> list[str]:
    header = ["the policy", "safe success", "failure", "stall"]
    rows = [
        [name, *(rate_in_words(result[name][key]) for key in ("success", "violation", "stall"))]
        for name in ("bare", "shielded")
    ]
    shielded, p_value = result["shielded"], result["violation_p_value"]
    parts = [
        html.heading("With and without the filter"),
        html.table(header, rows),
        html.paragraph(
            "Both rows start from the same situations. Brackets hold 95% intervals (Wilson), in percent. The filter "
            f"acted in {shielded['overridden_share']:.1%} of all steps and changed the action by "
            f"{shielded['mean_action_change']:.3g} on average. If it made no difference, a change in failures this "
            f"large would come about with probability {p_value:.2g} (exact test on the pairs)."
        ),
        html.table(["why a step was judged as it was", "steps"], list(result["reasons"].items())),
    ]
    if np.isfinite(result["episodes"]["bare"].severity).all():
        parts += _severity(result["episodes"], folder)
    return parts


def _severity(runs: dict[str, Episodes], folder: Path) -> list[str]:
    """How bad the failures were: how many runs spilled at least so much."""
    figures.save(figures.severities(runs), folder / "severity.png")
    least = (0.05, 0.25, 0.5, 1.0)
    rows = [
        [name, *(rate_in_words(wilson((r.severity >= share).sum(), len(r.severity))) for share in least)]
        for name, r in runs.items()
    ]
    return [
        html.heading("How much was spilled"),
        html.picture(folder / "severity.png", "Runs that spilled at least so much. Shaded: 95% intervals (Wilson)."),
        html.table(["runs that spilled at least", *(f"{share:.0%}" for share in least)], rows),
    ]


def _episodes(
    runs: dict[str, Episodes], policy: LatentSafePolicy, env: EnvConfig, folder: Path, seen: NearestFrames | None
) -> list[str]:
    side_by_side = "Left without the filter, right with it; an orange frame while the filter acts. "
    parts = [html.heading("Episodes"), html.paragraph(side_by_side + CURVES)]
    for i in _worth_showing(runs["bare"], runs["shielded"]):
        outcome = {name: "fails" if r.violation[i] else "stays safe" for name, r in runs.items()}
        parts.append(f"<h3>Episode {i}: {outcome['bare']} without the filter, {outcome['shielded']} with it</h3>")
        parts += _played({name: r.only(i) for name, r in runs.items()}, policy, env.fps, folder / f"run_{i}", seen)
    return parts


def _recording(
    recording: RecordedEpisodes, policy: LatentSafePolicy, folder: Path, seen: NearestFrames | None
) -> list[str]:
    """The recorded episodes in which the filter acted most."""
    fps, decisions = recording.frames.meta.fps, recording.decisions
    acted = np.bincount(recording.episode, decisions["intervened"]).astype(int)
    steps = np.bincount(recording.episode)
    parts = [
        html.heading("Recorded under the filter"),
        html.paragraph(
            f"{recording.frames.meta.repo_id}: {(steps > 0).sum()} episodes; the filter acted in "
            f"{(acted > 0).sum()} of them, and in {acted.sum() / steps.sum():.1%} of all steps."
        ),
        html.table(["why a step was judged as it was", "steps"], count_reasons(decisions["reason"]).items()),
        html.paragraph("The episodes in which it acted most; an orange frame while it acts. " + CURVES),
    ]
    most = [i for i in np.argsort(-acted, kind="stable").tolist() if steps[i]][:SHOWN]
    for i in most:
        parts.append(f"<h3>Episode {i}: the filter acts in {acted[i]} of {steps[i]} steps</h3>")
        parts += _played({"recorded": recording.read(i)}, policy, fps, folder / f"recorded_{i}", seen)
    return parts


CURVES = (
    "Under each video: the value of what the policy or person wants to do next, with the threshold dashed, and the "
    "margin of what is seen now (below zero it looks like a failure already). Then each command, as wanted and as "
    "executed. Steps at which the filter acted are shaded. Click into a curve to go there."
)


def _played(
    runs: dict[str, Episodes], policy: LatentSafePolicy, fps: int, folder: Path, seen: NearestFrames | None
) -> list[str]:
    """Runs of one episode each, side by side in a video, with the curves and fears of the last, which was filtered."""
    (video,) = figures.write_videos(runs, folder, fps)
    filtered = list(runs.values())[-1]
    trace, seconds = filtered.traces[0], max(len(r.frames[0]) for r in runs.values()) / fps
    charts, printed = _charts(trace, policy, fps, seconds), _printed(trace, filtered.frames[0], fps)
    return [
        html.player(video, charts, seconds, "", printed),
        *_feared(trace, filtered.latents[0], policy, fps, seen),
    ]


def _worth_showing(bare: Episodes, shielded: Episodes) -> list[int]:
    """One that the filter saved, one that it did not, one that it left alone, then others."""
    n = len(shielded.frames)
    saved, failed = bare.violation[:n] & ~shielded.violation[:n], shielded.violation[:n]
    kinds = [np.flatnonzero(kind) for kind in (saved, failed, shielded.overridden[:n] == 0)]
    wanted = [int(found[0]) for found in kinds if len(found)] + list(range(n))
    return sorted(list(dict.fromkeys(wanted))[:SHOWN])


def _charts(trace: dict[str, list], policy: LatentSafePolicy, fps: int, seconds: float) -> list[str]:
    n, acted = round(seconds * fps), np.array(trace["intervened"], bool)
    padded = lambda values: np.r_[np.asarray(values, float), np.full(n - len(values), np.nan)]  # noqa: E731
    shaded = np.r_[acted, np.zeros(n - len(acted), bool)]
    values = {"value of the wanted action": padded(trace["value"]), "margin now": padded(trace["margin"])}
    charts = [html.chart(values, fps, shaded, policy.config.law.epsilon, (-1.0, 1.0), "dashed: threshold")]
    proposed, executed = np.array(trace["proposed"]), np.array(trace["action"])
    ranges, varies = policy.config.trained_on.ranges, policy.config.trained_on.action_varies
    for j, (name, limits) in enumerate(ranges.items()):
        if varies[j]:
            commands = {f"{name} executed": padded(executed[:, j]), "wanted": padded(proposed[:, j])}
            charts.append(html.chart(commands, fps, shaded, limits=limits))
    return charts


def _printed(trace: dict[str, list], frames: list[np.ndarray], fps: int) -> str:
    picked = np.unique(np.linspace(0, len(trace["intervened"]) - 1, PRINTED).round().astype(int))
    captions = [f"{t / fps:.2f} s" for t in picked]
    return html.strip([frames[t] for t in picked], captions, [bool(trace["intervened"][t]) for t in picked])


def _feared(
    trace: dict[str, list], latents: list[Latent], policy: LatentSafePolicy, fps: int, seen: NearestFrames | None
) -> list[str]:
    """What the filter imagined when it first acted: the wanted action held on, and its own way out."""
    acted = np.flatnonzero(np.array(trace["reason"]) == Reason.UNSAFE_VALUE)
    if not len(acted):
        return [html.paragraph("The filter never saw a reason to act here.")]
    first = int(acted[0])
    wanted = torch.tensor([trace["heard"][first]], device=policy.model.device)
    said = f"What the filter imagined when it first acted, {first / fps:.2f} s into the episode:"
    if seen is not None:
        said += (
            " its world model cannot draw, so each picture is the one, of the "
            f"{len(seen):,} it has seen here, that it holds for most like what it imagines."
        )
    parts = [html.paragraph(said)]
    for name, action in (("the wanted action, held on", wanted), ("its own fallback", None)):
        images, margins = imagine(policy, latents[first], action, seen)
        captions = [f"+{(k + 1) / fps:.2f} s, l = {l:+.2f}" for k, l in enumerate(margins)]
        every = slice(1, None, IMAGINED // PRINTED)
        picture = html.strip(images[every], captions[every], [l < 0 for l in margins[every]])
        parts.append(html.paragraph(f"With {name} (orange: imagined failure):") + picture)
    return parts


@torch.no_grad()
def imagine(
    policy: LatentSafePolicy, latent: Latent, action: torch.Tensor | None, seen: NearestFrames | None = None
) -> tuple[list[np.ndarray], list[float]]:
    """Pictures of the first camera and margins of IMAGINED steps from a latent (1, ...).

    Args:
        action: (1, A) in [-1, 1], held on; None asks the fallback policy at every step.
        seen: where to look for pictures; None has the world model decode them.
    """
    imagination, images, margins = policy.model.imagination, [], []
    for _ in range(IMAGINED):
        held = policy.model.plan(latent)[1] if action is None else action
        latent = imagination.step(latent, held)
        images.append(_decoded(policy, latent) if seen is None else seen.nearest(latent))
        margins.append(imagination.margin(latent).item())
    return images, margins


def _decoded(policy: LatentSafePolicy, latent: Latent) -> np.ndarray:
    """The first camera's picture (H, W, 3), uint8, as the world model draws a latent (1, ...)."""
    picture = policy.model.world_model.decode(policy.model.world_model.features(latent))[
        policy.config.trained_on.cameras[0]
    ][0].clamp(0, 1)
    return (picture.permute(1, 2, 0).cpu().numpy() * 255).round().astype(np.uint8)
