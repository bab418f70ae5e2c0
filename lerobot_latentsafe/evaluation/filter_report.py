"""The report on a filter: what it is, what it changes, and what it saw and feared when it acted."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from lerobot.envs.configs import EnvConfig

from lerobot_latentsafe.evaluation import figures, report
from lerobot_latentsafe.evaluation.rollouts import provenance
from lerobot_latentsafe.evaluation.shielding import Episodes, check_environment, compare
from lerobot_latentsafe.filter import Reason
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.world_models.base import Latent

SHOWN, LOOKED_THROUGH, IMAGINED, PRINTED = 3, 12, 16, 8
"""Episodes shown, among how many they are picked, steps of imagination, pictures on paper."""

INTRODUCTION = (
    "A safety filter watches what a robot sees. At every step it imagines, with a model of the world learnt from "
    "recordings, what the robot's next action leads to, and asks how close to failure things would get even if "
    "everything were done to avoid it from then on. That number is the value V: positive means that some way out is "
    "left. While V is above a threshold the robot's own policy acts; at or below it, the filter's fallback takes over."
)


def write_filter_report(path: Path, policy: LatentSafePolicy, env: EnvConfig, n_episodes: int, seed: int) -> None:
    """Write the report; with a base policy, run it bare and shielded from the same starts first."""
    policy.require_stage("reachability")
    check_environment(policy, env)
    with TemporaryDirectory() as folder:
        parts = [report.paragraph(INTRODUCTION), *_about(policy)]
        if policy.base is not None:
            result = compare(policy, env, n_episodes, seed, min(n_episodes, LOOKED_THROUGH))
            parts += _comparison(result, policy, env, Path(folder))
            parts += _episodes(result["episodes"], policy, env, Path(folder))
        if env.type == "latentsafe_dubins":
            parts += _safe_set(policy, Path(folder))
        made = provenance(seeds=[seed])
        parts += [
            report.paragraph(
                "A learned filter is not a certified safety device: it carries no guarantee, and knows only what its "
                "recordings covered.",
                note=True,
            ),
            report.paragraph(f"Made by {made['command']} at commit {made['commit']}, {made['date']}."),
        ]
        report.write_report(path, "What this safety filter does", parts)


def _about(policy: LatentSafePolicy) -> list[str]:
    config, found = policy.config, policy.config.calibration
    ranges = zip(config.action_names, config.action_low, config.action_high)
    evidence = "set by hand"
    if found:
        evidence = (
            f"chosen on {found['failing_episodes']:.0f} failing episodes it had not seen: {found['missed']:.1%} warned "
            f"too late, {found['false_alarms']:.1%} of safe frames alarmed"
        )
    rows = [
        ["sees", f"{', '.join(config.cameras)}; {', '.join(config.state_names)}"],
        ["acts on", ", ".join(f"{name} from {low:.3g} to {high:.3g}" for name, low, high in ranges)],
        ["rate", f"{config.fps} steps a second"],
        ["failure means", f"the recordings' label {config.failure_specification!r}"],
        ["threshold", f"epsilon = {config.epsilon:g}, {evidence}"],
        ["mode", "overrides unsafe actions" if config.mode == "filter" else "only watches"],
    ]
    return [report.heading("The filter"), report.table(["", ""], rows)]


def _comparison(result: dict, policy: LatentSafePolicy, env: EnvConfig, folder: Path) -> list[str]:
    header = ["the policy", "safe success", "failure", "neither"]
    rows = [
        [name, *(report.share(result[name][key]) for key in ("success", "violation", "incompletion"))]
        for name in ("bare", "shielded")
    ]
    shielded, p_value = result["shielded"], result["violation_p_value"]
    parts = [
        report.heading("With and without the filter"),
        report.table(header, rows),
        report.paragraph(
            "Both rows start from the same situations. Brackets hold 95% intervals (Wilson), in percent. The filter "
            f"acted in {shielded['overridden_share']:.1%} of all steps and changed the action by "
            f"{shielded['mean_action_change']:.3g} on average. If it made no difference, a change in failures this "
            f"large would come about with probability {p_value:.2g} (exact test on the pairs)."
        ),
        report.table(["why a step was judged as it was", "steps"], list(result["reasons"].items())),
    ]
    if env.type == "latentsafe_dubins":
        figures.save(figures.trajectories(result["episodes"]), folder / "paths.png")
        parts.append(
            report.picture(folder / "paths.png", "Where the car went. Red entered the disc; orange: the filter acts.")
        )
    return parts


def _episodes(runs: dict[str, Episodes], policy: LatentSafePolicy, env: EnvConfig, folder: Path) -> list[str]:
    parts = [
        report.heading("Episodes"),
        report.paragraph(
            "Left without the filter, right with it; an orange frame while the filter acts. Under each video: the "
            "value of what the policy wants to do next, with the threshold dashed, and the margin of what is seen now "
            "(below zero it looks like a failure already). Then each command, as wanted and as executed. Steps at "
            "which the filter acted are shaded. Click into a curve to go there."
        ),
    ]
    for i in _worth_showing(runs["bare"], runs["shielded"]):
        shown = {name: Episodes(*[getattr(r, k)[i : i + 1] for k in _FIELDS]) for name, r in runs.items()}
        (video,) = figures.write_videos(shown, folder / f"episode_{i}", env.fps)
        outcome = {name: "fails" if r.violation[i] else "stays safe" for name, r in runs.items()}
        parts.append(f"<h3>Episode {i}: {outcome['bare']} without the filter, {outcome['shielded']} with it</h3>")
        trace, frames = runs["shielded"].traces[i], runs["shielded"].frames[i]
        seconds = max(len(r.frames[i]) for r in runs.values()) / env.fps
        parts.append(
            report.player(
                video, _charts(trace, policy, env.fps, seconds), seconds, "", _printed(trace, frames, env.fps)
            )
        )
        parts += _feared(trace, runs["shielded"].latents[i], policy, env.fps)
    return parts


_FIELDS = ("success", "violation", "steps", "overridden", "action_change", "traces", "frames", "latents")


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
    charts = [report.chart(values, fps, shaded, policy.config.epsilon, (-1.0, 1.0), "dashed: threshold")]
    proposed, executed = np.array(trace["proposed"]), np.array(trace["action"])
    for j, name in enumerate(policy.config.action_names):
        if policy.config.action_varies[j]:
            commands = {f"{name} executed": padded(executed[:, j]), "wanted": padded(proposed[:, j])}
            charts.append(report.chart(commands, fps, shaded))
    return charts


def _printed(trace: dict[str, list], frames: list[np.ndarray], fps: int) -> str:
    picked = np.unique(np.linspace(0, len(trace["intervened"]) - 1, PRINTED).round().astype(int))
    captions = [f"{t / fps:.2f} s" for t in picked]
    return report.strip([frames[t] for t in picked], captions, [bool(trace["intervened"][t]) for t in picked])


def _feared(trace: dict[str, list], latents: list[Latent], policy: LatentSafePolicy, fps: int) -> list[str]:
    """What the filter imagined when it first acted: the wanted action held on, and its own way out."""
    acted = np.flatnonzero(np.array(trace["reason"]) == Reason.UNSAFE_VALUE)
    if not len(acted):
        return [report.paragraph("The filter never saw a reason to act here.")]
    if not hasattr(policy.world_model, "decode"):
        return [report.paragraph("This world model cannot draw what it imagines.")]
    first = int(acted[0])
    wanted = policy.normalise_action(torch.tensor([trace["proposed"][first]], device=policy.device)).clamp(-1, 1)
    parts = [report.paragraph(f"What the filter imagined when it first acted, {first / fps:.2f} s into the episode:")]
    for name, action in (("the wanted action, held on", wanted), ("its own fallback", None)):
        images, margins = imagine(policy, latents[first], action)
        captions = [f"+{(k + 1) / fps:.2f} s, l = {l:+.2f}" for k, l in enumerate(margins)]
        every = slice(1, None, IMAGINED // PRINTED)
        picture = report.strip(images[every], captions[every], [l < 0 for l in margins[every]])
        parts.append(report.paragraph(f"With {name} (orange: imagined failure):") + picture)
    return parts


@torch.no_grad()
def imagine(
    policy: LatentSafePolicy, latent: Latent, action: torch.Tensor | None
) -> tuple[list[np.ndarray], list[float]]:
    """Pictures of the first camera and margins of IMAGINED steps from a latent (1, ...).

    Args:
        action: (1, A) in [-1, 1], held on; None asks the fallback policy at every step.
    """
    model, images, margins = policy.world_model, [], []
    for _ in range(IMAGINED):
        held = policy.plan(latent)[1] if action is None else action
        latent = model.step(latent, held)
        features = model.features(latent)
        picture = model.decode(features)[policy.config.cameras[0]][0].clamp(0, 1)
        images.append((picture.permute(1, 2, 0).cpu().numpy() * 255).round().astype(np.uint8))
        margins.append(policy.margin.bounded(features).item())
    return images, margins


def _safe_set(policy: LatentSafePolicy, folder: Path) -> list[str]:
    from lerobot_latentsafe.evaluation.monitor import LatentMonitor

    figures.save(figures.value_slices({"latent": LatentMonitor(policy)}), folder / "slices.png")
    return [
        report.heading("The safe set it learnt from images"),
        report.picture(
            folder / "slices.png",
            "The value over the car's position for two headings. Solid: where the filter draws the line; dashed: the "
            "exact one, known for this simulated car only.",
        ),
    ]
