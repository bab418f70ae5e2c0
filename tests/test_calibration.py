import json
import logging
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
import tiny
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe import LatentSafeDubinsEnv
from lerobot_latentsafe.calibration import (
    ALL,
    Calibration,
    Scores,
    calibrate,
    check_options,
    curve,
    in_words,
    require_few_alarms,
)
from lerobot_latentsafe.cli import main, train
from lerobot_latentsafe.cli.deploy import Wrap
from lerobot_latentsafe.cli.options import DatasetSource
from lerobot_latentsafe.cli.places import PolicySource
from lerobot_latentsafe.cli.train import Calibrate
from lerobot_latentsafe.collection.dubins import collect_dubins
from lerobot_latentsafe.datasets.build_cache import build_frame_cache
from lerobot_latentsafe.datasets.episode_groups import groups_of, weights_of
from lerobot_latentsafe.datasets.fingerprints import SHORT, TrainedOnError, episode_marks, with_episodes
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.evaluation.decision_values import decision_values
from lerobot_latentsafe.evaluation.misses import CAUSES
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.reports.filter_report import write_filter_report
from lerobot_latentsafe.safety_model import UntrainedFilterError
from lerobot_latentsafe.training import load_with_cache
from lerobot_latentsafe.units import TrainedOn

HELD = 16


@dataclass
class Judged:
    """An episode as it was judged."""

    episode: int
    value: np.ndarray
    failure: np.ndarray


def failing(values, first_failure, episode=0):
    """An episode that fails from a frame on."""
    failure = np.zeros(len(values), int)
    failure[first_failure:] = 1
    return Judged(episode, np.array(values), failure)


def safe(*values, episode=100):
    return Judged(episode, np.array(values), np.zeros(len(values), int))


def scored(lowest, quiet=(0.9,)):
    """Scores of so many failing episodes, and lowest values of safe ones."""
    return Scores(dict(enumerate(lowest)), {100 + i: low for i, low in enumerate(quiet)})


EARLY = failing([0.9, 0.5, 0.3, 0.1, -0.4, -0.5], first_failure=4)
TEN = np.linspace(0.1, 1.0, 10)


@pytest.fixture(scope="module")
def held_root(tmp_path_factory):
    """Cached episodes of the car that no tiny filter was trained on."""
    folder = tmp_path_factory.mktemp("held")
    collect_dubins("random", "me/held", folder / "car", n_episodes=HELD, seed=77)
    build_frame_cache(LeRobotDataset("me/held", root=folder / "car"), folder / "cache", 32)
    return folder / "cache"


def command(filter, held_root, out, **options):
    """A calibration that there is evidence enough for."""
    given = dict(dataset=DatasetSource("me/held", str(held_root)), alpha=0.3, lead_steps=1)
    return Calibrate(PolicySource(str(filter)), out, **{**given, **options})


@pytest.fixture(scope="module")
def judgements(tiny_filter, held_root):
    """What the tiny filter would have decided by along them."""
    policy, reader = load_with_cache(tiny_filter, tiny.metadata(held_root, "me/held"))
    return decision_values(policy.model, reader, np.arange(HELD))


@pytest.fixture
def judged_already(judgements, monkeypatch):
    """The same, wherever a command asks again."""
    monkeypatch.setattr(train, "decision_values", lambda model, reader, episodes: [judgements[e] for e in episodes])


@pytest.fixture(scope="module")
def calibrated(tiny_filter, tiny_diffusion, held_root, tmp_path_factory):
    """Folder of the tiny filter, calibrated for the tiny policy."""
    out = tmp_path_factory.mktemp("calibrated") / "filter"
    files = {"json": out.parent / "scores.json", "figure": out.parent / "curve.png"}
    command(tiny_filter, held_root, out, base_policy_path=str(tiny_diffusion), **files).run()
    return out


# -- scores ---


@pytest.mark.parametrize("lead_steps, score", [(1, 0.1), (2, 0.3), (3, 0.5), (4, 0.9)])
def test_a_score_is_the_lowest_value_until_the_lead_before_the_failure(lead_steps, score):
    found = Scores.of([EARLY, safe(0.2, 0.31)], lead_steps)
    assert found.failing == {0: score} and found.safe == {100: 0.2} and found.too_early == 0


def test_what_fails_too_soon_cannot_be_warned_of_and_is_counted():
    found = Scores.of([EARLY, failing([0.9, 0.9], 1, episode=1), safe(1.0)], lead_steps=3)
    assert (list(found.failing), found.too_early) == ([0], 1)
    assert "1 more failed too soon" in in_words(calibrate(found, 0.5, 3, fps=20))


