"""The filter's card on the Hub: what it saw, what it guards, how epsilon was set, what was measured, what it is not."""

import json
from collections.abc import Iterator
from pathlib import Path

from huggingface_hub import ModelCard, ModelCardData

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.decision import LAWS, RECENT, LawConfig
from lerobot_latentsafe.meanings import Command
from lerobot_latentsafe.units import TrainedOn

TEXT = """---
{header}
---

# Latent safety filter

This policy shields another LeRobot policy: it passes the base policy's action while the safety value V of the
predicted next latent stays above epsilon, and otherwise acts itself to preserve safety
([Nakamura, Peters, Bajcsy, 2025](https://kensukenk.github.io/latent-safety/)). Alone it is the fallback policy.

**This is not a certified safety device.** Its value is learned from images: it carries no guarantee, least of all
outside of what its data covered.

| | |
|---|---|
| trained on | `{dataset}` |
| robot | {robot} |
| cameras | {cameras} |
| rate | {fps} fps |
| actions (robot units) | {actions} |
| proprioception | {states} |
| world model | {world_model} |
| failure specification | `{failure}` |
| stage | {stage} |
| law | {law} |
| epsilon | {epsilon} |
| epsilon was set | {calibration} |
| fallback | {fallback} |
| shields | {base} |

```bash
pip install lerobot_policy_latentsafe
lerobot-eval --policy.path={repo_id} --policy.base_policy_path=<your policy> --env.type=...
lerobot-teleoperate --robot.type=latentsafe_shielded --robot.filter={repo_id} --robot.inner.type=<your robot> ...
```

First run it with `--policy.law.mode=monitor` or `--robot.law.mode=monitor`, which never acts and reports what it would
have done.

{confusion}{evaluation}## Limits

- V means nothing outside of what the data covered: other cameras, objects, dynamics, lighting. Nothing detects that.
- It acts at the last moment and with the fallback's full action; it looks for no safe action near the proposed one.
- {imagination}
- A policy under it cannot tell that a frame is late or frozen; a robot under it (`latentsafe_shielded`) can.
"""

TASK_POLICY_TEXT = """---
{header}
---

# Task policy learned in imagination

An actor-critic in the imagination of a world model (the DreamerV3 recipe) whose task is to {task}. It is the policy
that a latent safety filter shields in our study: **it fails at times, on purpose**, for its reward prices failures
instead of forbidding them. It was trained on `{dataset}`; its world model is in `world_model/`.

```bash
pip install lerobot_policy_latentsafe
lerobot-eval --policy.path={repo_id} --env.type=...
```
"""


def make_task_policy_card(
    task: str, repo_id: str, dataset_repo_id: str, license: str | None, tags: list[str] | None
) -> ModelCard:
    """The card of a `latentsafe_dreamer` policy."""
    header = _header(dataset_repo_id, license, tags, "latentsafe_dreamer", "world-model")
    return ModelCard(TASK_POLICY_TEXT.format(header=header, task=task, dataset=dataset_repo_id, repo_id=repo_id))


def _header(dataset_repo_id: str, license: str | None, tags: list[str] | None, name: str, kind: str) -> str:
    return ModelCardData(
        license=license or "apache-2.0",
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=sorted({*(tags or []), "robotics", "lerobot", name, kind}),
        datasets=dataset_repo_id,
        model_name=name,
    ).to_yaml()


CONFUSION = """## As a monitor, on held-out episodes

| | warned | quiet |
|---|---|---|
| failing episodes, {lead_steps:.0f} frames ahead | {warned} of {failing} | {missed} of {failing} |
| frames of episodes that never fail | {alarms} of {safe} | {quiet} of {safe} |

"""

RATES = ("spilled", "spills_below_5_percent", "violation", "incompletion", "success")


def make_model_card(
    config: LatentSafeConfig, dataset_repo_id: str, license: str | None, tags: list[str] | None
) -> ModelCard:
    """The card of a filter, from its configuration alone."""
    law = config.law
    return ModelCard(
        TEXT.format(
            header=_header(dataset_repo_id, license, tags, "latentsafe", "safety-filter"),
            dataset=dataset_repo_id,
            **_robot(config),
            world_model=_world_model(config),
            failure=config.margin.failure_specification,
            stage=config.trained_on.stage,
            law=f"{law.name}, V read after {law.proposal_steps} + {law.lookahead} imagined steps",
            epsilon=threshold(law),
            fallback=fallback(law),
            calibration=_calibration(config.calibration),
            base=f"`{config.base_policy_path}`" if config.base_policy_path else "nothing yet",
            repo_id=config.repo_id or "me/filter",
            imagination=_imagination(law.samples),
            confusion=_confusion(config.calibration),
            evaluation=_evaluation(config.evaluation),
        )
    )


def _robot(config: LatentSafeConfig) -> dict[str, str]:
    """What the filter sees and does, in words."""
    trained_on = config.trained_on
    return {
        "robot": f"`{trained_on.robot_type}`" if trained_on.robot_type else "unknown",
        "cameras": ", ".join(f"`{c}` {tuple(config.input_features[c].shape)}" for c in trained_on.cameras or []),
        "fps": str(trained_on.fps),
        "actions": ", ".join(_command(c, trained_on) for c in trained_on.commands),
        "states": ", ".join(trained_on.state_names or []),
    }


