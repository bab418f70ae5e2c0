"""`latentsafe <verb> --a.b=c`: LeRobot-style options, one dataclass a verb.

Importing this loads nothing: `main` imports what the verb that is asked for needs.
"""

import importlib
import os
import sys
from typing import NamedTuple


class Verb(NamedTuple):
    """A verb of the console command.

    Attributes:
        group: what it helps with; see GROUPS.
        module, name: where its options class is, which has a method `run`.
        what: what it is for.
        light: whether that module loads no LeRobot, so that the verb can refuse what it is given at once.
    """

    group: str
    module: str
    name: str
    what: str
    light: bool = False


GROUPS = {
    "record": "record episodes",
    "dataset": "see whether they can be used",
    "label": "say where episodes fail",
    "train": "make a filter of them",
    "deploy": "use it",
    "evaluate": "ask what it is worth",
}
_RECORD, _DATASET, _LABEL, _TRAIN, _DEPLOY, _EVALUATE = (f"lerobot_latentsafe.cli.{group}" for group in GROUPS)
_GUARD = "lerobot_latentsafe.cli.guard"
_DREAMER = "lerobot_latentsafe.experiments.blocks.dreamer_training"

VERBS: dict[str, Verb] = {
    "collect": Verb("record", _RECORD, "Collect", "record labelled episodes of a simulated task as a LeRobotDataset"),
    "record": Verb("record", _RECORD, "Record", "lerobot-record under a filter: the dataset stores what was executed"),
    "teleoperate": Verb("record", _RECORD, "Teleoperate", "lerobot-teleoperate under a filter"),
    "merge-decisions": Verb(
        "record", _RECORD, "MergeDecisions", "copy a recording with the shield's decisions as columns"
    ),
    "check-dataset": Verb(
        "dataset",
        _DATASET,
        "CheckDataset",
        "print what a dataset says of its robot, and whether a filter can be made of it",
    ),
    "rename-features": Verb(
        "dataset", _DATASET, "RenameFeatures", "copy a dataset with the names of features that LeRobot expects"
    ),
    "label": Verb(
        "label",
        "lerobot_latentsafe.cli.label_page",
        "Label",
        "open a local page on which a person marks where episodes fail",
        light=True,
    ),
    "auto-label": Verb("label", _LABEL, "AutoLabel", "let a function or a vision-language model label the rest"),
    "check-labels": Verb("label", _LABEL, "CheckLabels", "list the labels that a trained filter disagrees with"),
    "carry-labels": Verb(
        "label", _LABEL, "CarryLabels", "take over labels from the datasets that one was joined or cut from"
    ),
    "write-labels": Verb(
        "label", _LABEL, "WriteLabels", "copy a dataset with its labels as columns, and push it on request"
    ),
    "guard": Verb("train", _GUARD, "Guard", "make a guard of recorded episodes, without labels or training"),
    "monitor": Verb("train", _GUARD, "Monitor", "fit a monitor to a filter that says when the scene is unknown"),
    "cache": Verb("train", _TRAIN, "Cache", "decode a dataset's frames once, so that training does not have to"),
    "join-caches": Verb("train", _TRAIN, "JoinCaches", "make one cached dataset of several, without copying frames"),
    "train-margin": Verb("train", _TRAIN, "TrainMargin", "fit the failure margin to labels on a frozen world model"),
    "train-reachability": Verb(
        "train", _TRAIN, "TrainReachability", "learn the safety value and the fallback in a world model's imagination"
    ),
    "add-constraint": Verb(
        "train", _TRAIN, "AddConstraint", "let a filter heed one more failure, of a few marked frames, without training"
    ),
    "train-dreamer": Verb("train", _DREAMER, "TrainDreamer", "learn the blocks' task policy in imagination"),
    "calibrate": Verb("train", _TRAIN, "Calibrate", "choose epsilon on held-out episodes and store the evidence"),
    "wrap": Verb("deploy", _DEPLOY, "Wrap", "write a filter and the policy it shields as one self-contained folder"),
    "push": Verb("deploy", _DEPLOY, "Push", "push a filter, or a shielded policy, to the Hub with its card"),
    "path": Verb(
        "deploy",
        "lerobot_latentsafe.cli.path",
        "PathOf",
        "print the folder of a committed checkpoint, for LeRobot's commands",
        light=True,
    ),
    "bench": Verb(
        "deploy", "lerobot_latentsafe.cli.bench", "Bench", "measure what a tick takes on this machine, part by part"
    ),
    "migrate-checkpoint": Verb(
        "deploy", _DEPLOY, "MigrateCheckpoint", "copy a checkpoint of a version before 0.2 into the present layout"
    ),
    "eval-monitor": Verb(
        "evaluate", _EVALUATE, "EvalMonitor", "compare a filter's verdicts with the exact safe set (Table 1)"
    ),
    "eval-shield": Verb("evaluate", _EVALUATE, "EvalShield", "run a policy bare and shielded from the same starts"),
    "eval-world-model": Verb(
        "evaluate", _EVALUATE, "EvalWorldModel", "ask a world model whether it obeys the action and looks"
    ),
    "explain-misses": Verb(
        "evaluate",
        _EVALUATE,
        "ExplainMisses",
        "tell which part of a filter is to blame for failures it did not warn of",
    ),
    "report": Verb("evaluate", _EVALUATE, "Report", "write one HTML file about a filter and what it changes"),
    "draw-features": Verb("evaluate", _EVALUATE, "DrawFeatures", "draw what an encoder makes of the bag's variants"),
}
RENAMED_VERBS = {"picture-features": "draw-features"}
"""Old name -> present name."""

INTRODUCTION = """Latent safety filters for LeRobot.

usage: latentsafe <verb> [--option=value ...]      latentsafe <verb> --help shows an example and all options
                                                   --debug shows where an error was raised
       latentsafe completion                       how to have the Tab key complete verbs and options

From episodes to a shielded policy:
  1. latentsafe collect --source=random --dataset.repo_id=me/car --dataset.root=data/car    (or lerobot-record)
  2. latentsafe cache --dataset.repo_id=me/car --dataset.root=data/car --output_dir=data/car_cache
  3. lerobot-train --policy.type=latentsafe --dataset.repo_id=me/car_cache --dataset.root=data/car_cache ...
  4. latentsafe train-reachability --policy.path=<checkpoint> --dataset.root=data/car_cache --output_dir=filter
  5. latentsafe eval-shield --policy.path=filter --base_policy_path=<your policy> --env.type=latentsafe_dubins ...
"""


def overview() -> str:
    """What `latentsafe --help` prints: the verbs in groups."""
    lines = [INTRODUCTION]
    for group, title in GROUPS.items():
        lines.append(f"{group}: {title}")
        lines += [f"  {verb:20s} {entry.what}" for verb, entry in VERBS.items() if entry.group == group]
        lines.append("")
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> None:
    """Entry point of the console command `latentsafe`."""
    os.environ.setdefault("MPLBACKEND", "Agg")  # pictures are written, never shown
    os.environ.setdefault("DIFFUSERS_VERBOSITY", "error")  # it warns of parts that nobody asked for
    typed = sys.argv[1:] if argv is None else argv
    debug = "--debug" in typed
    verb, *options = [word for word in typed if word != "--debug"] or ["--help"]
    if verb in ("-h", "--help", "help"):
        if not options:
            return print(overview())
        verb, options = options[0], ["--help"]  # latentsafe help <verb>
    if verb == "completion":
        return importlib.import_module("lerobot_latentsafe.cli.completion").complete()
    importlib.import_module("lerobot_latentsafe.cli.command_line").run(verb, options, debug)
