"""Labels and decisions as data: columns of a copy of the dataset, for those who have only LeRobot."""

from pathlib import Path

import numpy as np
from lerobot.datasets.dataset_tools import delete_episodes, modify_features, remove_feature
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.datasets.decisions import FILE, decision_columns
from lerobot_latentsafe.datasets.label_places import LabelFileError, specifications_of
from lerobot_latentsafe.datasets.labels import Content, Sidecar, read_frames
from lerobot_latentsafe.runtime.files import refuse_existing, replacing_folder, scratch_folder
from lerobot_latentsafe.runtime.hub import HUB_FAILURES, HubUnreachableError

COLUMN = {"dtype": "int64", "shape": (1,), "names": None}


def write_columns(
    dataset: LeRobotDataset, specifications: list[str], output_dir: str | Path, repo_id: str
) -> LeRobotDataset:
    """A copy of a dataset with one column of 1 (failing), 0 (safe), -1 (unlabelled) for each specification.

    A column of the same name is replaced: the label file was started from it.

    Raises:
        LabelFileError: a specification without a label file.
        FileExistsError: output_dir exists.
    """
    refuse_existing(output_dir)
    content, columns = Content(dataset.root), {}
    for name in specifications:
        found = Sidecar.find(dataset.root, name, content, dataset.repo_id)
        if found is None:
            known = ", ".join(specifications_of(dataset.root, dataset.repo_id)) or "none; run latentsafe label first"
            raise LabelFileError(f"{dataset.repo_id} has no label file {name!r}; it has {known}")
        columns[name] = (found.failure.astype("int64"), COLUMN)
    return _with_columns(dataset, columns, output_dir, repo_id)


def write_decisions(
    dataset: LeRobotDataset, output_dir: str | Path, repo_id: str, episodes: list[int] | None = None
) -> LeRobotDataset:
    """A copy of a recording with the shield's decisions as columns `shield.proposed`, `.value`, `.margin`,
    `.intervened`, `.adjusted` (0 or 1 each) and `.reason` (a `Reason`).

    Args:
        episodes: which of them to copy; by default all.

    Raises:
        FileNotFoundError: it was not recorded by `latentsafe record`.
        ValueError: the decisions belong to another dataset.
        FileExistsError: output_dir exists.
    """
    refuse_existing(output_dir)
    frames = read_frames(dataset.root, ["frame_index", "action"])
    meant = np.isin(frames["episode_index"], range(dataset.num_episodes) if episodes is None else episodes)
    found = decision_columns(Path(dataset.root) / FILE, {name: values[meant] for name, values in frames.items()})
    columns = {}
    for name, values in found.items():
        names = dataset.meta.features["action"]["names"] if name == "proposed" else None
        shape = values.shape[1:] or (1,)
        columns[f"shield.{name}"] = (values, {"dtype": str(values.dtype), "shape": shape, "names": names})
    left_out = sorted({*range(dataset.num_episodes)} - {*frames["episode_index"][meant].tolist()})
    return _with_columns(dataset, columns, output_dir, repo_id, left_out)


def _with_columns(
    dataset: LeRobotDataset, columns: dict, output_dir: str | Path, repo_id: str, left_out: list[int] | None = None
) -> LeRobotDataset:
    """A copy of a dataset with these columns, each (values, feature); one of the same name is replaced.

    It is there whole or not at all, whenever the process is killed.
    """
    replaced = [name for name in columns if name in dataset.meta.features]
    with replacing_folder(output_dir) as folder, scratch_folder(output_dir) as steps:
        if left_out:
            dataset = delete_episodes(dataset, left_out, output_dir=steps / "part", repo_id=repo_id)
        if replaced:  # LeRobot refuses to add what it removes in the same pass
            dataset = remove_feature(dataset, replaced, output_dir=steps / "bare", repo_id=repo_id)
        modify_features(dataset, columns, output_dir=folder, repo_id=repo_id)
    return LeRobotDataset(repo_id, root=output_dir)


def push_dataset(dataset: LeRobotDataset, private: bool = False) -> None:
    """Push a dataset to the Hub.

    Raises:
        HubUnreachableError: the Hub did not answer or refused; the copy on disk is whole.
    """
    try:
        dataset.push_to_hub(private=private, tags=["latentsafe", "failure-labels"])
    except HUB_FAILURES as e:
        raise HubUnreachableError(
            f"cannot push {dataset.repo_id} ({type(e).__name__}: {e}). Check the connection and `hf auth login`; the "
            f"labelled copy in {dataset.root} is whole, push it again later"
        ) from e
