import shutil

import numpy as np
import pytest
import tiny
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.cli import main
from lerobot_latentsafe.datasets.columns import push_dataset, write_columns
from lerobot_latentsafe.datasets.labels import FailureLabels, LabelFileError
from lerobot_latentsafe.labeling.store import LabelStore
from lerobot_latentsafe.runtime.hub import HubUnreachableError


@pytest.fixture
def root(dataset_root, tmp_path):
    root = shutil.copytree(dataset_root, tmp_path / "car")
    store = LabelStore(root, tiny.REPO_ID, ["failure", "spilled"])
    for specification in store.specifications:
        store.label(specification, 3, 2, "ann")
        store.label(specification, 4, int(store.length[4]), "ann")
    store.close()
    return root


def test_labels_become_columns_that_training_reads(root, tmp_path, capsys):
    main(["write-labels", f"--dataset.repo_id={tiny.REPO_ID}", f"--dataset.root={root}", "--new_repo_id=me/labelled",
          f"--output_dir={tmp_path / 'labelled'}", "--specifications=[failure,spilled]"])  # fmt: skip
    assert "failure, spilled" in capsys.readouterr().out and not (tmp_path / "labelled" / "labels").exists()
    for name in ("failure", "spilled"):
        assert np.array_equal(
            FailureLabels.load(tmp_path / "labelled", name).failure, FailureLabels.load(root, name).failure
        )
    item = LeRobotDataset("me/labelled", root=tmp_path / "labelled")[0]
    assert int(item["spilled"]) == -1 and item["observation.image"].shape == (3, 128, 128)
    assert not any(p.name.startswith("tmp") for p in tmp_path.iterdir())


def test_specification_without_a_file_is_a_message(root, tmp_path):
    with pytest.raises(LabelFileError, match=r"no label file 'spilt'; it has failure, spilled"):
        write_columns(LeRobotDataset(tiny.REPO_ID, root=root), ["spilt"], tmp_path / "out", "me/out")
    assert not (tmp_path / "out").exists()


def test_folder_that_exists_is_kept(root, tmp_path):
    (tmp_path / "out").mkdir()
    with pytest.raises(FileExistsError, match="choose another --output_dir"):
        write_columns(LeRobotDataset(tiny.REPO_ID, root=root), ["spilled"], tmp_path / "out", "me/out")


def test_hub_that_is_down_is_a_message(root):
    with pytest.raises(HubUnreachableError, match="push it again later"):
        push_dataset(LeRobotDataset(tiny.REPO_ID, root=root))
