"""A recording holds whole episodes, whenever it ends, and however: killed, out of disk, without power.

LeRobot writes all episodes into files that can be read only once the recording has ended. Here each episode is written
in a folder of its own, and joins the dataset when it is complete, with files of its own. A recording that was killed
is completed at the next start: an episode that was saved joins, one that was not is gone.
"""

import os
import shutil
import tempfile
from pathlib import Path

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.dataset_writer import DatasetWriter

from lerobot_latentsafe._compat import close_files, read_anew, write_into
from lerobot_latentsafe.datasets.layout import INFO
from lerobot_latentsafe.runtime.files import replacing_folder

WORK = ".recording"
"""The folder, in a dataset's, for the episode that is being recorded."""
COMPLETE = Path(WORK) / "complete"
"""The folder for a saved episode that has not joined the dataset yet."""


class WholeEpisodes(DatasetWriter):
    """LeRobot's writer of a dataset, by which an episode is in the dataset whole, or not at all."""

    def __init__(self, meta: LeRobotDatasetMetadata, root: Path, **options):
        super().__init__(meta, root, **options)
        self.dataset = Path(root)
        (self.dataset / WORK).mkdir(exist_ok=True)
        self.begun = Path(tempfile.mkdtemp(dir=self.dataset / WORK))
        write_into(self, self.begun)

    def save_episode(self, episode_data: dict | None = None, parallel_encoding: bool = True) -> None:
        """Write the episode, and have it join the dataset."""
        super().save_episode(episode_data, parallel_encoding)
        close_files(self)
        with replacing_folder(self.dataset / COMPLETE) as folder:
            folder.mkdir()
            for part in ("data", "meta", "videos"):
                if (self.begun / part).exists():
                    os.rename(self.begun / part, folder / part)
            self.write_beside(folder)
        complete(self.dataset)

    def write_beside(self, folder: Path) -> None:
        """Write, into a folder, what else joins the dataset with the episode that is being saved."""

    def finalize(self) -> None:
        """End the recording; of an episode that was not saved nothing stays."""
        super().finalize()
        recover(self.dataset)
        write_into(self, self.dataset)
        read_anew(self)


def complete(root: Path) -> None:
    """Let a saved episode join the dataset in `root`; until its info does, LeRobot reads the episodes before it."""
    files = [file for file in (root / COMPLETE).rglob("*") if file.is_file()]
    for file in sorted(files, key=lambda file: file.match(INFO)):
        joined = root / file.relative_to(root / COMPLETE)
        joined.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, joined)
    shutil.rmtree(root / COMPLETE, ignore_errors=True)


def recover(root: Path) -> None:
    """Complete what a recording left that was killed: the saved episode joins the dataset, the torn one goes."""
    if (root / COMPLETE).exists():
        complete(root)
    shutil.rmtree(root / WORK, ignore_errors=True)
