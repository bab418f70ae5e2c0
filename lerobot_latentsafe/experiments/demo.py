"""What the demonstrations share: commands run one by one, each with a log and a line on the screen."""

import os
import subprocess
import sys
import time
from pathlib import Path

BIN = Path(sys.executable).parent
SIDE_BY_SIDE = "bare | shielded; orange: the filter acts"
NO_GUARANTEE = "A learned filter is not a certified safety device: it carries no guarantee."


class Demo:
    """Runs commands of this Python's environment, with their output in a log each and one line a step on the screen.

    Args:
        out: folder, new, for logs and whatever the commands write.
    """

    def __init__(self, out: Path):
        self.out, self.started = out, time.time()
        self.environment = {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "TQDM_DISABLE": "1"}
        (out / "logs").mkdir(parents=True)

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.time() - self.started

    def run(self, what: str, *command: str) -> None:
        """Run a command, such as `latentsafe cache ...`, to its end; what is before a colon names its log.

        Raises:
            SystemExit: it failed; with the end of its output.
        """
        log = self.out / "logs" / f"{what.split(':')[0].replace(' ', '_')}.log"
        print(f"[{self.seconds:4.0f} s] {what}", flush=True)
        with log.open("a") as stream:
            stream.write(f"$ {' '.join(command)}\n")
            stream.flush()
            done = subprocess.run(
                [str(BIN / command[0]), *command[1:]], stdout=stream, stderr=subprocess.STDOUT, env=self.environment
            )
        if done.returncode:
            tail = "\n".join(log.read_text().splitlines()[-15:])
            raise SystemExit(f"demo: '{what}' failed; the end of {log}:\n{tail}")
