"""Recording without pages of what the libraries tell of each video and table."""

import logging

import av
from datasets import disable_progress_bars

from lerobot_latentsafe._compat import quiet_decoder


def quiet_recording() -> None:
    """Have libraries of this process say what is wrong, and nothing else, while datasets are recorded."""
    quiet_decoder()
    # LeRobot restores libav's own messages after each video.
    av.logging.set_libav_level(av.logging.ERROR)
    disable_progress_bars()
    logging.getLogger("lerobot").setLevel(logging.WARNING)