def test_an_episode_of_which_nobody_knows_whether_it_fails_is_neither():
    row = safe(0.5, 0.5)
    row.failure[1] = -1
    found = Scores.of([row], 1)
    assert (found.failing, found.safe, found.unlabelled) == ({}, {}, 1)


@pytest.mark.parametrize("rows", [[EARLY], [safe(1.0)], []], ids=["no safe", "no failing", "none"])
def test_one_kind_of_episode_is_not_enough(rows):
    with pytest.raises(ValueError, match=r"calibration needs both.*--n_episodes"):
        calibrate(Scores.of(rows, 3), 0.05, 3, fps=20)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("which", [0, 1], ids=["failing", "safe"])
@pytest.mark.fault("N05", "calibrate on values that are NaN", "Refused, with how many")
def test_a_value_that_is_not_finite_is_no_warning_and_no_silence(value, which):
    rows = [EARLY, safe(0.2, 0.9), safe(0.5, episode=101)]
    rows[which] = replace(rows[which], value=np.append(rows[which].value[:-1], value))
    with pytest.raises(ValueError, match="V is not finite in 1 of 3 held-out episodes"):
        Scores.of(rows, 3)


# -- the choice ---


CHOICES = [
    # scores, alpha, floor, quantile, epsilon, missed
    (TEN, 0.1, 0.0, 1.0, 1.0, 0),  # k = 10
    (TEN, 0.2, 0.0, 0.9, 0.9, 1),  # k = ceil(8.8)
    (TEN, 0.3, 0.0, 0.8, 0.8, 2),
    (np.r_[np.full(8, 0.5), 0.9, 0.9], 0.3, 0.0, 0.5, 0.5, 2),  # ties are warned of together
    (TEN - 1, 0.2, 0.0, -0.1, 0.0, 0),  # at 0 the filter itself gives up
    (TEN - 1, 0.2, -1.0, -0.1, -0.1, 1),  # a risk has no such number
]


@pytest.mark.parametrize("lowest, alpha, floor, quantile, epsilon, missed", CHOICES)
def test_epsilon_is_the_kth_smallest_score(lowest, alpha, floor, quantile, epsilon, missed):
    found = calibrate(scored(np.random.default_rng(0).permutation(lowest)), alpha, 3, fps=20, floor=floor)
    everyone = found.groups[ALL]
    assert (found.epsilon, everyone.quantile) == (pytest.approx(epsilon), pytest.approx(quantile))
    assert (everyone.n, everyone.missed) == (10, missed)
    assert ("would have sufficed" in in_words(found)) == (epsilon > quantile)


@pytest.mark.parametrize(
    "alpha, n, takes", [(0.1, 8, 9), (0.05, 18, 19), (0.02, 48, 49), (0.01, 98, 99), (0.05, 1, 19)]
)
def test_too_few_episodes_are_refused_with_how_many_it_takes(alpha, n, takes):
    with pytest.raises(
        ValueError, match=f"--alpha={alpha:g} takes {takes} failing held-out episodes, and there are {n} "
    ):
        calibrate(scored(np.linspace(0, 1, n)), alpha, 3, fps=20)
    assert calibrate(scored(np.linspace(0, 1, takes)), alpha, 3, fps=20).groups[ALL].missed == 0


def test_what_holds_with_confidence_stands_beside_it():
    few, many = (calibrate(scored(np.linspace(0, 1, n)), 0.05, 3, fps=20) for n in (58, 93))
    assert few.groups[ALL].sure_epsilon is None and "takes 59 failing episodes or more" in in_words(few)
    assert many.groups[ALL].sure_epsilon == pytest.approx(91 / 92)  # one of 93 may be missed
    assert many.groups[ALL].k == 90 and many.groups[ALL].missed_at_most == pytest.approx(0.0815, abs=1e-3)
    assert "n = 93" in in_words(many) and "k = 90" in in_words(many) and "at most 8.1%" in in_words(many)


def test_false_alarms_are_counted_by_episode():
    rows = [
        *(failing([v, v, -1.0], 2, episode=i) for i, v in enumerate(TEN)),
        safe(0.9, 0.85, 0.95),
        safe(0.96, episode=7),
    ]
    found = calibrate(Scores.of(rows, 1), 0.2, 1, fps=20)
    assert (found.false_alarms, found.safe_episodes) == (1, 2)
    assert "overrides 1 of 2" in in_words(found)


