"""Frame caches in shards: they read as one in one piece does, and whatever is wrong with a shard is said."""

import json
import os
import shutil
import signal
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tiny
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.cli.command_line import parsed
from lerobot_latentsafe.datasets import cache_tasks
from lerobot_latentsafe.datasets.build_cache import build_frame_cache
from lerobot_latentsafe.datasets.cache_recipes import Pictures
from lerobot_latentsafe.datasets.cache_shards import ShardedArray
from lerobot_latentsafe.datasets.cache_tasks import ShardedBuild, build_sharded_cache
from lerobot_latentsafe.datasets.frame_cache import FrameCache, FrameCacheError
from lerobot_latentsafe.datasets.join_caches import join_caches
from lerobot_latentsafe.datasets.labels import FailureLabels
from lerobot_latentsafe.datasets.overview import cached_cameras
from lerobot_latentsafe.runtime.tasks import Tasks, TasksFailedError, UnseenFolderError

N, SIZE = 4, 8


def build_of(root, output_dir, **changes):
    return ShardedBuild(**{
        "repo_id": tiny.REPO_ID, "root": root, "output_dir": output_dir, "image_size": SIZE, "recipe": Pictures,
        **changes,
    })  # fmt: skip


def percepts(root):
    cache = FrameCache.open(root, tiny.metadata(root))
    return {name: np.asarray(values) for name, values in {**cache.percepts, **cache.scales}.items()}


@pytest.fixture(scope="module")
def whole_root(dataset_root, tmp_path_factory):
    """A cache in one piece."""
    root = tmp_path_factory.mktemp("cache") / "whole"
    build_frame_cache(LeRobotDataset(tiny.REPO_ID, root=dataset_root), root, SIZE)
    return root


@pytest.fixture(scope="module")
def sharded_root(dataset_root, tmp_path_factory):
    """The same in four shards, made in no order."""
    build = build_of(dataset_root, tmp_path_factory.mktemp("cache") / "sharded")
    build.lay_out(N)
    for number in (2, 0, 3, 1):
        build.make(number)
    build.finish()
    return build.output_dir


@pytest.fixture
def broken(sharded_root, tmp_path):
    """A copy to break."""
    return shutil.copytree(sharded_root, tmp_path / "broken")


