"""The built wheel, as LeRobot's commands find it."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]

# Run with the wheel's content first on the path: what a LeRobot command does before it parses its options.
DISCOVER = """
import json, sys
import lerobot.configs.policies, lerobot.processor
from lerobot.utils.import_utils import register_third_party_plugins
before = set(sys.modules)  # with transformers installed, LeRobot loads it itself
register_third_party_plugins()
loaded = sorted(set(sys.modules) - before)
import gymnasium
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.robots.config import RobotConfig
from lerobot.teleoperators.config import TeleoperatorConfig
import lerobot_latentsafe, lerobot_policy_latentsafe
from lerobot_latentsafe.world_models.base import WorldModelConfig
print(json.dumps({
    "loaded": loaded,
    "files": [lerobot_latentsafe.__file__, lerobot_policy_latentsafe.__file__],
    "policies": list(PreTrainedConfig.get_known_choices()),
    "envs": list(EnvConfig.get_known_choices()),
    "robots": list(RobotConfig.get_known_choices()),
    "teleoperators": list(TeleoperatorConfig.get_known_choices()),
    "world_models": list(WorldModelConfig.get_known_choices()),
    "gym": [name for name in gymnasium.registry if name.startswith("lerobot_latentsafe/")],
}))
"""


def run(*command, **options):
    done = subprocess.run([sys.executable, *map(str, command)], capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of a copy of this repository."""
    copy, out = tmp_path_factory.mktemp("copy") / "repository", tmp_path_factory.mktemp("wheel")
    shutil.copytree(
        REPOSITORY, copy, ignore=shutil.ignore_patterns(".*", "outputs", "*.egg-info", "__pycache__", "build", "dist")
    )
    run("-m", "build", "--wheel", "--no-isolation", "--outdir", out, copy)
    (built,) = out.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The wheel unpacked, as pip would into --target."""
    target = tmp_path_factory.mktemp("installed")
    zipfile.ZipFile(wheel).extractall(target)
    return target


@pytest.fixture(scope="module")
def discovered(installed, tmp_path_factory):
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    out = run("-c", DISCOVER, cwd=tmp_path_factory.mktemp("elsewhere"), env=environment)
    return json.loads(out.splitlines()[-1])


def test_wheel_is_named_as_lerobot_looks_for_it(wheel):
    assert wheel.name.startswith("lerobot_policy_latentsafe-") and wheel.name.endswith("-py3-none-any.whl")


def test_wheel_holds_every_module_and_checkpoint(installed):
    package = REPOSITORY / "lerobot_latentsafe"
    folders = ("pretrained", "franka/assets", "labeling/page")
    files = [package / "cli" / "options.json"]
    data = {folder: [f for f in (package / folder).rglob("*") if f.is_file()] for folder in folders}
    assert all(data.values())
    wanted = [*package.rglob("*.py"), *files, *(f for files in data.values() for f in files)]
    missing = [f.relative_to(REPOSITORY) for f in wanted if not (installed / f.relative_to(REPOSITORY)).exists()]
    assert [f for f in missing if f.parts[1] != "_plugin"] == []
    assert (installed / "lerobot_policy_latentsafe" / "__init__.py").exists()


def test_wheel_names_command_licence_and_dependencies(installed):
    (information,) = installed.glob("*.dist-info")
    assert "latentsafe = lerobot_latentsafe.cli:main" in (information / "entry_points.txt").read_text()
    metadata = (information / "METADATA").read_text()
    for line in ("License-Expression: Apache-2.0", "Requires-Python: ", "Requires-Dist: lerobot[", "ground-truth"):
        assert line in metadata
    assert list(information.rglob("LICENSE"))


def test_wheel_holds_nothing_else(installed):
    top = {entry.name.split("-")[0] for entry in installed.iterdir()}
    assert top == {"lerobot_latentsafe", "lerobot_policy_latentsafe"}


def test_lerobot_discovers_policy_env_and_world_model(discovered, installed):
    assert all(Path(file).is_relative_to(installed) for file in discovered["files"])  # not this repository's
    assert "latentsafe" in discovered["policies"]
    assert {"latentsafe_dubins", "latentsafe_bag", "latentsafe_blocks", "latentsafe_so101"} <= set(discovered["envs"])
    assert {"latentsafe_franka_mujoco", "latentsafe_so101_mujoco", "latentsafe_shielded"} <= set(discovered["robots"])
    assert {"latentsafe_scripted", "latentsafe_end_effector", "latentsafe_so101_leader"} <= set(
        discovered["teleoperators"]
    )
    assert "rssm" in discovered["world_models"]
    assert discovered["gym"] == [f"lerobot_latentsafe/{name}-v0" for name in ("Dubins", "Bag", "Blocks", "SO101")]


def test_importing_the_package_loads_nothing_heavy(discovered):
    assert "lerobot_latentsafe" in discovered["loaded"]
    heavy = {
        "mujoco", "mink", "franky", "matplotlib", "scipy", "jax", "hj_reachability", "transformers", "datasets",
        "pandas",
        "lerobot_latentsafe.modeling_latentsafe", "lerobot_latentsafe.dubins.car", "lerobot_latentsafe.cli",
        "lerobot_latentsafe.api",
    }  # fmt: skip
    assert heavy.isdisjoint(discovered["loaded"])
