"""The verbs that make a guard, and a monitor of the unknown: what needs no training."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_latentsafe.cli.options import DatasetSource, OptionalDatasetSource
from lerobot_latentsafe.cli.places import PolicySource
from lerobot_latentsafe.guarding import new_guard, with_guard
from lerobot_latentsafe.looks import ALTERATIONS
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.monitoring import fit_monitor
from lerobot_latentsafe.runtime.files import refuse_existing
from lerobot_latentsafe.runtime.hub import save_policy
from lerobot_latentsafe.units import TrainedOn

UNSEEN = 1.0
"""Standard deviations that a number of the state goes, unseen by a camera, beyond which that is said."""


@dataclass
class KnownBeforehand:
    """What names and data do not tell."""

    meanings: dict[str, str] | None = None
    """Command -> target, delta, velocity or other, of commands that names and data do not tell."""
    cameras: list[str] | None = None
    """The cameras to guard; by default all."""


@dataclass
class GuardedPolicy:
    """A filter that is to learn what a guard knows, or none."""

    path: str | None = None
    """A filter; by default a new guard is made."""
    trained_on: KnownBeforehand = field(default_factory=KnownBeforehand)


@dataclass
class Guard:
    """Make a guard of recorded episodes, in about a minute: it needs no labels and no training.

    latentsafe guard --dataset.repo_id=me/data --output_dir=outputs/guard

    A guard stops what is out of range, late, a jump, or seen by a camera that is dead, frozen, exchanged or upside
    down, and holds the robot where it is. It foresees nothing: it has no V. Wherever a filter goes, it goes, too, such
    as `latentsafe wrap`, `record` and `teleoperate`, and shielded robots.

    With --policy.path=<filter> that filter, with its weights, learns what a guard knows of the dataset's cameras, and
    its limits if it is of an older version.
    """

    output_dir: Path
    """The folder to write."""
    dataset: DatasetSource = field(default_factory=DatasetSource)
    policy: GuardedPolicy = field(default_factory=GuardedPolicy)

    def run(self) -> None:
        """Make it, save it, and say what it can tell."""
        refuse_existing(self.output_dir)
        meta, contract = self.dataset.contract()
        contract = contract.only(self.dataset.episodes)
        if self.policy.path:
            policy = with_guard(load_filter(self.policy.path), meta, contract)
        else:
            known = self.policy.trained_on
            policy = new_guard(meta, contract, known.meanings, known.cameras)
        save_policy(policy, self.output_dir)
        print("\n".join(told(policy.config.trained_on)))
        kind = "a filter that knows its cameras" if self.policy.path else "a guard; it has no V, and foresees nothing"
        print(f"wrote {self.output_dir}: {kind}")


@dataclass
class Monitor:
    """Fit a monitor that says when the scene is unknown, to a filter or a guard: it needs no training.

    latentsafe monitor --policy.path=outputs/filter --dataset.root=data/held_out --output_dir=outputs/monitored \\
      --reference.root=data/bag

    Give healthy episodes with pictures that the filter was not trained on, driven as they will be; those with a frame
    that is labelled as failing are left out. An alarm comes in --alpha of such episodes at most. That needs 19 for 5%,
    and a few more to learn from. With --reference.root, what is familiar is learned of that recording, such as the one
    that the filter was trained on, and fewer are enough.

    A camera alarms that shows what the data do not; the dynamics alarm where what follows is not what the world model
    foretold. What is done then is --policy.law.unknown: hold (the default), hand_over, slow, or warn.
    """

    policy: PolicySource
    output_dir: Path
    """The folder to write."""
    dataset: DatasetSource = field(default_factory=DatasetSource)
    reference: OptionalDatasetSource = field(default_factory=OptionalDatasetSource)
    alpha: float = 0.05
    """The chance of any alarm in a healthy episode."""
    dynamics: bool = True
    """Whether to watch what follows from the actions, too; false: the cameras alone, which takes less of a tick."""

    def run(self) -> None:
        """Fit it, save the filter with it, and say what it promises."""
        refuse_existing(self.output_dir)
        policy = load_filter(self.policy.path)
        meta, contract = self.dataset.contract()
        reference = None
        if self.reference.repo_id or self.reference.root:
            known, all_of_it = self.reference.contract()
            reference = known, all_of_it.only(self.reference.episodes)
        fit_monitor(policy, meta, contract.only(self.dataset.episodes), self.alpha, reference, self.dynamics)
        save_policy(policy, self.output_dir)
        record = policy.config.trained_on.monitor
        print(
            f"wrote {self.output_dir}: any alarm in {record.alpha:.3g} of healthy episodes at most, by "
            f"number {record.rank} of {record.episodes} episodes; {record.fitted_on} more were learned from"
        )


def told(trained_on: TrainedOn) -> Iterator[str]:
    """What can be told of each camera, and what not, in words."""
    for key, look in (trained_on.looks or {}).items():
        others = [name for name in trained_on.looks if name != key]
        untold = [name for name in [*ALTERATIONS, *others] if name not in look.told]
        unseen = [name for name, went in zip(trained_on.state_names, look.unseen) if went > UNSEEN]
        yield f"{key}: {look.frames} frames; it can be told whether it is {', '.join(look.told) or 'dead'}"
        if untold:
            yield f"{key}: the data do not tell whether it is {', '.join(untold)}"
        if unseen:
            yield f"{key}: it does not see {', '.join(unseen)} move, so it may be frozen while only these do"