def test_shards_read_as_one_piece(sharded_root, whole_root):
    sharded, whole = (FrameCache.open(root, tiny.metadata(root)) for root in (sharded_root, whole_root))
    n = len(whole.state)
    for index in (np.arange(n), np.array([[0, n - 1], [n // 2, 3]]), np.zeros((2, 0), int)):
        (pictures, state), (expected, expected_state) = sharded.frames(index), whole.frames(index)
        np.testing.assert_array_equal(pictures["observation.image"], expected["observation.image"])
        np.testing.assert_array_equal(state, expected_state)
    assert sharded.manifest["version"] == 3 and whole.manifest["version"] == 2
    assert len({shard["name"] for shard in sharded.manifest["shards"]}) == N


def test_an_array_of_shards_is_read_like_an_array(tmp_path):
    rows = np.arange(30, dtype=np.float16).reshape(10, 3)
    files = [tmp_path / f"{i}.npy" for i in range(3)]
    for file, part in zip(files, np.split(rows, [2, 7])):
        np.save(file, part)
    array = ShardedArray(files, [2, 5, 3])
    for index in (0, -1, slice(None), slice(1, 8, 3), [[9, 0], [2, 2]], []):
        np.testing.assert_array_equal(array[index], rows[np.array(index, int) if index == [] else index])
    assert (len(array), array.shape, array.dtype, array.nbytes) == (10, (10, 3), np.float16, 60)
    with pytest.raises(IndexError, match="rows 3 to 10 of 10"):
        array[[3, 10]]


def test_more_shards_than_a_process_may_open_are_read_all_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr("lerobot_latentsafe.datasets.cache_shards.OPEN", 2)
    files = [tmp_path / f"{i}.npy" for i in range(5)]
    for i, file in enumerate(files):
        np.save(file, np.full(2, i))
    array = ShardedArray(files, [2] * 5)
    np.testing.assert_array_equal(array[:], np.arange(5).repeat(2))
    assert len(array._maps) == 2


def remove(root, shard):
    shutil.rmtree(shard)


def cut(root, shard):
    file = shard / "observation.image.npy"
    file.write_bytes(file.read_bytes()[:-50])


def shorten(root, shard):
    np.save(shard / "observation.image.npy", np.load(shard / "observation.image.npy")[:-1])


def tear_note(root, shard):
    (shard / "shard.json").write_text('{"frames": 3')


def other_encoder(root, shard):
    note = json.loads((shard / "shard.json").read_text())
    tiny.rewrite_json(shard / "shard.json", made_of={**note["made_of"], "encoder_hash": "abc"})


def replace_by_another(root, shard):
    shutil.rmtree(shard)
    shutil.copytree(shard.parent / "00002", shard)


def index(root, change):
    manifest = root / "frame_cache" / "manifest.json"
    tiny.rewrite_json(manifest, shards=change(json.loads(manifest.read_text())["shards"]))


FAULTS = {
    "missing": (remove, r"shard .*00001 is missing.*all must see the same --output_dir.*latentsafe cache again"),
    "cut off": (cut, r"shard .*00001 is torn.*observation\.image\.npy.*remove it and .*manifest\.json.*anew"),
    "too short": (shorten, r"00001 is torn: observation\.image\.npy holds \d+ frames, not"),
    "note is torn": (tear_note, r"00001 is torn \(shard\.json"),
    "of another encoder": (other_encoder, r"00001 was made with encoder_hash = abc, the others with None; all shards"),
    "another shard": (replace_by_another, "00001 is not the one that the index means"),
    "twice in the index": (lambda root, _: index(root, lambda s: [*s, s[1]]), "names the shard 00001 twice"),
    "not in the index": (lambda root, _: index(root, lambda s: s[1:]), r"holds arrays of .* frames, not"),
    "index is empty": (lambda root, _: index(root, lambda s: []), "names no shard"),
    "index lacks digests": (
        lambda root, _: index(root, lambda s: [{"name": "00000"}]),
        "index of shards lacks 'frames'",
    ),
    "elsewhere": (lambda root, _: index(root, lambda s: [{**s[0], "name": "../x"}]), r"\.\./x, which is no shard"),
}


@pytest.mark.fault("D08", "a shard of a cache is missing, torn, of another encoder or twice in the index", "A message")
@pytest.mark.parametrize("fault", FAULTS)
def test_a_shard_that_is_wrong_is_refused(broken, fault):
    change, said = FAULTS[fault]
    change(broken, broken / "frame_cache" / "shards" / "00001")
    with pytest.raises(FrameCacheError, match=said):
        FrameCache.open(broken)


def test_changed_bytes_are_found_by_their_digest(broken):
    file = broken / "frame_cache" / "shards" / "00002" / "observation.image.npy"
    array = np.load(file, mmap_mode="r+")
    array[-1] ^= 1
    array.flush()
    meta = tiny.metadata(broken)
    assert FrameCache.open(broken, meta)  # training does not read everything first
    with pytest.raises(FrameCacheError, match=r"00002/observation\.image\.npy is not what was written.*make.* it anew"):
        cached_cameras(meta)


def test_what_is_removed_is_made_anew_and_the_same(dataset_root, broken, sharded_root):
    """As the errors advise."""
    build = build_of(dataset_root, broken)
    shutil.rmtree(broken / "frame_cache" / "shards" / "00001")
    (broken / "frame_cache" / "manifest.json").unlink()
    made = {path: path.stat().st_mtime_ns for path in broken.rglob("*.npy")}
    build.lay_out(N)
    for number in range(N):
        build.make(number)
    build.finish()
    assert all(path.stat().st_mtime_ns == at for path, at in made.items())
    manifests = [json.loads((root / "frame_cache" / "manifest.json").read_text()) for root in (broken, sharded_root)]
    assert manifests[0] == manifests[1]


def test_a_node_that_sees_another_folder_says_so(dataset_root, broken, cache_root, tmp_path):
    shutil.rmtree(broken / "frame_cache" / "shards" / "00001")
    with pytest.raises(UnseenFolderError, match=r"does not see .*frame_cache.*, which another.*same --output_dir"):
        build_of(dataset_root, tmp_path / "local_disk").make(1)
    with pytest.raises(FrameCacheError, match=r"sees another dataset in .*, or has another encoder"):
        build_of(dataset_root, broken, image_size=16).make(1)
    with pytest.raises(ValueError, match="there is no folder"):
        build_of(tmp_path / "nowhere", broken).make(1)
    with pytest.raises(FrameCacheError, match=r"00001 is missing\. If all tasks have ended, another computer wrote it"):
        build_of(dataset_root, broken).finish()


def test_a_task_list_that_changed_is_refused(dataset_root, broken, tmp_path):
    build = build_of(dataset_root, broken)
    with pytest.raises(FileExistsError, match="exists already"):
        build.lay_out(N)  # it is finished
    (broken / "frame_cache" / "manifest.json").unlink()
    with pytest.raises(
        FileExistsError, match=r"another number of shards \(it is cut for --tasks\.number=4\); give the"
    ):
        build.lay_out(5)
    with pytest.raises(FileExistsError, match=r"another choice of episodes; give the same"):
        build.lay_out(N, [0, 1, 2, 3])
    with pytest.raises(FileExistsError, match="another size or encoder; give the same"):
        build_of(dataset_root, broken, image_size=16).lay_out(N)
    with pytest.raises(ValueError, match=r"--tasks\.number is 15, and there are 14 episodes; give fewer"):
        build_of(dataset_root, tmp_path / "new").lay_out(15)


def test_a_full_disk_in_one_task_leaves_the_other_shards(dataset_root, sharded_root, tmp_path, monkeypatch):
    pytest.importorskip("datatrove")
    allocate = cache_tasks.allocate

    def full(file, dtype, shape):
        if "00002" in str(file):
            raise OSError(28, f"{os.strerror(28)}: {file.parent} needs 3 GB for one array, and 1 GB are free")
        allocate(file, dtype, shape)

    build = build_of(dataset_root, tmp_path / "cache")
    with monkeypatch.context() as patch, pytest.raises(TasksFailedError, match=r"1 of 4 tasks failed.* 3 GB for one"):
        patch.setattr(cache_tasks, "allocate", full)
        build_sharded_cache(build, Tasks(N))
    assert [build.is_made(number) for number in range(N)] == [True, True, False, True]
    build_sharded_cache(build, Tasks(N))
    for name, expected in percepts(sharded_root).items():
        np.testing.assert_array_equal(percepts(tmp_path / "cache")[name], expected)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cache"]


class Deadly(Pictures):
    """Pictures whose process is killed in the middle of a shard, once."""

    def __init__(self, cameras, image_size, mark):
        super().__init__(cameras, image_size)
        self.mark, self.seen = mark, 0

    def perceive(self, images):
        self.seen += 1
        if self.seen == 5 and self.mark.exists():
            self.mark.unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().perceive(images)


@pytest.mark.fault("K52", "a worker is killed while it makes a shard", "Its shard is made by the same command again")
def test_four_tasks_of_two_workers_one_killed_equal_one_process(dataset_root, whole_root, tmp_path):
    pytest.importorskip("datatrove")
    mark = tmp_path / "mark"
    build = build_of(dataset_root, tmp_path / "cache", recipe=partial(Deadly, mark=mark))
    mark.touch()
    with pytest.raises(TasksFailedError, match="a worker was killed"):
        build_sharded_cache(build, Tasks(N, workers=2))
    assert not mark.exists() and not all(build.is_made(number) for number in range(N))
    build_sharded_cache(build, Tasks(N))
    for name, expected in percepts(whole_root).items():
        np.testing.assert_array_equal(percepts(tmp_path / "cache")[name], expected)


def test_the_command_makes_shards(dataset_root, whole_root, tmp_path, capsys):
    pytest.importorskip("datatrove")
    given = [f"--dataset.repo_id={tiny.REPO_ID}", f"--dataset.root={dataset_root}", f"--image_size={SIZE}"]
    cache = parsed("cache", [*given, f"--output_dir={tmp_path / 'cache'}", "--tasks.number=2"])
    cache.run()
    assert "train with --dataset.repo_id=me/car_cache" in capsys.readouterr().out
    for name, expected in percepts(whole_root).items():
        np.testing.assert_array_equal(percepts(tmp_path / "cache")[name], expected)


def test_the_file_for_a_cluster_on_the_page_is_read(tmp_path):
    page = (Path(__file__).parents[1] / "docs" / "scaling.md").read_text()
    file = tmp_path / "cluster.yaml"
    file.write_text(page.split("```yaml")[1].split("```")[0])
    tasks = parsed("cache", [f"--config_path={file}"]).tasks
    assert (tasks.number, tasks.workers, tasks.executor) == (1000, 100, "slurm")
    assert tasks.options == {"partition": "cpu", "time": "4:00:00", "cpus_per_task": 4, "mem_per_cpu_gb": 4}
    tasks = parsed(
        "cache", ["--output_dir=x", "--tasks.number=2", "--tasks.executor=ray", "--tasks.options={time: 9}"]
    ).tasks
    assert tasks.options == {"time": 9}


# -- several datasets ---


@pytest.fixture(scope="module")
def joined(sharded_root, whole_root, tmp_path_factory):
    """A cache in shards and one in one piece, joined; the second has a label file."""
    second = shutil.copytree(whole_root, tmp_path_factory.mktemp("cache") / "second")
    n = tiny.metadata(second).total_frames
    (second / "labels").mkdir()
    pq.write_table(pa.table({"index": range(n), "failure": np.arange(n) % 2}), second / "labels" / "failure.parquet")
    root = tmp_path_factory.mktemp("cache") / "joined"
    join_caches([sharded_root, second], "me/joined", root)
    return root, [sharded_root, second]


def test_joined_caches_read_one_after_the_other_and_take_no_room(joined):
    root, sources = joined
    cache, parts = FrameCache.open(root, tiny.metadata(root)), [FrameCache.open(source) for source in sources]
    for name in ("state", "action"):
        np.testing.assert_array_equal(getattr(cache, name), np.concatenate([getattr(p, name) for p in parts]))
    key = "observation.image"
    expected = np.concatenate([np.asarray(p.percepts[key]) for p in parts])
    np.testing.assert_array_equal(np.asarray(cache.percepts[key]), expected)
    assert len(cache.manifest["shards"]) == N + 1
    FrameCache.check_content(root)
    assert all(file.stat().st_nlink > 1 or file.is_symlink() for file in root.glob("frame_cache/shards/*/*.npy"))


def test_labels_of_joined_caches_come_along(joined):
    """The first has a column, the second a file, too."""
    root, sources = joined
    expected = np.concatenate([FailureLabels.load(source).failure for source in sources])
    np.testing.assert_array_equal(FailureLabels.load(root).failure, expected)


def test_training_reads_shards_of_several_datasets(joined):
    """A batch gives the same losses, whichever dataset its windows come from."""
    root, sources = joined
    n = tiny.metadata(sources[0]).total_frames
    losses = []
    for place, at in ((sources[0], 0), (root, 0), (root, n)):
        torch.manual_seed(0)
        config = tiny.rssm_config(image_size=SIZE)
        policy = tiny.new_policy(tiny.metadata(place), world_model=config, margin_weight=0.0)
        torch.manual_seed(0)
        losses.append(policy.forward({"index": at + torch.tensor([0, 5, n // 2, n - 1])})[0].item())
    assert losses[0] == pytest.approx(losses[1], rel=1e-4) and losses[1] == pytest.approx(losses[2], rel=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (dict(image_size=16), r"has image_size = 16, the one in .*whole has 8.*--basis_from="),
        (dict(basis_hash="abc"), "has basis_hash = abc, the one in"),
    ],
)
def test_caches_that_differ_are_not_joined(whole_root, tmp_path, change, said):
    other = shutil.copytree(whole_root, tmp_path / "other")
    tiny.rewrite_json(other / "frame_cache" / "manifest.json", **change)
    with pytest.raises(FrameCacheError, match=said):
        join_caches([whole_root, other], "me/joined", tmp_path / "joined")
    assert not (tmp_path / "joined").exists()


@pytest.mark.parametrize("times", [0, 2])
def test_a_source_is_named_once(whole_root, tmp_path, times):
    with pytest.raises(ValueError, match=r"expected folders of cached datasets, each once"):
        join_caches([whole_root] * times, "me/joined", tmp_path / "joined")