def _command(command: Command, trained_on: TrainedOn) -> str:
    """What a command means and how far it went in the data, in words."""
    (low, high), moves = trained_on.ranges[command.name], trained_on.motion_ranges[command.name]
    text = f"{command.name} in [{low:g}, {high:g}]"
    if trained_on.meanings is None:
        return text
    text += f" ({command.described}"
    return f"{text}, at most {moves[0]:+.3g} to {moves[1]:+.3g} from the state)" if command.of_state else f"{text})"


def threshold(law: LawConfig) -> str:
    """What V must exceed, in words."""
    if law.resume_above <= law.epsilon:
        return f"{law.epsilon:g}"
    return f"{law.epsilon:g}; once the filter acts, {law.resume_above:g}"


def fallback(law: LawConfig) -> str:
    """What acts in place of an unsafe action, in words."""
    if not law.retreat:
        return "the critic's action"
    moves = ", ".join(f"{name} {motion:+g} a step" for name, motion in law.retreat.items())
    tried = f"the critic's action; after {law.retreat_after} overrides within {RECENT} steps "
    return f"{tried if law.retreat_after else ''}the retreat ({moves}) for at least {law.min_retreat_steps} steps"


def _world_model(config: LatentSafeConfig) -> str:
    text = f"{config.world_model.type}, {config.world_model.image_size} px"
    if perception := getattr(config.world_model, "perception", None):
        text += f", on {perception.components} components of the frozen encoder `{perception.encoder}`"
        text += f" (weights {perception.encoder_hash}), which is not part of the checkpoint"
    frames = config.law.history_frames
    return text + (f"; remembers {frames} frames at most" if frames else "")


def _imagination(samples: int) -> str:
    if not samples:
        return "Imagination is deterministic: what is random in the world is foreseen as its mean."
    return f"Imagination draws {samples} futures and believes the worst: what it did not draw is not foreseen."


def _calibration(evidence: dict[str, float]) -> str:
    if not evidence:
        return "by hand"
    return (
        f"on {evidence['failing_episodes']:.0f} held-out failing episodes: {evidence['missed']:.1%} warned later than "
        f"{evidence['lead_steps']:.0f} frames ahead, {evidence['false_alarms']:.1%} false alarms"
    )


def _confusion(evidence: dict[str, float]) -> str:
    if not evidence:
        return ""
    failing, safe = round(evidence["failing_episodes"]), round(evidence["safe_frames"])
    missed, alarms = round(evidence["missed"] * failing), round(evidence["false_alarms"] * safe)
    counts = {"warned": failing - missed, "missed": missed, "alarms": alarms, "quiet": safe - alarms}
    return CONFUSION.format(lead_steps=evidence["lead_steps"], failing=failing, safe=safe, **counts)


def _evaluation(rates: dict[str, str]) -> str:
    if not rates:
        return ""
    rows = "".join(f"| {what} | {rate} |\n" for what, rate in rates.items())
    return f"## Measured\n\nRates with 95% Wilson intervals.\n\n| | |\n|---|---|\n{rows}\n"


def measured(file: str | Path, law: str) -> dict[str, str]:
    """The rates of a results file, as what was measured -> the rate in words.

    Only those under a law, or under none, and of several filters only those of all together.

    Raises:
        ValueError: not a results file, or one without rates.
    """
    try:
        content = json.loads(Path(file).read_text())
    except (OSError, json.JSONDecodeError) as e:
        raise ValueError(f"--results={file} is not a readable results file ({e})") from e
    rates = {", ".join(path): rate for path, rate in _rates(content, law)}
    if not rates:
        raise ValueError(
            f"--results={file} holds none of {', '.join(RATES)}; give a file of latentsafe eval-shield, "
            "scripts/bag_policies.py, scripts/bag_operators.py or scripts/bag_out_of_distribution.py"
        )
    source = {name: content.get(name, "unknown") for name in ("command", "commit", "date")}
    made = f"`{source['command']}` at commit {source['commit']}, {source['date']}"
    stem = Path(file).stem
    return {**{f"{stem}: {what}": rate for what, rate in rates.items()}, f"{stem}: made by": made}


def rate_in_words(rate: dict[str, float]) -> str:
    """`12/200 = 6.0% [3.5, 10.2]` from a Wilson record."""
    k, n = rate["k"], rate["n"]
    return f"{k}/{n} = {k / n:.1%} [{100 * rate['low']:.1f}, {100 * rate['high']:.1f}]"


def _rates(content: dict, law: str, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str]]:
    for name, entry in content.items():
        if "pooled" in content and name not in ("bare", "pooled"):
            continue
        if not isinstance(entry, dict) or name.split()[-1] in {*LAWS} - {law}:
            continue
        if {"k", "n"} <= entry.keys():
            if name in RATES:
                yield (*path, name.replace("_", " ")), rate_in_words(entry)
        else:
            yield from _rates(entry, law, (*path, name))
            if "overridden_share" in entry and name != "bare":
                yield (*path, name, "steps overridden"), f"{entry['overridden_share']:.1%}"
