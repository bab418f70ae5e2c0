import json
import re
from pathlib import Path

import pytest
import yaml

from lerobot_latentsafe.collection import franka, so101
from lerobot_latentsafe.collection.dubins import FEATURES, POSITION, SOURCES, WITH_POSITION
from lerobot_latentsafe.franka.scenes import SCENES

FOLDER = Path(__file__).parents[1] / "datasets_cards"


CARDS = {f"dubins_{source}": source for source in SOURCES} | {
    source: source for source in (*franka.SOURCES, *so101.SOURCES)
}
"""Name of a card -> what `latentsafe collect` calls the source."""


def recorded(source):
    """fps, robot type and features of a source's dataset."""
    if source in SOURCES:
        return 20, "latentsafe_dubins", {**FEATURES, **(POSITION if source in WITH_POSITION else {})}
    if source in so101.SOURCES:
        return so101.FPS, so101.LatentSafeSO101Mujoco.name, so101.FEATURES
    of_franka = franka.SOURCES[source]
    return SCENES[of_franka.scene].fps, "latentsafe_franka_mujoco", franka.features(of_franka)


@pytest.mark.parametrize("card", CARDS)
def test_card_matches_the_dataset(card):
    text = (FOLDER / f"{card}.md").read_text()
    blocks = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 1
    fps, robot_type, features = recorded(CARDS[card])
    assert json.loads(blocks[0]) == {
        "fps": fps,
        "robot_type": robot_type,
        "features": {name: {"dtype": f["dtype"], "shape": list(f["shape"])} for name, f in features.items()},
    }


@pytest.mark.parametrize("card", CARDS)
def test_card_has_a_header_and_the_command_that_makes_it(card):
    text = (FOLDER / f"{card}.md").read_text()
    header = yaml.safe_load(re.match(r"---\n(.*?)\n---\n", text, re.DOTALL)[1])
    assert header["license"] == "apache-2.0" and "LeRobot" in header["tags"]
    assert f"latentsafe collect --source={CARDS[card]} " in text
    assert all(f"`{name}`" in text for name in recorded(CARDS[card])[2])


@pytest.mark.parametrize("card", franka.SOURCES)
def test_card_gives_the_counts_that_were_measured(card):
    counts = json.loads((FOLDER.parent / "results" / "franka" / "balance.json").read_text())[card]
    stated = re.search(r"^At seed \d+: .*$", (FOLDER / f"{card}.md").read_text(), re.MULTILINE)[0].replace(",", "")
    for name in ("episodes", "frames", "failing_episodes", "failing_frames", "successful_episodes"):
        assert str(counts[name]) in re.findall(r"\d+", stated)


def test_no_card_is_left_over():
    assert {card.stem for card in FOLDER.glob("*.md")} == set(CARDS)


def test_recorded_dataset_is_what_the_card_says(dataset_root):
    info = json.loads((dataset_root / "meta" / "info.json").read_text())
    card = json.loads(re.search(r"```json\n(.*?)```", (FOLDER / "dubins_random.md").read_text(), re.DOTALL)[1])
    assert (info["fps"], info["robot_type"]) == (card["fps"], card["robot_type"])
    for name, feature in card["features"].items():
        assert info["features"][name]["dtype"] == feature["dtype"]
        assert list(info["features"][name]["shape"]) == feature["shape"]
    of_lerobot = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
    assert set(info["features"]) == set(card["features"]) | of_lerobot