def test_where_both_cannot_be_kept_it_says_so():
    scores = scored(TEN, quiet=np.linspace(0.4, 1.0, 60))
    found = calibrate(scores, 0.1, 3, fps=20)
    with pytest.raises(
        ValueError, match=r"cannot both be kept.*overrides 60 of 60.*epsilon = 0.4\d* keeps to that and"
    ):
        require_few_alarms(found, scores, 0.1)
    with pytest.raises(ValueError, match="takes 149 safe episodes without any override"):
        require_few_alarms(found, scores, 0.02)
    quiet = scored(TEN, quiet=np.full(60, 1.5))
    require_few_alarms(calibrate(quiet, 0.1, 3, fps=20), quiet, 0.06)
    rows = curve(scores)
    assert rows == sorted(rows, key=lambda row: row["epsilon"])
    assert all(a["missed"] >= b["missed"] and a["false_alarms"] <= b["false_alarms"] for a, b in pairwise(rows))


def test_every_group_is_kept_to_alpha():
    """The largest epsilon of the groups; a group that proves nothing is named."""
    scores = scored([*np.linspace(0.1, 0.5, 9), *np.linspace(0.5, 0.9, 9)])
    groups = {"weak": [*range(9), 100], "strong": [*range(9, 18)]}
    found = calibrate(scores, 0.1, 3, fps=20, groups=groups)
    assert found.epsilon == found.groups["strong"].quantile == pytest.approx(0.9)
    assert found.groups["weak"].quantile == pytest.approx(0.5) and found.groups["weak"].n == 9
    assert "Of weak: k = 9 of n = 9, 0 missed" in in_words(found)
    with pytest.raises(ValueError, match="takes 9 failing held-out episodes of the group 'strong', and there are 8"):
        calibrate(scores, 0.1, 3, fps=20, groups={"weak": [*range(10)], "strong": [*range(10, 18)]})


def test_weights_promise_on_average_alone():
    found = calibrate(scored(TEN), 0.3, 3, fps=20, weights={i: 1.0 + i for i in range(10)})
    everyone = found.groups[ALL]
    assert found.weighted and everyone.k is None and everyone.missed_at_most is None
    assert found.epsilon > calibrate(scored(TEN), 0.3, 3, fps=20).epsilon
    assert "weighted quantile" in in_words(found) and "confidence it misses" not in in_words(found)


NONSENSE = [
    *(({"alpha": value}, f"--alpha is {value}; expected a share") for value in (0, 1, 1.0, 1.5, -0.1, np.nan)),
    *(({"max_false_alarms": v}, f"--max_false_alarms is {v}; expected a share") for v in (0, 1.5, np.nan)),
    *(({"lead_steps": value}, f"--lead_steps is {value}; expected at least 1") for value in (0, -3)),
]
COMMANDS = [
    ({"by": "policy", "weights": "w.json"}, "a group has no weights; give one of them"),
    ({"closed_loop": True}, "where[?] Give --env.type"),
    ({"closed_loop": True, "env": LatentSafeDubinsEnv(), "epsilons": []}, "expected falling numbers"),
    ({"closed_loop": True, "env": LatentSafeDubinsEnv(), "epsilons": [0.1, 0.4]}, "expected falling numbers"),
    ({"closed_loop": True, "env": LatentSafeDubinsEnv(), "epsilons": [0.1, np.nan]}, "expected falling numbers"),
    ({"closed_loop": True, "env": LatentSafeDubinsEnv(), "n_runs": 58}, "takes 59 runs of which none fails"),
    ({"n_runs": 0}, "--n_runs is 0; expected at least 1"),
]


@pytest.mark.parametrize("options, message", NONSENSE)
@pytest.mark.fault("N05", "calibrate with nonsensical options", "Refused, with what was expected")
def test_options_that_mean_nothing_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        check_options(**{"alpha": 0.05, "lead_steps": 3, **options})
    with pytest.raises(ValueError, match=message):
        Calibrate(PolicySource("no/such"), "out", **options)


@pytest.mark.parametrize("options, message", COMMANDS)
def test_a_command_that_cannot_work_is_refused_before_any_work(options, message):
    with pytest.raises(ValueError, match=message):
        Calibrate(PolicySource("no/such"), "out", **options)


# -- groups and weights that people give ---


