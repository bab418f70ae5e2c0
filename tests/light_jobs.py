"""Jobs of a few files, which load no torch: their tasks say how they are to end."""

import os
import signal
import threading
from dataclasses import dataclass
from pathlib import Path

from lerobot_latentsafe.runtime.tasks import Job, Pieces


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
        return (self.folder / "all").write_text(" ".join(done))


@dataclass(frozen=True)
class Squares(Pieces):
    """Squares of numbers, unless a file `<number>.<how>` says how one fails; `of` is what this computer sees."""

    output: Path
    n: int
    of: str = "squares"

    name = "squares"

    @property
    def numbers(self):
        return range(0, 2 * self.n, 2)

    def begin(self):
        return Files(self.output.parent)

    def made_of(self, files):
        return {"of": self.of}

    def do(self, files, numbers):
        for number in numbers:
            files.work(number)
            yield number**2

    def finish(self, results):
        self.output.write_text(str(results))
        return results
