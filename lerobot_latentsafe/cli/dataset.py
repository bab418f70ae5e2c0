"""Verbs that look at a dataset before any work, and that make it one that can be used."""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_latentsafe.cli.options import DatasetSource
from lerobot_latentsafe.datasets.adoption import meanings_of
from lerobot_latentsafe.datasets.overview import (
    Row,
    advice,
    cached_cameras,
    check_first_pictures,
    feature_rows,
    label_rows,
    rows,
)
from lerobot_latentsafe.datasets.reading import DatasetContractError
from lerobot_latentsafe.datasets.renaming import renamed_copy


@dataclass
class CheckDataset:
    """Print what a dataset says of its robot, cameras and labels, and say whether a filter can be made of it.

    latentsafe check-dataset --dataset.root=data/bag

    Exits with 0 if it can and 1 if not; the last line says why. Numbers are read whole; of each camera one picture is
    decoded. All other commands refuse what this refuses, before they start.
    """

    dataset: DatasetSource = field(default_factory=DatasetSource)

    def run(self) -> None:
        """Check and print."""
        try:
            last = self._checked()
        except (ValueError, OSError) as e:
            print(f"cannot be used: {' '.join(str(e).split())}")
            sys.exit(1)
        print(last)

    def _checked(self) -> str:
        """Prints the table; what the last line says.

        Raises:
            ValueError, OSError: the dataset cannot be used.
        """
        meta = self.dataset.found()
        try:
            contract = self.dataset.contract()[1]
        except DatasetContractError:
            _show(feature_rows(meta))
            raise
        _show(rows(contract))
        cached, labels = cached_cameras(meta), label_rows(meta)
        _show(cached + labels)
        check_first_pictures(meta, contract)
        _show([("note", line) for line in advice(meta, contract)])
        if not contract.cameras and not cached:
            known = ", ".join(contract.left_out) or "none"
            raise DatasetContractError(
                f"{meta.repo_id} has no camera that a filter could see by (left out: {known}); record one that shows "
                "colours or grey"
            )
        meanings_of(contract)
        if not labels:
            return "can be used: it has no failure labels yet; latentsafe label makes them"
        return "can be used: numbers, pictures and labels are whole"


def _show(table: list[Row]) -> None:
    for what, how in table:
        print(f"{what:11s} {how}")


@dataclass
class RenameFeatures:
    """Copy a dataset with other names of its features, so that they are those that LeRobot's policies expect.

    latentsafe rename-features --dataset.root=data/bag --output_dir=data/bag_renamed \\
      --rename_map='{"actions": "action", "state": "observation.state", "image": "observation.images.front"}'

    LeRobot hands a policy `action` and what begins with `observation.`, and nothing else. Nothing is encoded again;
    videos are shared with the original where the disk can do that.
    """

    rename_map: dict[str, str]
    """Name that is found -> name that is wanted, as in lerobot-eval."""
    output_dir: Path
    """The folder to write."""
    dataset: DatasetSource = field(default_factory=DatasetSource)

    def run(self) -> None:
        """Copy."""
        self.dataset.require_whole("rename-features", "leave it out")
        renamed_copy(Path(self.dataset.found().root), self.rename_map, self.output_dir)
        print(f"{', '.join(self.rename_map.values())} in {self.output_dir}")
        print(f"see what it holds: latentsafe check-dataset --dataset.root={self.output_dir}")
