"""How verbs go, and what goes on beside them: what is typed after a kill, and what must not be lost by it."""

import http.client
import json
import os
import re
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from unittest.mock import patch

import huggingface_hub.utils
import torch
from huggingface_hub import constants
from lerobot.scripts import lerobot_train

from lerobot_latentsafe.collection.whole_episodes import COMPLETE
from lerobot_latentsafe.datasets.label_places import sidecar_path
from lerobot_latentsafe.datasets.labels import Content, Sidecar
from lerobot_latentsafe.datasets.layout import INFO
from lerobot_latentsafe.experiments.kills.files import content, differences, left_by
from lerobot_latentsafe.experiments.kills.hub_stub import Hub
from lerobot_latentsafe.experiments.labelling_cost import get, post
from lerobot_latentsafe.experiments.virtual_time import VirtualTime
from lerobot_latentsafe.labeling.store import first_failing
from lerobot_latentsafe.shield import Shield

Run = Callable[[list[str]], None]
"""The command `latentsafe`, given what is typed after it."""


class Course:
    """Of a verb that goes by itself: the same is typed again after a kill, and it ends as if there had been none.

    Args:
        out: the folder of one run, in which the verb writes `out`. A course lasts from its start, over a kill, to its
            end.
    """

    def __init__(self, out: Path):
        self.out = out

    def __enter__(self) -> "Course":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def run(self, words: list[str], run: Run) -> None:
        """Run the verb, in a process of its own."""
        run(words)

    def beside(self, process: int, log: Path) -> AbstractContextManager[None]:
        """What goes on in this process while another runs the verb, and says into `log` what it prints."""
        return nullcontext()

    def again(self, typed: list[str]) -> list[str]:
        """What is typed after a kill."""
        return typed

    def lost(self, whole: dict[str, object]) -> list[str]:
        """What is gone right after a kill, before anything is started again, of what was said to be saved.

        Args:
            whole: what an undisturbed run has left.
        """
        return []


class LeRobotTraining(Course):
    """`lerobot-train` goes on from its last checkpoint; one that was killed before its first is started anew."""

    def run(self, words: list[str], run: Run) -> None:
        """LeRobot's own command."""
        sys.argv = words
        lerobot_train.main()

    def again(self, typed: list[str]) -> list[str]:
        """From the last checkpoint, which LeRobot names anew after each."""
        checkpoints = self.out / "out" / "checkpoints"
        known = [checkpoints / "last", *sorted(checkpoints.glob("0*"))[-2::-1]]
        configs = [checkpoint / "pretrained_model" / "train_config.json" for checkpoint in known]
        for config in configs:
            if config.exists():
                return ["lerobot-train", f"--config_path={config}", "--resume=true"]
        shutil.rmtree(self.out / "out", ignore_errors=True)
        return typed


class Recording(Course):
    """`record` stores whole episodes, and goes on with the next. Its clock is the simulation's, so that all are alike.

    In real time the number of frames of an episode would depend on the load of the machine. Nothing is drawn at random
    by the filter, whose values would depend on what was drawn before.
    """

    def run(self, words: list[str], run: Run) -> None:
        """On a clock that does not pass while the machine computes."""
        clock = VirtualTime()
        with (
            patch.object(torch, "rand_like", partial(torch.full_like, fill_value=0.5)),
            patch.object(time, "perf_counter", clock.perf_counter),
            patch.object(time, "sleep", clock.sleep),
            patch.object(Shield.__init__, "__defaults__", (clock.perf_counter,)),
        ):
            run(words)

    def again(self, typed: list[str]) -> list[str]:
        """So many episodes as are missing; an episode that is complete joins at the start."""
        if not (self.out / "out").exists():
            return typed
        saved = max(_episodes(self.out / "out" / COMPLETE), _episodes(self.out / "out"))
        asked = next(word for word in typed if word.startswith("--dataset.num_episodes="))
        missing = int(asked.partition("=")[2]) - saved
        return [*(word for word in typed if word != asked), f"--dataset.num_episodes={missing}", "--resume=true"]

    def lost(self, whole: dict[str, object]) -> list[str]:
        """Files of episodes that the dataset says it has: each has its own."""
        number = {name: re.search(r"file-(\d+)", name) for name in whole}
        saved = [name for name, found in number.items() if found and int(found[1]) < _episodes(self.out / "out")]
        return [name for name in saved if not _same(self.out / "out" / name, whole[name])]


