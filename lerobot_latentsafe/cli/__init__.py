"""`latentsafe <verb> --a.b=c`: LeRobot-style options, one dataclass a verb."""

import importlib
import logging
import sys

VERBS: dict[str, tuple[str, str]] = {
    "collect": ("Collect", "record labelled episodes of a simulated task as a LeRobotDataset"),
    "cache": ("Cache", "decode a dataset's frames once, so that training does not have to"),
    "eval-world-model": ("EvalWorldModel", "ask a world model whether it obeys the action and looks"),
    "train-margin": ("TrainMargin", "fit the failure margin to labels on a frozen world model"),
    "train-reachability": (
        "TrainReachability",
        "learn the safety value and the fallback in a world model's imagination",
    ),
    "train-dreamer": ("baselines.dreamer.training.TrainDreamer", "learn the blocks' task policy in imagination"),
    "calibrate": ("Calibrate", "choose epsilon on held-out episodes and store the evidence"),
    "wrap": ("Wrap", "write a filter and the policy it shields as one self-contained folder"),
    "push": ("Push", "push a filter, or a shielded policy, to the Hub with its card"),
    "eval-monitor": ("EvalMonitor", "compare a filter's verdicts with the exact safe set (Table 1)"),
    "eval-shield": ("EvalShield", "run a policy bare and shielded from the same starts"),
    "record": ("recording.Record", "lerobot-record under a filter: the dataset stores what was executed"),
    "teleoperate": ("recording.Teleoperate", "lerobot-teleoperate under a filter"),
    "merge-decisions": ("MergeDecisions", "copy a recording with the shield's decisions as columns"),
    "label": ("Label", "open a local page on which a person marks where episodes fail"),
    "check-labels": ("CheckLabels", "list the labels that a trained filter disagrees with"),
    "auto-label": ("AutoLabel", "let a function or a vision-language model label the rest"),
    "write-labels": ("WriteLabels", "copy a dataset with its labels as columns, and push it on request"),
    "picture-features": ("PictureFeatures", "draw what an encoder makes of the bag's variants"),
    "report": ("Report", "write one HTML file about a filter and what it changes"),
    "path": ("PathOf", "print the folder of a committed checkpoint, for LeRobot's commands"),
}
"""Verb -> its dataclass, in `commands.py` unless a module is named, and what it is for."""

INTRODUCTION = """Latent safety filters for LeRobot.

usage: latentsafe <verb> [--option=value ...]      latentsafe <verb> --help shows a verb's options

From episodes to a shielded policy:
  1. latentsafe collect --source=random --repo_id=me/car --root=data/car    (or record with lerobot-record)
  2. latentsafe cache --dataset.repo_id=me/car --dataset.root=data/car --output_dir=data/car_cache
  3. lerobot-train --policy.type=latentsafe --dataset.repo_id=me/car_cache --dataset.root=data/car_cache ...
  4. latentsafe train-reachability --policy.path=<checkpoint> --dataset.root=data/car_cache --output_dir=filter
  5. latentsafe eval-shield --policy.path=filter --base_policy_path=<your policy> --env.type=latentsafe_dubins ...

verbs:"""


def main(argv: list[str] | None = None) -> None:
    """Entry point of the console command `latentsafe`."""
    argv = sys.argv[1:] if argv is None else argv
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(INTRODUCTION)
        for verb, (_, what) in VERBS.items():
            print(f"  {verb:20s} {what}")
        return
    verb, *options = argv
    if verb not in VERBS:
        sys.exit(f"latentsafe: unknown verb {verb!r}; expected one of {', '.join(VERBS)}")
    # torchcodec without system FFmpeg logs a page of traceback; LeRobot then falls back to pyav by itself.
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
    module, _, name = VERBS[verb][0].rpartition(".")
    command = getattr(importlib.import_module(f"lerobot_latentsafe.{module or 'commands'}"), name)

    import draccus
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    try:
        draccus.parse(command, args=options).run()
    except draccus.utils.DecodingError as e:
        sys.exit(f"latentsafe {verb}: {e}")
    except (ValueError, OSError, RuntimeError, ImportError, KeyError) as e:
        sys.exit(f"latentsafe {verb}: {e.args[0] if isinstance(e, KeyError) else e}")


if __name__ == "__main__":
    main()
