import re

import numpy as np
import pytest

from lerobot_latentsafe.cli import main
from lerobot_latentsafe.evaluation import report


@pytest.fixture(scope="module")
def page(tiny_filter, tiny_diffusion, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "deep" / "report.html"
    main(
        ["report", f"--policy.path={tiny_filter}", f"--base_policy_path={tiny_diffusion}", "--n_episodes=3",
         "--env.type=latentsafe_dubins", "--env.episode_length=6", "--epsilon=0.3", f"--output={path}"]
    )  # fmt: skip
    return path.read_text()


def test_report_is_one_file_that_needs_nothing_else(page):
    assert not re.findall(r'(?:src|href)="(?!data:)', page) and "http" not in re.sub(r'"data:[^"]*"', "", page)


def test_report_shows_rates_curves_and_imagination(page):
    assert page.count("<video") == 3 and page.count("<svg") == 6  # V and l, and the one command that varies
    assert "95% intervals" in page and "/3 = " in page and "epsilon = 0.3" in page
    assert "imagined" in page or "never saw a reason" in page
    assert "not a certified safety device" in page


def test_text_is_escaped():
    assert "<b>" not in report.heading("<b>") + report.table(["<b>"], [["<b>"]]) + report.chart({"<b>": np.ones(3)}, 10)


def test_chart_leaves_gaps_and_shades_what_is_asked():
    svg = report.chart({"V": np.array([0.0, np.nan, 1.0])}, 10, np.array([False, True, True]), level=0.5)
    assert svg.count("<rect") == 2 and "nan" not in svg and "stroke-dasharray" in svg


def test_report_without_a_base_policy_is_about_the_filter_alone(tiny_filter, tmp_path):
    path = tmp_path / "report.html"
    main(["report", f"--policy.path={tiny_filter}", "--env.type=latentsafe_dubins", f"--output={path}"])
    assert "The safe set" in path.read_text() and "<video" not in path.read_text()


def test_no_episodes_is_a_message(tiny_filter, capsys):
    with pytest.raises(SystemExit, match="--n_episodes is 0"):
        main(["report", f"--policy.path={tiny_filter}", "--env.type=latentsafe_dubins", "--n_episodes=0"])
