"""What the command lines of the bag's experiments share: filters, their laws, how many starts."""

from argparse import ArgumentParser, Namespace

from lerobot_latentsafe.decision import LAWS, LawOptions
from lerobot_latentsafe.experiments.filter_settings import FilterSetting

DECIDES = {"epsilon": float, "proposal_steps": int, "resume_above": float}
"""Options of a law that the experiments may change."""


def add_filter_options(parser: ArgumentParser, n: int) -> None:
    """The filters of an experiment, how they decide, and how many starts: by default n."""
    parser.add_argument("--filters", nargs="+", required=True)
    parser.add_argument("--n", type=int, default=n)
    for name, kind in DECIDES.items():
        parser.add_argument(f"--law.{name}", dest=name, type=kind, help="by default the filter's own")
    parser.add_argument("--workers", type=int, default=1, help="processes")


def add_laws(parser: ArgumentParser) -> None:
    """The laws that are compared, see `filter_settings`."""
    parser.add_argument(
        "--laws", nargs="+", choices=LAWS, default=["reachability", "plan", "margin"],
        help="the first for all filters, the others for the first filter",
    )  # fmt: skip


def filter_settings(arguments: Namespace, laws: list[str]) -> list[FilterSetting]:
    """Filters under the first law, and the first of them under the others, which are what it is compared with."""
    paths, changed = arguments.filters, {name: getattr(arguments, name) for name in DECIDES}
    pairs = [(path, laws[0]) for path in paths] + [(paths[0], law) for law in laws[1:]]
    return [FilterSetting.of(path, LawOptions(name=law, **changed)) for path, law in pairs]


def named_paths(parser: ArgumentParser, option: str, pairs: list[str]) -> dict[str, str]:
    """Name -> path, of pairs NAME=PATH; ends with a message where one is no pair.

    Args:
        option: that they were given to, such as `--models`.
    """
    wrong = [pair for pair in pairs if not all(pair.partition("="))]
    if wrong:
        parser.error(f"{option} is {' '.join(wrong)}; expected NAME=PATH of each, such as gru=outputs/bag/final_0")
    return {name: path for name, _, path in (pair.partition("=") for pair in pairs)}