def test_groups_are_those_of_a_column_or_a_file(cache_meta, tmp_path):
    episodes, file = np.array([0, 3, 5]), tmp_path / "groups.json"
    assert groups_of(cache_meta, "tasks", episodes) == {"drive": [0, 3, 5]}
    assert groups_of(cache_meta, "task_index", episodes) == {"0": [0, 3, 5]}
    file.write_text(json.dumps({"weak": [0, 1, 2, 3], "strong": [4, 5]}))
    assert groups_of(cache_meta, str(file), episodes) == {"weak": [0, 3], "strong": [5]}


@pytest.mark.parametrize(
    "content, message",
    [
        ({"weak": [0, 3]}, "leaves out 1 held-out episodes, such as 5"),
        ({"weak": [0, 3, 5], "strong": [3]}, "names an episode twice"),
        ({"weak": "all"}, "maps no group to a list"),
        ([0, 3], "holds a list; expected"),
        ("{", "is not a readable JSON file"),
    ],
)
def test_a_file_that_is_no_map_of_groups_is_refused(content, message, cache_meta, tmp_path):
    file = tmp_path / "groups.json"
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(ValueError, match=message):
        groups_of(cache_meta, str(file), [0, 3, 5])


def test_a_column_that_nobody_wrote_is_refused_with_those_that_are_there(cache_meta):
    with pytest.raises(ValueError, match=r"--by=variant.*its columns are episode_index, tasks.*failure.*JSON file"):
        groups_of(cache_meta, "variant", [0])


def test_weights_are_read_from_either_file(tmp_path):
    np.save(tmp_path / "w.npy", np.arange(1.0, 6.0))
    (tmp_path / "w.json").write_text('{"3": 4, "0": 1.0}')
    for name in ("w.npy", "w.json"):
        assert weights_of(tmp_path / name, [0, 3]) == {0: 1.0, 3: 4.0}


@pytest.mark.parametrize("weight", [0, -1.0, None, "much", True, float("nan"), float("inf")])
def test_a_weight_that_is_none_is_refused(weight, tmp_path):
    file = tmp_path / "w.json"
    file.write_text(json.dumps({"0": 1.0, "3": weight}))
    with pytest.raises(ValueError, match=r"gives episode 3 the weight .*; expected a number above 0"):
        weights_of(file, [0, 3])


# -- episodes that were trained on ---


def test_every_stage_remembers_its_episodes_and_one_that_does_not_know_says_so(tiny_filter, cache_meta):
    policy = load_filter(tiny_filter)
    kept = policy.config.trained_on.episodes
    assert len(kept) == SHORT * cache_meta.total_episodes
    marks = episode_marks(np.zeros(5, int), np.ones((5, 2)), np.ones((5, 1)))
    more = with_episodes(policy.config.trained_on, marks)
    assert len(more.episodes) == len(kept) + SHORT and with_episodes(more, marks) == more
    old = TrainedOn(stage="critic")  # of an earlier version: what it saw is not known, and stays so
    assert with_episodes(old, marks).episodes is None
    assert with_episodes(TrainedOn(), {**marks, 1: "0" * SHORT}, [1]).episodes == "0" * SHORT


def test_episodes_that_were_trained_on_are_refused(tiny_filter, cache_root, tmp_path):
    """In whatever dataset they are now: it is their numbers that count."""
    with pytest.raises(
        TrainedOnError, match=r"2 of the 2 held-out episodes were trained on: 3, 5\. .*--dataset.episodes"
    ):
        command(tiny_filter, cache_root, tmp_path / "out", dataset=DatasetSource("me/x", str(cache_root), [3, 5])).run()
    assert not any(tmp_path.iterdir())


# -- the command ---


def test_command_writes_a_filter_with_epsilon_and_evidence(calibrated, judgements):
    config = LatentSafePolicy.from_pretrained(calibrated).config
    found = Calibration.read(config.calibration)
    assert found.epsilon == calibrate(Scores.of(judgements, 1), 0.3, 1, fps=20).epsilon
    assert found.epsilon == config.law.epsilon and config.trained_on.stage == "critic"
    assert found.lead_s == 1 / 20 and found.trained_on_known and found.alpha == 0.3
    assert config.frame_cache is None  # a folder of this machine has no business in a checkpoint
    assert "None of these was trained on." in in_words(found)


def test_the_scores_of_all_episodes_and_the_curve_are_written(calibrated):
    written = json.loads((calibrated.parent / "scores.json").read_text())
    lowest, found = np.array([*written["failing"].values()]), written["calibration"]
    assert (lowest > found["epsilon"]).sum() == found["groups"][ALL]["missed"] <= 0.3 * len(lowest)
    assert written["curve"] and (calibrated.parent / "curve.png").stat().st_size > 1000


