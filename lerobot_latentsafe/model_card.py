"""The filter's card on the Hub: what it saw, what it guards, how epsilon was set, what was measured, what it is not.

Names come from datasets, files and the Hub: each is put into the card by `_said` or `_code`, and is text there.
"""

import html
import json
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from huggingface_hub import ModelCard, ModelCardData
from huggingface_hub.utils import HFValidationError, validate_repo_id

from lerobot_latentsafe.calibration import ALL, Calibration, in_words
from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.decision import LAWS, RECENT, LawConfig
from lerobot_latentsafe.meanings import Command
from lerobot_latentsafe.units import TrainedOn

TEXT = """---
{header}
---

{introduction}

| | |
|---|---|
{rows}
```bash
pip install lerobot_policy_latentsafe
lerobot-eval --policy.path={repo_id} --policy.base_policy_path=<your policy> --env.type=...
lerobot-teleoperate --robot.type=latentsafe_shielded --robot.filter={repo_id} --robot.inner.type=<your robot> ...
```

First run it with `--policy.law.mode=monitor` or `--robot.law.mode=monitor`, which never acts and reports what it would
have done.

{calibrated}{evaluation}## Limits

{limits}
- A policy under it cannot tell that a frame is late or frozen; a robot under it (`latentsafe_shielded`) can.
"""

FILTER = """# Latent safety filter

This policy shields another LeRobot policy: it passes the base policy's action while the safety value V of the
predicted next latent stays above epsilon, and otherwise acts itself to preserve safety
([Nakamura, Peters, Bajcsy, 2025](https://kensukenk.github.io/latent-safety/)). Alone it is the fallback policy.

**This is not a certified safety device.** Its value is learned from images: it carries no guarantee, least of all
outside of what its data covered."""

FILTER_LIMITS = """\
- V means nothing outside of what the data covered: other cameras, objects, dynamics, lighting. {unknown}
- It acts at the last moment and with the fallback's full action; it looks for no safe action near the proposed one.
- {imagination}"""

GUARD = """# Guard

This policy guards another LeRobot policy: it passes the base policy's action while observation, action and time look
like those of its data, and otherwise has the robot stay. It has no world model, so **there is no safety value V**: it
knows no failure, and foresees nothing. Alone it stays.

**This is not a certified safety device.** It carries no guarantee."""

GUARD_LIMITS = """\
- It passes every action that is in range, in time and no jump, wherever that leads.
- It tells a camera that is dead, frozen or unlike the data's, and only coarsely. Where something is wrong, it stays,
  safe or not."""

TASK_POLICY_TEXT = """---
{header}
---

# Task policy learned in imagination

An actor-critic in the imagination of a world model (the DreamerV3 recipe) whose task is to {task}. It is the policy
that a latent safety filter shields in our study: **it fails at times, on purpose**, for its reward prices failures
instead of forbidding them. It was trained on {dataset}; its world model is in `world_model/`.

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
    names = {"task": _said(task), "dataset": _code(dataset_repo_id), "repo_id": _repository(repo_id, "me/policy")}
    return ModelCard(TASK_POLICY_TEXT.format(header=header, **names))


STRUCTURE = str.maketrans({sign: f"&#{ord(sign)};" for sign in "`*[]|\\~"})
"""Signs that Markdown takes for structure -> entities, which it takes for text. Names have underscores inside words."""
RATE = re.compile(r"\d+/\d+ = [\d.]+% \[[\d.]+, [\d.]+\]")
"""What `rate_in_words` says, whose brackets stand for themselves."""
PLAIN = re.compile(r"[\w ./:,=+@()'-]+")


def _line(text: Any) -> str:
    """A name on one line: what would begin a heading, or end the header, does not."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())


def _said(text: Any) -> str:
    """A name as it is read: neither HTML nor Markdown."""
    return html.escape(_line(text), quote=False).translate(STRUCTURE)


def _code(text: Any) -> str:
    """A name set as code, if nothing in it could end that."""
    return f"`{_line(text)}`" if PLAIN.fullmatch(_line(text)) else _said(text)


def _repository(repo_id: str | None, example: str) -> str:
    """A repository to be typed in a command: an example if it is none."""
    try:
        validate_repo_id(str(repo_id or ""))
    except HFValidationError:
        return example
    return str(repo_id or example)


def _header(dataset_repo_id: str, license: str | None, tags: list[str] | None, name: str, kind: str) -> str:
    return ModelCardData(
        license=_line(license or "apache-2.0"),
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=sorted({*map(_line, tags or []), "robotics", "lerobot", name, kind}),
        datasets=_line(dataset_repo_id),
        model_name=name,
    ).to_yaml()


CALIBRATED = """## How often it misses

{said}

| held-out episodes | warned | quiet |
|---|---|---|
| that fail, {lead_steps} frames ahead | {warned} of {failing} | {missed} of {failing} |
| that never fail | {alarms} of {safe} | {quiet} of {safe} |

"""

RATES = ("spilled", "spills_below_5_percent", "violation", "stall", "incompletion", "success")


