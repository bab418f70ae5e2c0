"""One tiny dataset, frame cache, filter and diffusion policy, made once and shared by all tests."""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["HF_HUB_DISABLE_PROGRESS_BARS"] = "1"
os.environ["TQDM_DISABLE"] = "1"
os.environ["MPLBACKEND"] = "Agg"
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["TOKENIZERS_PARALLELISM"] = "false"

import logging
import shutil
import time

import faulty
import pytest
import tiny
import torch
from hypothesis import settings

from lerobot_latentsafe.experiments.virtual_time import VirtualTime

torch.set_num_threads(1)
# The same examples in every run of the suite; scripts/fuzz.py draws others.
settings.register_profile("suite", max_examples=75, derandomize=True, database=None)
settings.load_profile("suite")
# torchcodec without system FFmpeg logs a page of traceback; LeRobot then falls back to pyav by itself.
logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)


LONGEST = (
    "test_distributed.py",
    "test_pretrained.py",
    "test_labeling_page.py",
    "test_token_cache.py",
    "test_sharded_cache.py",
    "test_verbs_in_tasks.py",
)


def pytest_collection_modifyitems(items):
    """The files that take longest come first: cores that are done early take from what is left."""
    place = {name: i for i, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.name, len(place)))


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def no_hurry(monkeypatch, request):
    """Filters decide as in a simulation that waits for them, unless a test brings a clock: no machine is too slow."""
    from lerobot_latentsafe.guard import standing_still
    from lerobot_latentsafe.shield import Shield

    monkeypatch.setattr(Shield.__init__, "__defaults__", (standing_still,))


@pytest.fixture
def virtual_time(monkeypatch):
    """The clock of LeRobot's loops, of a shielded robot and of its filter."""
    from lerobot_latentsafe.shield import Shield

    clock, make = VirtualTime(), Shield.__init__
    monkeypatch.setattr(time, "perf_counter", clock.perf_counter)
    monkeypatch.setattr(time, "sleep", clock.sleep)
    monkeypatch.setattr(Shield, "__init__", lambda self, filter, clock=clock.perf_counter: make(self, filter, clock))
    return clock


@pytest.fixture(scope="session")
def dataset_root(tmp_path_factory):
    """14 random episodes of the car, with failing and safe frames."""
    from lerobot_latentsafe.collection.dubins import collect_dubins

    root = tmp_path_factory.mktemp("data") / "car"
    collect_dubins("random", tiny.REPO_ID, root, n_episodes=14, seed=3)
    return root


@pytest.fixture(scope="session")
def dataset_meta(dataset_root):
    return tiny.metadata(dataset_root)


@pytest.fixture(scope="session")
def cache_root(dataset_root, tmp_path_factory):
    """The same dataset without images, with its frames at 32 pixels beside it."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_latentsafe.datasets.build_cache import build_frame_cache

    root = tmp_path_factory.mktemp("data") / "car_cache"
    build_frame_cache(LeRobotDataset(tiny.REPO_ID, root=dataset_root), root, 32)
    return root


@pytest.fixture(scope="session")
def token_root(dataset_root, tmp_path_factory):
    """The same dataset without images, with the offline encoder's tokens of its frames beside it."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_latentsafe.datasets.build_cache import build_frame_cache

    root = tmp_path_factory.mktemp("data") / "car_tokens"
    build_frame_cache(LeRobotDataset(tiny.REPO_ID, root=dataset_root), root, tiny.TOKEN_SIZE, tiny.tokens())
    return root


@pytest.fixture(scope="session")
def cache_meta(cache_root):
    return tiny.metadata(cache_root)


@pytest.fixture(scope="session")
def tiny_world_model(cache_meta, tmp_path_factory):
    """Folder of a filter after stage 1, discrete actions: its critic was never trained."""
    return tiny.train_stage_one(cache_meta, tmp_path_factory.mktemp("stage_one"))


@pytest.fixture(scope="session")
def tiny_filter(tiny_world_model, cache_meta, tmp_path_factory):
    """Folder of a filter with a trained critic, discrete actions."""
    from lerobot_latentsafe.training import train_reachability

    folder = tmp_path_factory.mktemp("filters") / "discrete"
    train_reachability(tiny_world_model, cache_meta, folder)
    return folder


@pytest.fixture(scope="session")
def tiny_continuous_filter(cache_meta, tmp_path_factory):
    """Folder of a filter with a trained critic, continuous actions."""
    from lerobot_latentsafe.training import train_reachability

    folder = tmp_path_factory.mktemp("filters")
    stage_one = tiny.train_stage_one(cache_meta, folder / "stage_one", fallback_action_candidates=None)
    train_reachability(stage_one, cache_meta, folder / "continuous")
    return folder / "continuous"


@pytest.fixture(scope="session")
def tiny_diffusion(tmp_path_factory):
    """Folder of a LeRobot DiffusionPolicy with random weights and its processors."""
    return tiny.save_diffusion(tmp_path_factory.mktemp("diffusion"))


@pytest.fixture(scope="session")
def tiny_dreamer(tmp_path_factory):
    """Output folder of a run of train-dreamer that was never interrupted."""
    from lerobot_latentsafe.experiments.blocks.dreamer_training import DreamerTraining

    folder = tmp_path_factory.mktemp("dreamer") / "run"
    with tiny.short_blocks():
        DreamerTraining(tiny.dreamer_options(folder)).run()
    return folder


@pytest.fixture(scope="session")
def benches(tiny_filter, tiny_continuous_filter, tmp_path_factory):
    """Small filters, name -> bench."""
    folder = tmp_path_factory.mktemp("benches")
    return {
        "car": faulty.car_bench(tiny_filter, lookahead=3),
        "car that forgets": faulty.car_bench(tiny_filter, lookahead=0, history_frames=4),
        "car of continuous actions": faulty.car_bench(tiny_continuous_filter, lookahead=2, proposal_steps=2),
        "two cameras": faulty.franka_bench(folder / "franka"),
        "joint targets": faulty.arm_bench(folder / "arm"),
    }


@pytest.fixture(params=faulty.BENCHES)
def bench(request, benches):
    """Each small filter."""
    return benches[request.param]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Folder of a tiny filter of the simulated Franka."""
    return tiny.save_franka_filter(tmp_path_factory.mktemp("filter") / "filter")


@pytest.fixture
def robot(trained):
    """A simulated Franka behind it."""
    from lerobot.robots.utils import make_robot_from_config
    from shielded_robots import config

    with make_robot_from_config(config(trained)) as made:
        yield made


@pytest.fixture
def policy(tiny_filter):
    """The tiny filter, loaded afresh."""
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

    return LatentSafePolicy.from_pretrained(tiny_filter)


@pytest.fixture
def filter_copy(tiny_filter, tmp_path):
    """A copy of the tiny filter's folder to break."""
    return shutil.copytree(tiny_filter, tmp_path / "copy")