def test_a_calibration_that_breaks_off_leaves_no_filter(tiny_filter, held_root, tmp_path, monkeypatch, judged_already):
    def killed(*given):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(train, "save_policy", killed)
        command(tiny_filter, held_root, tmp_path / "out").run()
    assert not any(tmp_path.iterdir())


def test_the_curve_is_written_before_anything_is_refused(tiny_filter, held_root, tmp_path, judged_already):
    file = tmp_path / "curve.json"
    with pytest.raises(ValueError, match=r"--alpha=0\.01 takes 99 failing"):
        command(tiny_filter, held_root, tmp_path / "out", alpha=0.01, json=file).run()
    written = json.loads(file.read_text())
    assert written["curve"] and written["calibration"] is None and not (tmp_path / "out").exists()


def test_the_option_of_earlier_versions_is_understood(tmp_path):
    with pytest.raises(SystemExit, match=r"--alpha is 3\.0; expected a share"):
        main(["calibrate", "--policy.path=no/such", f"--output_dir={tmp_path / 'out'}", "--max_missed=3"])


def test_in_closed_loop_epsilon_is_the_least_cautious_that_is_proven(
    tiny_filter, tiny_diffusion, held_root, tmp_path, judged_already
):
    options = dict(
        closed_loop=True, env=LatentSafeDubinsEnv(episode_length=4), base_policy_path=str(tiny_diffusion), alpha=0.45,
        epsilons=[0.9, 0.2, 0.1], n_runs=6,
    )  # fmt: skip
    command(tiny_filter, held_root, tmp_path / "out", **options).run()
    policy = load_filter(tmp_path / "out", base_policy=tiny_diffusion)
    found = Calibration.read(policy.config.calibration)
    tested = found.closed_loop["tests"]
    assert policy.config.law.epsilon == found.closed_loop["epsilon"] == tested[-1]["epsilon"] == 0.1
    assert [test["n"] for test in tested] == [6, 6, 6] and not policy.outdated()
    assert "In closed loop" in in_words(found) and f"epsilon = {found.epsilon:.4g} was chosen" in in_words(found)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"by": "variant"}, "--by=variant"),
        ({"max_false_alarms": 0.001}, "cannot both be kept"),
    ],
)
def test_what_cannot_be_calibrated_is_refused(options, message, tiny_filter, held_root, tmp_path, judged_already):
    with pytest.raises(ValueError, match=message):
        replace(command(tiny_filter, held_root, tmp_path / "out"), **options).run()
    assert not (tmp_path / "out").exists()


def test_dataset_of_another_rate_is_refused(tiny_filter, cache_root, tmp_path):
    other = tiny.altered_dataset(cache_root, tmp_path / "other", fps=30)
    with pytest.raises(ValueError, match="fps = 30, this filter was trained with 20"):
        Calibrate(PolicySource(str(tiny_filter)), tmp_path / "out", DatasetSource("me/other", str(other.root))).run()


def test_dataset_without_a_cache_is_refused(tiny_filter, dataset_root, tmp_path):
    with pytest.raises(ValueError, match="run latentsafe cache"):
        Calibrate(PolicySource(str(tiny_filter)), tmp_path / "o", DatasetSource(tiny.REPO_ID, str(dataset_root))).run()


def test_untrained_critic_cannot_be_calibrated(tiny_world_model, held_root, tmp_path):
    with pytest.raises(UntrainedFilterError):
        command(tiny_world_model, held_root, tmp_path / "out").run()


# -- what a calibration belongs to ---


CHANGED = {
    "guard steps": ({"proposal_steps": 6}, "another law: proposal_steps is 6, was 1"),
    "epsilon": ({"epsilon": 0.77}, "another law: epsilon is 0.77, was"),
    "lookahead": ({"lookahead": 0}, "another law: lookahead is 0, was 15"),
    "memory": ({"history_frames": 4}, "another law: history_frames is 4, was 0"),
    "law": ({"name": "margin"}, "another law: name is 'margin', was 'reachability'"),
    "in time": ({"slack_ms": 3.0}, None),  # says nothing of V
    "monitor": ({"mode": "monitor"}, None),
}


