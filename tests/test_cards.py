import json
import re
from pathlib import Path

import pytest
import yaml

from lerobot_latentsafe.datasets.collect import FEATURES, POSITION, SOURCES, WITH_POSITION

FOLDER = Path(__file__).parents[1] / "datasets_cards"


def features(source):
    return {**FEATURES, **(POSITION if source in WITH_POSITION else {})}


@pytest.mark.parametrize("source", SOURCES)
def test_card_matches_the_dataset(source):
    text = (FOLDER / f"dubins_{source}.md").read_text()
    blocks = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 1
    assert json.loads(blocks[0]) == {
        "fps": 20,
        "robot_type": "latentsafe_dubins",
        "features": {
            name: {"dtype": f["dtype"], "shape": list(f["shape"])} for name, f in features(source).items()
        },
    }  # fmt: skip


@pytest.mark.parametrize("source", SOURCES)
def test_card_has_a_header_and_the_command_that_makes_it(source):
    text = (FOLDER / f"dubins_{source}.md").read_text()
    header = yaml.safe_load(re.match(r"---\n(.*?)\n---\n", text, re.DOTALL)[1])
    assert header["license"] == "apache-2.0" and "LeRobot" in header["tags"]
    assert f"latentsafe collect --source={source} " in text
    assert all(f"`{name}`" in text for name in features(source))


def test_no_card_is_left_over():
    assert {card.stem for card in FOLDER.glob("*.md")} == {f"dubins_{source}" for source in SOURCES}


def test_recorded_dataset_is_what_the_card_says(dataset_root):
    info = json.loads((dataset_root / "meta" / "info.json").read_text())
    card = json.loads(re.search(r"```json\n(.*?)```", (FOLDER / "dubins_random.md").read_text(), re.DOTALL)[1])
    assert (info["fps"], info["robot_type"]) == (card["fps"], card["robot_type"])
    for name, feature in card["features"].items():
        assert info["features"][name]["dtype"] == feature["dtype"]
        assert list(info["features"][name]["shape"]) == feature["shape"]
    of_lerobot = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
    assert set(info["features"]) == set(card["features"]) | of_lerobot
