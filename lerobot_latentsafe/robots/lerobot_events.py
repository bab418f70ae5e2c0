"""Events of LeRobot's loops, heard in what they log: no call tells a robot that an episode begins."""

import logging

from lerobot_latentsafe._compat import RECORDING, RESETTING, RETURNING


class LeRobotEvents(logging.Handler):
    """Hears in LeRobot's log when an episode begins or ends, between `listen` and `stop`."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._heard: int | str | None = None

    def listen(self) -> None:
        """Begin to hear what LeRobot logs."""
        logging.getLogger().addHandler(self)

    def stop(self) -> None:
        """Hear nothing any more."""
        logging.getLogger().removeHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Note what a line of the log announces, if anything."""
        said = str(record.msg)
        if recording := RECORDING.match(said):
            self._heard = int(recording[1])
        elif said.startswith((RESETTING, RETURNING)):
            self._heard = RESETTING if said.startswith(RESETTING) else RETURNING

    def take(self) -> int | str | None:
        """The last event since the last call: the number of an episode that begins, `RESETTING` or `RETURNING`."""
        heard, self._heard = self._heard, None
        return heard
