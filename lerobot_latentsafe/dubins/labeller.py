"""Labels of recordings of the car, from its recorded position: `latentsafe auto-label --labeller=dubins_truth`."""

from typing import Protocol

import numpy as np

from lerobot_latentsafe.dubins import car


class RecordedEpisode(Protocol):
    """An episode of a dataset, as labellers see it."""

    def column(self, name: str) -> np.ndarray:
        """(T, D) of a column."""


def dubins_truth(episode: RecordedEpisode) -> np.ndarray:
    """Privileged truth: a frame fails, 1, where the car's recorded position is inside the disc, and else is safe, 0."""
    position = episode.column("observation.environment_state")
    return (np.hypot(*position.T) < car.RADIUS).astype(int)
