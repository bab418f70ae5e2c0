"""What LeRobot's loops say aloud: they have no call that begins an episode, they *say* so, to a person."""

import logging

from lerobot_latentsafe._compat import RECORDING, RESETTING, RETURNING


class LeRobotEvents(logging.Handler):
    """Hears LeRobot announce an episode, or what comes between episodes and after them, while it is `listening`."""

    def __init__(self):
        super().__init__(logging.INFO)
        self._heard: int | str | None = None

    def listen(self) -> None:
        logging.getLogger().addHandler(self)

    def stop(self) -> None:
        logging.getLogger().removeHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        said = str(record.msg)
        if recording := RECORDING.match(said):
            self._heard = int(recording[1])
        elif said.startswith((RESETTING, RETURNING)):
            self._heard = RESETTING if said.startswith(RESETTING) else RETURNING

    def take(self) -> int | str | None:
        """The last announcement since the last call: an episode's number, `RESETTING` or `RETURNING`."""
        heard, self._heard = self._heard, None
        return heard
