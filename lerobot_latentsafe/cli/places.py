"""Options that say where something is, which several verbs share, in LeRobot's grammar; nothing is looked at here."""

from dataclasses import dataclass


@dataclass
class DatasetPlace:
    """A LeRobotDataset: its id, and its folder if it is not in LeRobot's home."""

    repo_id: str = "local/dataset"
    """Its id, such as me/bag."""
    root: str | None = None
    """Its folder; by default LeRobot's own for this id."""
    episodes: list[int] | None = None
    """Numbers of the episodes to use, such as [0,1,2]; by default all."""

    def require_whole(self, verb: str, remedy: str) -> None:
        """Refuse `episodes` where a verb reads whole datasets.

        Raises:
            ValueError: with the remedy.
        """
        if self.episodes is not None:
            raise ValueError(f"--dataset.episodes: {verb} reads whole datasets; {remedy}")


@dataclass
class PolicySource:
    """A checkpoint."""

    path: str
    """A folder, a Hub id, or the name of a committed checkpoint (see `latentsafe path`)."""


@dataclass
class DefaultPolicySource(PolicySource):
    """A checkpoint, by default the committed filter of the car."""

    path: str = "dubins"
    """A folder, a Hub id, or the name of a committed checkpoint (see `latentsafe path`)."""


@dataclass
class OptionalPolicySource:
    """A checkpoint, or none."""

    path: str | None = None
    """A folder, a Hub id, or the name of a committed checkpoint (see `latentsafe path`)."""
