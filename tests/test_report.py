import errno
import os
import re
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe import LatentSafeBagEnv, LatentSafeBlocksEnv
from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.cli import main
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reports import html
from lerobot_latentsafe.reports.filter_report import write_filter_report


@pytest.fixture(scope="module")
def page(tiny_filter, tiny_diffusion, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "deep" / "report.html"
    main(
        ["report", f"--policy.path={tiny_filter}", f"--base_policy_path={tiny_diffusion}", "--n_episodes=3",
         "--env.type=latentsafe_dubins", "--env.episode_length=6", "--law.epsilon=0.3", f"--output={path}"]
    )  # fmt: skip
    return path.read_text()


def test_report_is_one_file_that_needs_nothing_else(page):
    assert not re.findall(r'(?:src|href)="(?!data:)', page) and "http" not in re.sub(r'"data:[^"]*"', "", page)


def test_report_shows_rates_curves_and_imagination(page):
    assert page.count("<video") == 3 and page.count("<svg") == 6  # V and l, and the one command that varies
    assert "95% intervals" in page and "/3 = " in page and "epsilon = 0.3" in page
    assert "imagined" in page or "never saw a reason" in page
    assert "not a certified safety device" in page


def test_report_on_a_recording_without_a_filter_is_refused(tiny_filter, tmp_path):
    plain = SimpleNamespace(root=tmp_path, meta=SimpleNamespace(repo_id="me/cup"))
    policy = LatentSafePolicy.from_pretrained(tiny_filter)
    with pytest.raises(ValueError, match="me/cup was not recorded under a filter"):
        write_filter_report(tmp_path / "report.html", policy, None, 2, 0, plain)
    assert not (tmp_path / "report.html").exists()


@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError(errno.ENOSPC, "No space left on device")])
@pytest.mark.fault("K06", "a report is killed while it is written", "The report of before stays")
@pytest.mark.fault("D04", "the disk is full while a report is written", "The report of before stays")
def test_a_report_that_breaks_off_leaves_the_one_before(tmp_path, monkeypatch, failure):
    def breaks(descriptor):
        raise failure

    path = tmp_path / "report.html"
    html.write_report(path, "before", [])
    before = path.read_text()
    with monkeypatch.context() as patch, pytest.raises((KeyboardInterrupt, OSError)):
        patch.setattr(os, "fsync", breaks)
        html.write_report(path, "after", [])
    assert path.read_text() == before and [p.name for p in tmp_path.iterdir()] == ["report.html"]


class Still(BasePolicy):
    """A base policy that does not move, with the gripper open."""

    def __init__(self):
        self.planned = self.coming = None

    def reset(self):
        pass

    def replan(self, executed):
        pass

    def propose(self, observation):
        action = torch.zeros(len(observation["observation.state"]), 7)
        action[:, -1] = 1.0
        return action


def franka_page(tmp_path, env, **changes):
    """The report on a filter of the simulated Franka that always acts, in two episodes."""
    trained = tiny.save_franka_filter(tmp_path / "filter", scene=env.scene, law_epsilon=2.0, **changes)
    policy = LatentSafePolicy.from_pretrained(trained).eval()
    if perception := getattr(policy.model.world_model, "perception", None):
        perception.basis.axes.normal_(std=0.01)
        perception.basis.fitted.fill_(True)
    policy._base = [Still()]
    write_filter_report(tmp_path / "report.html", policy, env, 2, 0, None)
    return (tmp_path / "report.html").read_text()


def test_report_on_the_bag_shows_nearest_frames_and_severity(tmp_path):
    page = franka_page(tmp_path, LatentSafeBagEnv(image_size=32, episode_length=4), world_model=tiny.gru_config())
    assert page.count("cannot draw") == 2 and "of the 16 it has seen here" in page  # two episodes, bare and shielded
    assert page.count("imagined failure") == 4
    assert "How much was spilled" in page and page.count("0/2 = 0.0%") >= 8
    assert "safe set" not in page


def test_report_on_the_blocks_draws_what_was_imagined(tmp_path):
    page = franka_page(tmp_path, LatentSafeBlocksEnv(image_size=32, episode_length=4))
    assert page.count("imagined failure") == 4 and "cannot draw" not in page and "spilled" not in page


def test_text_is_escaped():
    assert "<b>" not in html.heading("<b>") + html.table(["<b>"], [["<b>"]]) + html.chart({"<b>": np.ones(3)}, 10)


def test_frames_of_a_video_stand_for_it_on_paper(tmp_path):
    from lerobot.utils.io_utils import write_video

    grey = [np.full((32, 48, 3), level, np.uint8) for level in range(0, 200, 20)]
    write_video(str(tmp_path / "run.mp4"), grey, 5)
    shown = html.video(tmp_path / "run.mp4", "a run")
    assert re.findall(r"<figcaption>(.*?)</figcaption>", shown) == ["0.0 s", "0.6 s", "1.2 s", "1.8 s", "a run"]
    assert len(set(re.findall(r'<img alt="" src="(.*?)"', shown))) == html.PRINTED


def test_chart_leaves_gaps_and_shades_what_is_asked():
    svg = html.chart({"V": np.array([0.0, np.nan, 1.0])}, 10, np.array([False, True, True]), level=0.5)
    assert svg.count("<rect") == 2 and "nan" not in svg and "stroke-dasharray" in svg


def test_report_without_a_base_policy_is_about_the_filter_alone(tiny_filter, tmp_path):
    path = tmp_path / "report.html"
    main(["report", f"--policy.path={tiny_filter}", "--env.type=latentsafe_dubins", f"--output={path}"])
    assert "The safe set" in path.read_text() and "<video" not in path.read_text()


def test_policy_without_a_place_to_run_it_is_a_message(tiny_filter, tiny_diffusion):
    with pytest.raises(SystemExit, match=r"Give --env.type"):
        main(["report", f"--policy.path={tiny_filter}", f"--base_policy_path={tiny_diffusion}"])


def test_no_episodes_is_a_message(tiny_filter, capsys):
    with pytest.raises(SystemExit, match="--n_episodes is 0"):
        main(["report", f"--policy.path={tiny_filter}", "--env.type=latentsafe_dubins", "--n_episodes=0"])
