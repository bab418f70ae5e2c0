"""Labels of episodes that went to another dataset: joined, cut or copied, each is known again by its content."""

from pathlib import Path

from lerobot_latentsafe.datasets.fingerprints import by_length_alone
from lerobot_latentsafe.datasets.label_places import FOLDER, NAME, LabelFileError, specifications_of
from lerobot_latentsafe.datasets.labels import Content, Sidecar
from lerobot_latentsafe.labeling.store import LabelStore


def carry_labels(store: LabelStore, sources: list[Path]) -> dict[str, int]:
    """Take over the labels of other datasets for the episodes that are the same; the later verdict counts.

    Args:
        sources: folders of datasets, or of label files; see `specifications_in`.

    Returns:
        For each specification of the store, how many episodes have other labels than before.
    """
    changed = dict.fromkeys(store.specifications, 0)
    for source in sources:
        for name, moved in _labels_of(source, store).items():
            changed[name] += store.take(name, moved)
    return changed


def specifications_in(sources: list[Path]) -> list[str]:
    """Names of all labels in these folders.

    Raises:
        LabelFileError: a folder has none.
    """
    found: list[str] = []
    for source in sources:
        root = _dataset_of(source)
        names = specifications_of(root) if root else _stems(source)
        if not names:
            raise LabelFileError(
                f"{source} has no label files; expected the folder of a labelled dataset, or one with "
                "<specification>.parquet, such as those in LeRobot's home: labels/<owner>/<name>"
            )
        found += [name for name in names if name not in found]
    return found


def _labels_of(source: Path, store: LabelStore) -> dict[str, Sidecar]:
    """On the frames of the store's dataset: specification -> labels, of those that have the same episodes."""
    moved, root = {}, _dataset_of(source)
    if root is None:
        for name in _stems(source):
            moved[name] = Sidecar.read(source / f"{name}.parquet", store.content, by_place=False)
        return moved
    content = Content(root)
    columns = [name for name in content.columns if name in store.content.columns]
    for name in specifications_of(root):
        labels = Sidecar.find(root, name, content)
        there = None
        if not by_length_alone(columns):
            there = labels.moved(store.content, columns, content.fingerprints(columns), content.spans[1].tolist())
        if there is None:
            raise LabelFileError(
                f"no episode of {store.root} is one of {root}: actions, states and lengths differ; nothing was carried "
                "over. Is it the dataset that this one was made of?"
            )
        moved[name] = there
    return moved


def _dataset_of(source: Path) -> Path | None:
    """The dataset's folder, if that or its labels/ is named."""
    root = source.parent if source.name == FOLDER else source
    return root if (root / "data").is_dir() else None


def _stems(folder: Path) -> list[str]:
    return sorted(file.stem for file in folder.glob("*.parquet") if NAME.fullmatch(file.stem))
