"""A job of a few files, which loads no torch: its tasks say how they are to end."""

import os
import signal
import threading
from dataclasses import dataclass
from pathlib import Path

from lerobot_latentsafe.runtime.tasks import Job


@dataclass(frozen=True)
class Files:
    """Each task writes a file, unless another one, `<task>.<how>`, says how it fails; the last one lists them."""

    folder: Path

    def job(self):
        return Job("files", self.work, self.done, self.finish, self.folder / "job.tasks")

    def work(self, task):
        if (self.folder / f"{task}.full").exists():
            raise OSError(28, "No space left on device")
        if (self.folder / f"{task}.killed").exists():
            os.kill(os.getpid(), signal.SIGKILL)
        if (self.folder / f"{task}.long").exists():
            threading.Event().wait()
        with (self.folder / f"{task}.txt").open("a") as file:
            file.write("once")

    def done(self, task):
        return (self.folder / f"{task}.txt").exists()

    def finish(self):
        done = sorted(file.name for file in self.folder.glob("*.txt"))
        (self.folder / "all").write_text(" ".join(done))