@pytest.mark.parametrize("changes, why", CHANGED.values(), ids=CHANGED)
def test_a_calibration_of_another_law_is_said_to_be(calibrated, tiny_diffusion, changes, why, caplog):
    with caplog.at_level(logging.WARNING):
        policy = load_filter(calibrated, law=LawOptions(**changes), base_policy=tiny_diffusion)
        policy.reset()
        policy.reset()
    said = [record.message for record in caplog.records if "is not calibrated for this filter" in record.message]
    card = policy.generate_model_card("me/car", "latentsafe", None, None).text
    if why is None:
        assert not said and "How often it misses" in card
    else:
        assert len(said) == 1 and why in said[0]
        assert "How often it misses" not in card and "nothing is promised of this filter: calibrated for" in card


def test_a_calibration_of_another_policy_is_said_to_be(calibrated):
    policy = load_filter(calibrated)  # with the policy that it was calibrated for, in its folder
    assert policy.outdated() == []
    next(policy.base.policy.parameters()).data.add_(0.01)
    (why,) = policy.outdated()
    assert why.startswith("calibrated for another base policy: this is ")
    policy._base = []
    (why,) = policy.outdated()
    assert why.startswith("calibrated for another base policy: this is no named policy, that was ")


def test_a_calibration_of_other_weights_is_said_to_be(calibrated, tiny_diffusion):
    policy = load_filter(calibrated, base_policy=tiny_diffusion)
    assert policy.outdated() == []
    policy.model.margin.net[-1].bias.data.add_(0.01)
    assert policy.outdated() == ["calibrated for other weights of world model, margin or critic"]


def test_wrapping_keeps_what_holds_and_says_what_does_not(calibrated, tiny_diffusion, tmp_path, caplog):
    for half in (False, True):
        folder = tmp_path / f"half_{half}"
        Wrap(PolicySource(str(calibrated)), folder, str(tiny_diffusion), half=half).run()
        assert load_filter(folder).outdated() == [] and not caplog.records
    Wrap(PolicySource(str(calibrated)), tmp_path / "other", str(tiny_diffusion), LawOptions(proposal_steps=6)).run()
    assert "another law: proposal_steps is 6, was 1" in caplog.text


OLD = {"epsilon": 0.1, "missed": 0.05, "false_alarms": 0.1, "lead_steps": 3.0, "failing_episodes": 40.0,
       "safe_frames": 900.0}  # fmt: skip
EDITS = [
    OLD,
    {"missed": float("nan")},
    *({name: value} for name in ("alpha", "false_alarms_at_most") for value in (float("nan"), -1, 1.5, "x", None)),
    {"false_alarms": 10**6},
    {"groups": {}},
    {"groups": {ALL: {}}},
    {"closed_loop": {"tests": []}},
    {"extra": 1},
]


@pytest.mark.parametrize("edit", EDITS, ids=str)
def test_evidence_that_is_old_or_edited_promises_nothing(calibrated, tiny_diffusion, edit):
    policy = load_filter(calibrated, base_policy=tiny_diffusion)
    policy.config.calibration = edit if edit is OLD else {**policy.config.calibration, **edit}
    assert policy.outdated() == ["its evidence is not whole, or of an earlier version, which promised nothing"]
    card = policy.generate_model_card("me/car", "latentsafe", None, None).text
    assert "evidence is not whole" in card and "How often it misses" not in card


def test_the_card_says_how_often_it_misses_and_on_what_evidence(calibrated, tiny_diffusion):
    policy = load_filter(calibrated, base_policy=tiny_diffusion)
    text = policy.generate_model_card("me/car", "latentsafe", None, None).text
    found = Calibration.read(policy.config.calibration)
    one = found.groups[ALL]
    assert f"| that fail, 1 frames ahead | {one.n - one.missed} of {one.n} | {one.missed} of {one.n} |" in text
    assert f"n = {one.n}" in text and f"k = {one.k}" in text and "With 95% confidence" in text


def test_the_report_says_it_too_and_draws_where_misses_come_from(calibrated, tmp_path):
    policy, page = load_filter(calibrated), tmp_path / "report.html"
    bars = {"held out": dict.fromkeys(CAUSES, 1)}
    write_filter_report(page, policy, None, 1, 0, misses=bars)
    text = page.read_text()
    assert "How often it misses" in text and "held-out episodes that never fail" in text
    assert "Where misses come from" in text and "imagined otherwise than it came" in text
    policy.config.change(law=policy.config.law.changed(LawOptions(proposal_steps=6)))
    write_filter_report(page, policy, None, 1, 0)
    text = page.read_text()
    assert "How often it misses" not in text and "Where misses come from" not in text
    assert "nothing is promised of this filter: calibrated for another law: proposal_steps is 6, was 1" in text