def make_model_card(
    config: LatentSafeConfig, dataset_repo_id: str, license: str | None, tags: list[str] | None,
    outdated: Sequence[str] = (),
) -> ModelCard:  # fmt: skip
    """The card of a filter, from its configuration.

    Args:
        outdated: why its calibration is another filter's, if it is; see `calibration.differences`.
    """
    guards = config.law.name == "guard"
    limits = (
        GUARD_LIMITS
        if guards
        else FILTER_LIMITS.format(unknown=_unknown(config), imagination=_imagination(config.law.samples))
    )
    rows = {
        "trained on": _code(dataset_repo_id),
        **_robot(config),
        **({"law": "guard: checks alone, there is no V"} if guards else _judgement(config, outdated)),
        "shields": _code(config.base_policy_path) if config.base_policy_path else "nothing yet",
    }
    return ModelCard(
        TEXT.format(
            header=_header(dataset_repo_id, license, tags, "latentsafe", "safety-filter"),
            introduction=GUARD if guards else FILTER,
            rows="".join(f"| {what} | {said} |\n" for what, said in rows.items()),
            repo_id=_repository(config.repo_id, "me/filter"),
            calibrated="" if guards or outdated else _calibrated(config.calibration),
            evaluation=_evaluation(config.evaluation),
            limits=limits,
        )
    )


def _unknown(config: LatentSafeConfig) -> str:
    """Whether anything says that the scene is new, and what is done then."""
    monitor = config.trained_on.monitor
    if monitor is None:
        return "Nothing detects that: `latentsafe monitor` adds a monitor."
    watched = "what cameras show" + (", and what follows from actions," if monitor.dynamics else "")
    return (
        f"Its monitor watches {watched} and alarms in at most {monitor.alpha:.1%} of healthy episodes (number "
        f"{monitor.rank} of {monitor.episodes} held out). Then the law says `{config.law.unknown}`. It may not tell "
        "what looks alike and is stiffer, heavier or more slippery."
    )


def _robot(config: LatentSafeConfig) -> dict[str, str]:
    """What the filter sees and does, in words."""
    trained_on = config.trained_on
    return {
        "robot": _code(trained_on.robot_type) if trained_on.robot_type else "unknown",
        "cameras": ", ".join(f"{_code(c)} {tuple(config.input_features[c].shape)}" for c in trained_on.cameras or []),
        "rate": f"{trained_on.fps} fps",
        "actions (robot units)": ", ".join(_command(c, trained_on) for c in trained_on.commands),
        "proprioception": ", ".join(map(_said, trained_on.state_names or [])),
    }


def _judgement(config: LatentSafeConfig, outdated: Sequence[str]) -> dict[str, str]:
    """What V is, and what comes of it, in words."""
    law = config.law
    return {
        "world model": _world_model(config),
        "failure specification": _code(config.margin.failure_specification),
        "stage": config.trained_on.stage,
        "law": f"{law.name}, V read {_ahead(config)}",
        "epsilon": threshold(law),
        "epsilon was set": _said(how_epsilon_was_set(config.calibration, outdated)),
        "fallback": _said(fallback(law)),
    }


def _command(command: Command, trained_on: TrainedOn) -> str:
    """What a command means and how far it went in the data, in words."""
    (low, high), moves = trained_on.ranges[command.name], trained_on.motion_ranges[command.name]
    text = f"{_said(command.name)} in [{low:g}, {high:g}]"
    if trained_on.meanings is None:
        return text
    text += f" ({_said(command.described)}"
    return f"{text}, at most {moves[0]:+.3g} to {moves[1]:+.3g} from the state)" if command.of_state else f"{text})"


def threshold(law: LawConfig) -> str:
    """What V must exceed, in words."""
    if law.resume_above <= law.epsilon:
        return f"{law.epsilon:g}"
    return f"{law.epsilon:g}; once the filter acts, {law.resume_above:g}"


def fallback(law: LawConfig) -> str:
    """What acts in place of an unsafe action, in words."""
    nearest = "the nearest action that passes; where none is found, " if law.name == "nearest" else ""
    return nearest + _last_resort(law)


def _last_resort(law: LawConfig) -> str:
    if not law.retreat:
        return "the critic's action"
    moves = ", ".join(f"{name} {motion:+g} a step" for name, motion in law.retreat.items())
    tried = f"the critic's action; after {law.retreat_after} overrides within {RECENT} steps "
    most = f" and at most {law.max_retreat_steps}" if law.max_retreat_steps else ""
    return f"{tried if law.retreat_after else ''}the retreat ({moves}) for at least {law.min_retreat_steps}{most} steps"


def _world_model(config: LatentSafeConfig) -> str:
    text = f"{config.world_model.type}, {config.world_model.image_size} px"
    if perception := getattr(config.world_model, "perception", None):
        text += f", on {perception.components} components of the frozen encoder {_code(perception.encoder)}"
        text += f" (weights {_said(perception.encoder_hash)}), which is not part of the checkpoint"
    frames = config.law.history_frames
    return text + (f"; remembers {frames} frames at most" if frames else "")


