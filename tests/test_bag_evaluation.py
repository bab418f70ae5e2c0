"""Episodes of the bag, and what is said about them."""

import numpy as np
import pytest
import tiny

from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.experiments.bag import runs
from lerobot_latentsafe.experiments.filter_settings import FilterSetting, in_use
from lerobot_latentsafe.franka.behaviors import hold
from lerobot_latentsafe.reports import figures


def row(lost, first=None, success=False, steps=90):
    acted = [first is not None and t >= first for t in range(steps)]
    trace = {
        "value": [0.5] * steps,
        "margin": [0.6] * steps,
        "intervened": acted,
        "deviation": [0.5 * on for on in acted],
        "spilled": [0] * (steps - 1) + [lost],
    }
    return {
        "lost": lost, "success": success, "grasped": True, "overridden": sum(acted), "first": first,
        "cost": [1.0] * 3 + [0.01] * (steps - 3), **trace,
    }  # fmt: skip


def test_summary_counts_what_is_lost_and_overridden():
    cell = runs.summary([row(0, success=True), row(1, first=80), row(12, first=60)], n_candies=24)
    assert cell["spilled"]["k"] == 2 and cell["spilled_5_percent"]["k"] == 1 and cell["success"]["k"] == 1
    assert cell["stall"]["k"] == 0 and runs.summary([row(0), row(1)], n_candies=24)["stall"]["k"] == 1
    assert (cell["spills_below_5_percent"]["k"], cell["spills_below_5_percent"]["n"]) == (1, 2)
    assert cell["mean_share_lost"] == pytest.approx(13 / 72) and cell["overridden_share"] == pytest.approx(40 / 270)
    assert cell["deviation"] == pytest.approx(0.5 * 40 / 270)
    assert cell["median_first_override"] == 70 and cell["episodes_overridden"] == 2
    assert cell["decision_cpu_ms"]["p99"] == pytest.approx(10)  # the first decisions warm up


def test_summary_counts_spills_that_the_margin_does_not_see():
    late = {"spilled": [0, 1, 2, 2], "margin": [-0.5, 0.5, 0.5, -0.5]}
    cell = runs.summary([row(2) | late, row(0)], n_candies=24)
    assert cell["seen_after_a_spill"] == {"n": 2, "called_safe": 1}


def test_summary_of_an_operator_alone_says_nothing_of_a_filter():
    bare = row(0) | {"value": [], "intervened": [], "cost": []}
    cell = runs.summary([bare], n_candies=24)
    assert "overridden_share" not in cell and "decision_cpu_ms" not in cell and cell["spills_below_5_percent"] is None
    assert runs.in_short(cell) == "spilled 0/1, success 0/1, stall 1/1, share lost 0.000"


def test_filters_are_compared_with_the_bare_runs_each_and_together():
    bare = [row(20), row(20), row(0, success=True), row(20)]
    shielded = {"first": [row(0), row(1), row(0), row(0)], "second": [row(0), row(0), row(0, success=True), row(0)]}
    table = runs.against_bare(bare, shielded, n_candies=24)
    assert [table[name]["spilled_of_bare"] for name in ("first", "second", "pooled")] == pytest.approx(
        [1 / 3, 0, 1 / 6]
    )
    assert [table[name]["success_lost"] for name in ("first", "second", "pooled")] == pytest.approx([25, 0, 12.5])
    assert table["pooled"]["spilled"]["n"] == 8 and "paired_p" not in table["pooled"]
    assert table["second"]["paired_p"] == pytest.approx(0.25)


def test_figures_are_drawn(tmp_path):
    lost = {"weak": [20, 24, 0], "weak, shielded": [0, 1, 0], "strong": [0, 0, 1], "strong, shielded": [0, 0, 0]}
    figures.save(figures.severity(lost, 24), tmp_path / "severity.png")
    panels = {"closed end": runs.traces([row(3, first=40)] * 9), "open end": runs.traces([row(0)])}
    assert len(panels["closed end"]) == runs.N_TRACES
    figures.save(figures.value_profiles(panels, 0.3, 15), tmp_path / "profiles.png")
    assert all((tmp_path / f"{name}.png").stat().st_size > 5000 for name in ("severity", "profiles"))


@pytest.fixture(scope="module")
def scene():
    from lerobot_latentsafe.franka.bag import BagScene

    made = BagScene(image_size=32)
    yield made
    made.close()


@pytest.fixture(scope="module")
def setting(tmp_path_factory):
    folder = tiny.save_franka_filter(tmp_path_factory.mktemp("bag") / "filter", scene="bag", law_epsilon=0.25)
    return FilterSetting.of(str(folder), LawOptions(name="plan", proposal_steps=2))


def test_a_setting_is_the_filters_own_unless_given(setting):
    assert (setting.epsilon, setting.proposal_steps) == (0.25, 2)
    law = setting.load().config.law
    assert (law.name, law.epsilon, law.proposal_steps) == ("plan", 0.25, 2)


def test_a_table_notes_how_its_filters_remember_and_retreat(setting, tmp_path):
    assert in_use([setting]) == {setting.path: {"epsilon": 0.25, "guard": 2, "release": -1.0}}
    law = {"history_frames": 24, "retreat": {"delta_z.pos": -0.006}, "retreat_after": 1, "min_retreat_steps": 6}
    own = {f"law_{name}": value for name, value in law.items()}
    path = str(tiny.save_franka_filter(tmp_path / "filter", scene="bag", **own))
    other = FilterSetting.of(path, LawOptions(name="margin"))
    ways = {"memory": 24, "retreat": {"delta_z.pos": -0.006}, "patience": 1, "dwell": 6}
    assert in_use([other])[path].items() >= ways.items()


def test_an_overridden_operator_goes_on_trying(scene, setting, monkeypatch):
    monkeypatch.setattr(runs, "STEPS", 4)
    always = FilterSetting.of(setting.path, LawOptions(name="margin", epsilon=2.0))
    frames = []
    scene.reset(0)
    ended = runs.drive(scene, always.load(), hold(1.0, 2), frames)
    assert ended["adjusted"] == [False] * 4 and len(ended["deviation"]) == 4
    assert ended["intervened"] == [True] * 4 and ended["overridden"] == 4 and ended["first"] == 0
    assert len(frames) == len(ended["cost"]) == len(ended["value"]) == 4 and frames[0].shape == (32, 32, 3)
    assert ended["lost"] == 0 and not ended["success"] and not ended["grasped"]
    scene.reset(0)
    alone = runs.drive(scene, None, hold(1.0, 2))
    assert alone["value"] == [] and alone["first"] is None and np.isfinite(alone["spilled"]).all()
