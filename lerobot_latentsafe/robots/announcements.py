"""What lerobot-record says aloud: it has no call that begins an episode, it *says* so, to a person."""

import logging
import re

RECORDING = re.compile(r"Recording episode (\d+)$")
RESETTING = "Reset the environment"


class Announcements(logging.Handler):
    """Hears LeRobot announce an episode, or the pause between two (`log_say`), while it is `listening`."""

    def __init__(self):
        super().__init__(logging.INFO)
        self._heard: int | str | None = None

    def listen(self) -> None:
        logging.getLogger().addHandler(self)

    def stop(self) -> None:
        logging.getLogger().removeHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        said = record.getMessage()
        recording = RECORDING.match(said)
        if recording:
            self._heard = int(recording[1])
        elif said == RESETTING:
            self._heard = RESETTING

    def take(self) -> int | str | None:
        """The last announcement since the last call: an episode's number, or `RESETTING`."""
        heard, self._heard = self._heard, None
        return heard