def _ahead(config: LatentSafeConfig) -> str:
    """How far ahead V is read, in words."""
    ticks, skip = config.law.proposal_steps + config.law.lookahead, config.world_model.frame_skip
    text = f"after {config.law.proposal_steps} + {config.law.lookahead} imagined ticks"
    if config.trained_on.fps:
        text += f", {ticks / config.trained_on.fps:.2g} s ahead"
    return text + (f" (a step of the world model is {skip} ticks)" if skip > 1 else "")


def _imagination(samples: int) -> str:
    if not samples:
        return "Imagination is deterministic: what is random in the world is foreseen as its mean."
    return f"Imagination draws {samples} futures and believes the worst: what it did not draw is not foreseen."


def how_epsilon_was_set(evidence: dict[str, Any], outdated: Sequence[str]) -> str:
    """On what evidence, in one line; evidence that is another filter's promises nothing of this one.

    Args:
        outdated: see `make_model_card`.
    """
    if not evidence:
        return "by hand: nothing is promised"
    if outdated:
        return f"nothing is promised of this filter: {'; '.join(outdated)}. Run latentsafe calibrate again"
    found = Calibration.read(evidence)
    if found is None:
        return "by latentsafe calibrate, whose evidence is not whole"
    everyone = found.groups[ALL]
    return f"by latentsafe calibrate, on {everyone.n} failing and {found.safe_episodes} safe episodes held out"


def _calibrated(evidence: dict[str, Any]) -> str:
    found = Calibration.read(evidence)
    if found is None:
        return ""
    failing, missed = found.groups[ALL].n, found.groups[ALL].missed
    safe, alarms = found.safe_episodes, found.false_alarms
    counts = {"warned": failing - missed, "missed": missed, "alarms": alarms, "quiet": safe - alarms}
    return CALIBRATED.format(
        said=_said(in_words(found)), lead_steps=found.lead_steps, failing=failing, safe=safe, **counts
    )


def _evaluation(rates: dict[str, str]) -> str:
    if not rates:
        return ""
    rows = "".join(
        f"| {_said(what)} | {rate if RATE.fullmatch(rate) else _said(rate)} |\n" for what, rate in rates.items()
    )
    return f"## Measured\n\nRates with 95% Wilson intervals.\n\n| | |\n|---|---|\n{rows}\n"


def measured(file: str | Path, law: str) -> dict[str, str]:
    """The rates of a results file, as what was measured -> the rate in words.

    Only those under a law, or under none, and of several filters only those of all together.

    Raises:
        ValueError: not a results file, or one without rates.
    """
    try:
        content = json.loads(Path(file).read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise ValueError(f"a {type(content).__name__}, expected an object")
        rates = {", ".join(path): rate for path, rate in _rates(content, law)}
    except (OSError, ValueError, RecursionError) as e:
        raise ValueError(f"--results={file} is not a readable results file ({e})") from e
    if not rates:
        raise ValueError(
            f"--results={file} holds none of {', '.join(RATES)}; give a file of latentsafe eval-shield, "
            "scripts/bag_policies.py, scripts/bag_operators.py or scripts/bag_out_of_distribution.py"
        )
    source = {name: content.get(name, "unknown") for name in ("command", "commit", "date")}
    made = f"{source['command']} at commit {source['commit']}, {source['date']}"
    stem = Path(file).stem
    return {**{f"{stem}: {what}": rate for what, rate in rates.items()}, f"{stem}: made by": made}


def rate_in_words(rate: dict[str, float]) -> str:
    """`12/200 = 6.0% [3.5, 10.2]` from a Wilson record.

    Raises:
        ValueError: no counts, more of a kind than there were, or an interval that is none.
    """
    k, n, low, high = (rate.get(name, math.nan) for name in ("k", "n", "low", "high"))
    counted = all(isinstance(count, int) and not isinstance(count, bool) for count in (k, n)) and 0 <= k <= n
    if counted and n == 0:
        return "0/0, not measured"
    if not counted or not all(isinstance(end, int | float) for end in (low, high)) or not 0 <= low <= high <= 1:
        raise ValueError(f"{k!r} of {n!r} in [{low!r}, {high!r}] is no rate; expected counts and two shares, in order")
    return f"{k}/{n} = {k / n:.1%} [{100 * low:.1f}, {100 * high:.1f}]"


def _share_in_words(share: Any) -> str:
    if not isinstance(share, int | float) or not 0 <= share <= 1:
        raise ValueError(f"overridden_share is {share!r}; expected a share from 0 to 1")
    return f"{share:.1%}"


def _rates(content: dict, law: str, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str]]:
    for name, entry in content.items():
        if "pooled" in content and name not in ("bare", "pooled"):
            continue
        if not isinstance(entry, dict) or name.split()[-1:] in [[other] for other in LAWS if other != law]:
            continue
        if {"k", "n"} <= entry.keys():
            if name in RATES:
                yield (*path, name.replace("_", " ")), rate_in_words(entry)
        else:
            yield from _rates(entry, law, (*path, name))
            if "overridden_share" in entry and name != "bare":
                yield (*path, name, "steps overridden"), _share_in_words(entry["overridden_share"])