def _episodes(root: Path) -> int:
    """How many episodes a dataset says it has; 0 before it says anything."""
    with suppress(OSError, ValueError, KeyError):
        return int(json.loads((root / INFO).read_text())["total_episodes"])
    return 0


def _same(file: Path, whole: object) -> bool:
    return file.exists() and repr(content(file)) == repr(whole)


class Labelling(Course):
    """`label` serves a page. A person answers on it, opens it again after a kill, and closes it after the last answer.

    Attributes:
        confirmed: how many answers came, over a kill.
    """

    REPO, SPECIFICATION, PAUSE_S = "me/demonstrations", "crashed", 0.02

    def __init__(self, out: Path):
        super().__init__(out)
        self.content = Content(out / "out")
        self.confirmed = 0

    @property
    def answers(self) -> list[tuple[int, int]]:
        """Episodes and their first failing frames: all of them, and then every third is corrected."""
        lengths = self.content.spans[1].tolist()
        given = [(episode, 7 * episode % (length + 1)) for episode, length in enumerate(lengths)]
        return [*given, *((episode, length) for episode, length in list(enumerate(lengths))[::3])]

    def run(self, words: list[str], run: Run) -> None:
        """Until it is interrupted, which ends it as it should."""
        try:
            run(words)
        except SystemExit as e:
            if e.code != "latentsafe label: interrupted":
                raise

    @contextmanager
    def beside(self, process: int, log: Path) -> Iterator[None]:
        """The person, in a thread."""
        ended = threading.Event()
        person = threading.Thread(target=self._answer, args=(process, log, ended))
        person.start()
        try:
            yield
        finally:
            ended.set()
            person.join()

    def _answer(self, process: int, log: Path, ended: threading.Event) -> None:
        """Give the answers that were not confirmed yet, and interrupt the server; a killed one ends it, too."""
        while (found := re.search(r"http://\S+/", log.read_text())) is None:
            if ended.wait(0.01):
                return
        address, place = found.group(), f"api/labels/{self.SPECIFICATION}"
        with suppress(OSError, http.client.HTTPException, ValueError):  # an answer that is cut is no JSON
            seen = {entry["episode"]: entry["at"] for entry in get(address, place)["entries"]}
            for episode, first in self.answers[self.confirmed :]:
                asked = {"episode": episode, "first": first, "seen": seen[episode], "tab": "tab"}
                seen[episode] = post(address, place, asked)["entry"]["at"]
                self.confirmed += 1
                time.sleep(self.PAUSE_S)
            os.kill(process, signal.SIGINT)

    def lost(self, whole: dict[str, object]) -> list[str]:
        """Answers that were confirmed. The one that was on its way may be saved or not."""
        confirmed, on_its_way = dict(self.answers[: self.confirmed]), self.answers[self.confirmed :][:1]
        if not confirmed:
            return []
        path = sidecar_path(self.out / "out", self.SPECIFICATION, self.REPO)
        failure, (start, length) = Sidecar.read(path, self.content, self.REPO).failure, self.content.spans
        saved = {e: first_failing(failure[start[e] : start[e] + length[e]]) for e in confirmed}
        wrong = [e for e, first in confirmed.items() if saved[e] != first and (e, saved[e]) not in on_its_way]
        return [f"the answer on episode {episode}" for episode in wrong]


class Pushing(Course):
    """`push` uploads to a Hub on this machine that takes its time; what can be pulled from it is compared."""

    def __init__(self, out: Path):
        super().__init__(out)
        self.hub = Hub(pause_s=0.02)

    def __enter__(self) -> "Pushing":
        self.hub.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self.hub.__exit__(*error)
        self._pull()

    def run(self, words: list[str], run: Run) -> None:
        """To that Hub."""
        for name, value in self.hub.settings(self.out / "cache").items():
            setattr(constants, name, value)
        os.environ |= {"HF_TOKEN": "hf_nobody", "NO_PROXY": "127.0.0.1"}
        huggingface_hub.utils.close_session()
        run(words)

    def lost(self, whole: dict[str, object]) -> list[str]:
        """Files, if some of them are there: they come all at once."""
        found = self._pull()
        return differences(found, whole) if found else []

    def _pull(self) -> dict[str, object]:
        """Write what the Hub has to where other verbs write; what it is."""
        for repo, files in self.hub.repos.items():
            for name, written in files.items():
                file = self.out / "out" / repo / name
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(written)
        return left_by(self.out / "out")
