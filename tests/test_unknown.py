"""The monitor of the unknown: scores, threshold, alarms, what the law does about them, files, the verb."""

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import tiny
import torch
from safetensors.torch import load_file, save_file

from lerobot_latentsafe.cli import main
from lerobot_latentsafe.collection.dubins import random_episodes
from lerobot_latentsafe.conformal import needed
from lerobot_latentsafe.decision import ANSWERS, LawConfig, Reason
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.experiments.assurance.unknown_car import HEALTHY, KINDS, seen
from lerobot_latentsafe.experiments.assurance.unknown_car import driven as driven_car
from lerobot_latentsafe.experiments.assurance.unknown_study import first_alarms, watched
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.modeling_latentsafe import STATISTICS, load_filter
from lerobot_latentsafe.monitoring import parts_of
from lerobot_latentsafe.pictures import averaged
from lerobot_latentsafe.runtime.checkpoint import seal_again
from lerobot_latentsafe.runtime.locations import CheckpointError
from lerobot_latentsafe.shield import Shield
from lerobot_latentsafe.unknown import appearance, dynamics, placement
from lerobot_latentsafe.unknown.dynamics import Foretold, ages
from lerobot_latentsafe.unknown.placement import Placement
from lerobot_latentsafe.unknown.threshold import Drift, TooFewEpisodesError, e_value, profile, rank_of

CAMERA = "observation.image"
ALPHA = 0.4
"""Of tests, whose recording has 14 episodes."""


def monitor(policy, dataset, folder, *options):
    main(["monitor", f"--policy.path={policy}", f"--dataset.root={dataset}", f"--output_dir={folder}", *options])
    return folder


@pytest.fixture(scope="module")
def recording(dataset_root, tmp_path_factory):
    """The episodes of the car, as if none of them failed."""
    root = tmp_path_factory.mktemp("healthy") / "car"
    shutil.copytree(dataset_root, root)
    for file in root.glob("data/*/*.parquet"):
        table = pq.read_table(file)
        place, column = table.column_names.index("failure"), table["failure"]
        pq.write_table(table.set_column(place, table.schema.field("failure"), pc.multiply(column, 0)), file)
    return root


@pytest.fixture(scope="module")
def monitored_folder(recording, tiny_filter, tmp_path_factory):
    return monitor(tiny_filter, recording, tmp_path_factory.mktemp("monitored") / "filter", f"--alpha={ALPHA}")


@pytest.fixture
def monitored(monitored_folder):
    return load_filter(monitored_folder)


# -- the threshold ---


@pytest.mark.parametrize("alpha, n", [(0.1, 9), (0.05, 19), (0.02, 49), (0.01, 99)])
def test_as_many_episodes_are_needed_as_the_rank_asks_for(alpha, n):
    assert needed(alpha) == n and rank_of(n, alpha) == n
    with pytest.raises(TooFewEpisodesError, match=rf"{n - 1} healthy episodes .* needs {n}"):
        rank_of(n - 1, alpha)


@pytest.mark.parametrize("n, alpha", [(19, 0.05), (40, 0.1), (25, 0.3)])
def test_a_healthy_episode_alarms_with_the_stated_chance(n, alpha):
    rng, k = np.random.default_rng(0), rank_of(n, alpha)
    draws = rng.gumbel(size=(4000, n + 1))
    share = (draws[:, -1] > np.sort(draws[:, :-1], 1)[:, k - 1]).mean()
    assert share <= alpha + 3 * math.sqrt(alpha / 4000)


def test_a_profile_follows_time_and_holds_its_last():
    rng = np.random.default_rng(0)
    episodes = [np.arange(60)[:, None] * 0.1 + rng.normal(size=(60, 2)) for _ in range(30)]
    found = profile(episodes, 3.0)
    assert abs(found.mean[30, 0] - 3) < 0.4
    late = found.standardised(np.full((2, 2), 5.9), np.array([59, 1000]))
    assert np.allclose(late[0], late[1])


def test_evidence_grows_where_the_world_has_drifted_and_not_elsewhere():
    rng = np.random.default_rng(0)
    grew = 0
    for _ in range(200):
        drift = Drift(rng.normal(size=30))
        most = 0.0
        for strangest in rng.normal(size=20):
            drift.add(strangest)
            most = max(most, drift.evidence)
        grew += most >= 20
    assert grew <= 0.05 * 200 + 3 * math.sqrt(0.05 * 200)
    drifted = Drift(rng.normal(size=30))
    for strangest in rng.normal(4, 1, size=20):
        drifted.add(strangest)
    assert drifted.evidence > 20


def test_e_values_have_a_mean_of_one():
    """Their integral up to p is (p - 1) / log p, which goes from 0 to 1."""
    p = np.linspace(0.01, 1, 20_000)
    integral = np.mean([e_value(x) for x in p]) * 0.99
    assert abs(integral - (1 - 0.99 / -math.log(0.01))) < 1e-3 and e_value(1.0) == 0.5


# -- the scores ---


def pictures(n, seed=0):
    """Of a scene in which a square moves."""
    rng = np.random.default_rng(seed)
    shown = np.full((n, 3, 48, 48), 0.3, np.float32)
    shown[:, 0, :24] = 0.7
    for t, place in enumerate(rng.integers(0, 36, n)):
        shown[t, :, 30:38, place : place + 8] = np.array([0.1, 0.2, 0.9])[:, None, None]
    return torch.from_numpy((shown + rng.normal(0, 0.005, shown.shape)).clip(0, 1).astype(np.float32))


ALTERED = {
    "upside down": lambda x: x.flip(-1, -2),
    "blue for red": lambda x: x.flip(-3),
    "darker": lambda x: 0.6 * x,
    "noise": lambda x: torch.rand_like(x),
    "a thing in the picture": lambda x: torch.cat([x[..., :20], 0 * x[..., :12] + 0.95, x[..., 32:]], -1),
    "moved": lambda x: x.roll(4, -2),
    "green for blue": lambda x: torch.where(x[:, 2:] > 0.6, x[:, [0, 2, 1]], x),
    "an empty scene": lambda x: torch.where(x[:, 2:] > 0.6, 0.3, x),
}


@pytest.mark.parametrize("name", ALTERED)
def test_a_picture_unlike_the_data_is_strange(name):
    library = appearance.learn(appearance.views({"c": pictures(400)}, ["c"]))
    usual, strange = (
        appearance.strangeness(appearance.views({"c": x}, ["c"]), library)[:, 0]
        for x in (pictures(50, seed=1), ALTERED[name](pictures(50, seed=1)))
    )
    assert (strange.max(1) > usual.max()).all()


def room(n: int, size: int = 96, seed: int = 0) -> np.ndarray:
    """Grey pictures uint8 (n, 1, size, size): a table and a window that stand still, something that does not, noise."""
    rng = np.random.default_rng(seed)
    pictures = np.full((n, size, size), 0.4, np.float32)
    pictures[:, size // 2 :, size // 8 :] = 0.6
    pictures[:, size // 8 : size // 3, size // 2 : -size // 6] = 0.8
    for picture, (row, column) in zip(pictures, rng.integers(0, size - size // 8, (n, 2))):
        picture[row : row + size // 8, column : column + size // 8] = rng.uniform(0, 1)
    return ((pictures + rng.normal(0, 0.01, pictures.shape)).clip(0, 1) * 255).astype(np.uint8)[:, None]


def seen_by(matrix: list[list[float]]) -> Callable[[np.ndarray], np.ndarray]:
    def change(picture: np.ndarray) -> np.ndarray:
        return cv2.warpAffine(picture, np.float32(matrix), picture.shape[::-1], borderMode=cv2.BORDER_REPLICATE)

    return change


DISPLACED = {
    "to the side": seen_by([[1, 0, 2.2], [0, 1, 0]]),
    "up": seen_by([[1, 0, 0], [0, 1, -3]]),
    "far away": seen_by([[1, 0, 9], [0, 1, 7]]),
    "turned": seen_by(cv2.getRotationMatrix2D((48, 48), 5, 1)),
    "nearer": seen_by(cv2.getRotationMatrix2D((48, 48), 0, 1.08)),
    "mirrored": lambda x: x[:, ::-1],
    "upside down": lambda x: x[::-1, ::-1],
    "out of focus": lambda x: cv2.GaussianBlur(x, (0, 0), 2),
}


@pytest.mark.parametrize("name", DISPLACED)
def test_a_camera_that_stands_elsewhere_is_told_by_what_stands_still(name):
    stands = Placement(placement.learn(room(200)))
    usual, shown = stands.scores(room(50, seed=1)), room(50, seed=2)
    elsewhere = stands.scores(np.stack([DISPLACED[name](picture)[None] for picture in shown[:, 0]]))
    assert elsewhere.min() > usual.max() + 0.2


NO_MOVE = {
    "darker": lambda x: (0.8 * x).astype(np.uint8),
    "half covered": lambda x: np.concatenate([x[..., :48, :], np.full_like(x[..., 48:, :], 90)], -2),
}


@pytest.mark.parametrize("name", NO_MOVE)
def test_what_covers_the_background_or_dims_it_moves_no_camera(name):
    stands = Placement(placement.learn(room(200)))
    assert stands.scores(NO_MOVE[name](room(50, seed=1))).max() < 0.2


def test_a_mirrored_picture_of_a_symmetric_scene_says_nothing():
    """Else the noise of nearly equal pictures would be the score of all."""
    symmetric = np.maximum(room(200), room(200)[..., ::-1])
    stands = Placement(placement.learn(symmetric))
    assert np.median(stands.scores(symmetric)) < -0.5


@pytest.mark.parametrize("size", [20, 64, 96])
def test_a_camera_before_which_nothing_stands_still_is_never_told(size):
    noise = np.random.default_rng(0).integers(0, 255, (60, 1, size, size), np.uint8)
    assert np.abs(Placement(placement.learn(noise)).scores(noise)).max() < 0.9


@pytest.mark.parametrize("size", [20, 32, 64, 96, 224])
def test_pictures_of_any_size_are_patches_of_one_size(size):
    seen = appearance.views({"a": torch.rand(2, 3, size, size), "b": torch.rand(2, 3, size, size)}, ["a", "b"])
    assert seen.patches.shape == (2, 2, appearance.GRID**2, appearance.NUMBERS) and np.isfinite(seen.patches).all()
    assert np.allclose(np.square(seen.colours).sum(-1), min(size, appearance.POINTS) ** 2)


@pytest.mark.parametrize("skip, expected", [(1, [1, 3, 6]), (2, [1, 2, 3]), (3, [1, 2]), (10, [1])])
def test_ages_are_in_steps(skip, expected):
    assert ages(skip) == expected


def test_what_was_foretold_is_compared_at_its_age():
    """A latent that counts: foretold of h steps ago by actions that were executed, not by what was believed since."""
    step = lambda z, a: {"n": z["n"] + a, "action": a}  # noqa: E731
    features = lambda z: z["n"]  # noqa: E731
    foretold, seen = Foretold(), [torch.tensor([[0.0], [0.0]])]
    for t in range(8):
        led = torch.tensor([[1.0], [2.0]])
        foretold = foretold.after({"n": seen[-1], "action": led}, step, led, 6)
        now = {"n": seen[-1] + led + torch.tensor([[0.0], [0.5]]), "action": led}  # the second drifts
        apart = foretold.differences(features, now, [1, 3, 6])
        seen.append(now["n"])
        known = [age for age in (1, 3, 6) if age <= t + 1]
        assert np.allclose(apart[0, : len(known), 0], 0)
        assert np.allclose(apart[1, : len(known), 0], [-0.5 * age for age in known])
        assert np.isnan(apart[:, len(known) :]).all()


def test_other_differences_than_usual_surprise():
    rng = np.random.default_rng(0)
    mixed = rng.normal(size=(60, 60)) / 8
    usual = dynamics.learn(rng.normal(size=(900, 2, 60)) @ mixed)
    healthy, other = (
        dynamics.surprise(x, usual) for x in (rng.normal(size=(50, 2, 60)) @ mixed, rng.normal(size=(50, 2, 60)))
    )
    assert other.max(-1).min() > healthy.max(-1).max()


# -- in the shield ---


def driven(policy, change=lambda seen, t: seen, n=12, **law):
    """Decisions along an episode whose observations are changed; its actions are small and steady."""
    policy.config.change(law=replace(policy.config.law, epsilon=-1.0, **law))
    shield = Shield(policy.model, clock=standing_still)
    state, decisions = np.array([[-0.9, 0.1, 0.0]]), []
    for t in range(n):
        decisions.append(shield(change(tiny.observation(state), t), torch.tensor([[0.2, 1.0]])))
        state = car.step(state, 0.2)
    return shield, decisions


def unlike(seen, t):
    """From the sixth tick on a camera that shows another scene."""
    picture = seen[CAMERA].clone()
    picture[..., 10:60, 10:120] = torch.tensor([0.1, 0.5, 0.2])[:, None, None]
    return {**seen, CAMERA: picture} if t >= 5 else seen


def no_looks(policy):
    """A filter that knows nothing of its camera but by its monitor."""
    policy.config.change(trained_on=replace(policy.config.trained_on, looks=None))
    return policy


def test_the_card_says_whether_anything_tells_that_the_scene_is_new(monitored, tiny_filter):
    without = load_filter(tiny_filter).generate_model_card("me/car", "latentsafe", None, None).text
    text = monitored.generate_model_card("me/car", "latentsafe", None, None).text
    assert "Nothing detects that: `latentsafe monitor` adds" in without and "Nothing detects" not in text
    record = monitored.config.trained_on.monitor
    assert f"alarms in at most {record.alpha:.1%} of healthy episodes (number {record.rank} of" in text
    assert "the law says `hold`" in text


def test_a_healthy_episode_passes_with_its_share_of_the_threshold(monitored):
    _, decisions = driven(monitored, n=8)  # with an alpha of .4 two healthy episodes in five alarm at some time
    assert all(d.reason == Reason.PASSED and not d.hand_over and d.unknown <= 1 for d in decisions)


@pytest.mark.parametrize("answer", ANSWERS)
def test_the_law_says_what_is_done_about_the_unknown(monitored, caplog, answer):
    _, decisions = driven(no_looks(monitored), unlike, unknown=answer)
    reasons = [Reason(int(d.reason)) for d in decisions]
    assert reasons[:5] == [Reason.PASSED] * 5 and set(reasons[5:]) == {Reason.UNKNOWN_APPEARANCE}
    last = decisions[-1]
    assert last.unsafe and last.unknown > 1
    assert bool(last.intervened) == (answer in ("hold", "hand_over"))
    assert bool(last.hand_over) == (answer == "hand_over")
    turn = {"warn": 0.2, "slow": 0.1, "hold": 0.0, "hand_over": 0.0}[answer]
    assert math.isclose(last.action[0, 0], turn, abs_tol=1e-6)
    warned = [r.message for r in caplog.records if r.message.startswith("UNKNOWN APPEARANCE")]
    assert len(warned) == 1 and CAMERA in warned[0]


def test_what_is_familiar_again_passes_after_a_second_without_an_alarm(monitored):
    fps = monitored.config.trained_on.fps
    _, decisions = driven(no_looks(monitored), lambda seen, t: unlike(seen, t) if t < 8 else seen, n=10 + fps)
    assert decisions[7 + fps - 1].reason == Reason.UNKNOWN_APPEARANCE and decisions[-1].reason == Reason.PASSED


def test_what_the_world_does_stays_strange_until_the_episode_ends(monitored):
    monitor = Shield(monitored.model, clock=standing_still).monitor
    usual = monitor.familiar.usual
    seen = tiny.observation([[-0.9, 0.1, 0.0]])[CAMERA]
    images = {CAMERA: averaged(seen, monitored.config.world_model.image_size)}  # as a shield shows it
    monitor.look(images, np.ones(1, bool))
    assert monitor.foresee(usual.mean[None] + 100 * usual.deviation) == Reason.UNKNOWN_DYNAMICS
    monitor.end_tick()
    monitor.look(images, np.ones(1, bool))
    assert monitor.foresee(usual.mean[None]) == Reason.UNKNOWN_DYNAMICS
    monitor.reset()
    monitor.look(images, np.ones(1, bool))
    assert monitor.foresee(np.full_like(usual.mean[None], np.nan)) == Reason.PASSED


def test_what_cannot_be_seen_is_a_fault_and_neither_strange_nor_familiar(monitored):
    _, decisions = driven(monitored, lambda seen, t: {**seen, CAMERA: 0 * seen[CAMERA]} if t == 6 else seen)
    assert decisions[6].reason == Reason.OBSERVATION_MISSING and decisions[6].unknown == -math.inf
    assert not any(d.reason == Reason.UNKNOWN_DYNAMICS for d in decisions)


def test_an_episode_counts_once_and_a_warm_up_never(monitored):
    shield = monitored.shield
    known = len(shield.monitor.familiar.strangest)
    shield.warm_up()
    shield.reset()
    assert len(shield.monitor.drift._known) == known
    shield(tiny.observation([[-0.9, 0.1, 0.0]]), torch.tensor([[0.2, 1.0]]))
    shield.reset()
    shield.reset()
    assert len(shield.monitor.drift._known) == known + 1


def test_a_filter_without_a_monitor_decides_as_before(tiny_filter, monitored):
    _, plain = driven(load_filter(tiny_filter), n=8)
    _, watched = driven(monitored, n=8)
    assert torch.equal(tiny.executed(plain), tiny.executed(watched)) and plain[0].unknown is None
    assert all(torch.equal(a.value, b.value) for a, b in zip(plain, watched))


def test_a_law_knows_what_can_be_done_about_the_unknown():
    with pytest.raises(ValueError, match=r"law.unknown is 'run'; expected one of warn, slow, hold, hand_over"):
        LawConfig(unknown="run")


# -- the verb, and files ---


def test_a_filter_may_watch_its_cameras_alone(recording, tiny_filter, tmp_path):
    folder = monitor(tiny_filter, recording, tmp_path / "monitored", f"--alpha={ALPHA}", "--dynamics=false")
    shield, decisions = driven(no_looks(load_filter(folder)), unlike)
    assert not shield.monitor.foretells and decisions[-1].reason == Reason.UNKNOWN_APPEARANCE


def test_a_guard_has_the_appearance_alone(recording, tmp_path):
    main(["guard", f"--dataset.root={recording}", f"--output_dir={tmp_path / 'guard'}"])
    folder = monitor(tmp_path / "guard", recording, tmp_path / "monitored", f"--alpha={ALPHA}")
    guarded = load_filter(folder)
    assert not guarded.config.trained_on.monitor.dynamics
    _, decisions = driven(no_looks(guarded), unlike)
    assert decisions[-1].reason == Reason.UNKNOWN_APPEARANCE and decisions[4].reason == Reason.PASSED


def test_the_statistics_are_small_and_sealed(monitored_folder):
    file = monitored_folder / STATISTICS
    assert file.stat().st_size < 300_000
    assert STATISTICS in (monitored_folder / "integrity.json").read_text()


def gone(folder):
    (folder / STATISTICS).unlink()


def torn(folder):
    (folder / STATISTICS).write_bytes((folder / STATISTICS).read_bytes()[:1000])


def without(entry):
    def change(folder):
        numbers = load_file(folder / STATISTICS)
        save_file({name: tensor for name, tensor in numbers.items() if name != entry}, folder / STATISTICS)

    return change


def recorded_as(**changes):
    def change(folder):
        trained_on = json.loads((folder / "config.json").read_text())["trained_on"]
        tiny.rewrite_group(folder, "trained_on", monitor={**trained_on["monitor"], **changes})

    return change


SPOILED = {
    "its statistics are gone": (gone, "is missing"),
    "its statistics are torn": (torn, "is not readable"),
    "it is of a version before": (without("background.0"), "lack 'background.0'; fit them again"),
    "it is of another camera": (recorded_as(cameras=["observation.images.wrist"]), "cameras"),
    "it is of another world model": (recorded_as(world_model="0" * 16), "world model"),
    "it is of other pictures": (recorded_as(image_size=96), "image_size"),
    "its statistics are another's": (recorded_as(statistics="0" * 16), "numbers"),
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_monitor_that_is_not_the_filters_own_is_refused(monitored_folder, tmp_path, name):
    folder, (spoil, said) = tmp_path / "filter", SPOILED[name]
    shutil.copytree(monitored_folder, folder)
    spoil(folder)
    with pytest.raises(CheckpointError):  # by its seal
        load_filter(folder)
    seal_again(folder)
    with pytest.raises(CheckpointError, match=rf"{said}.*latentsafe monitor|{said}"):
        load_filter(folder)


def test_too_few_episodes_are_refused_with_their_number(recording, tiny_filter, tmp_path):
    with pytest.raises(SystemExit, match=r"14 healthy episodes, and a false alarm in 0.05 .* needs 25: 19 that set"):
        monitor(tiny_filter, recording, tmp_path / "filter")
    with pytest.raises(SystemExit, match="expected a share of healthy episodes"):
        monitor(tiny_filter, recording, tmp_path / "filter", "--alpha=1.5")


def test_failing_episodes_are_left_out(dataset_root, tiny_filter, tmp_path):
    with pytest.raises(SystemExit, match=r"there are \d healthy episodes"):
        monitor(tiny_filter, dataset_root, tmp_path / "filter")


@pytest.mark.parametrize(
    "n, alpha, reference", [(25, 0.05, False), (60, 0.05, False), (22, 0.05, True), (80, 0.1, True)]
)
def test_the_parts_share_no_episode(n, alpha, reference):
    parts = parts_of(list(range(n)), alpha, reference)
    assert sorted(e for part in parts for e in part) == list(range(n))
    assert len(parts[2]) >= needed(alpha) and len(parts[1]) >= 3 and bool(parts[0]) != reference


# -- the study of the car ---


def test_the_car_of_the_study_drives_as_the_data_do_unless_its_kind_says_otherwise(monitored):
    episode = next(random_episodes(1, np.random.default_rng(3)))
    usual = driven_car(KINDS[HEALTHY], episode)
    assert np.allclose(usual, episode.states, atol=1e-9)
    moves = [name for name, kind in KINDS.items() if not np.allclose(driven_car(kind, episode), usual)]
    assert moves == [name for name, kind in KINDS.items() if (kind.speed, kind.turns) != (car.SPEED, 1.0)]
    cut = replace(episode, states=episode.states[:8], turn_rates=episode.turn_rates[:8])
    first, *_ = seen(KINDS[HEALTHY], cut)
    for name in set(KINDS) - {HEALTHY}:
        pictures, state, action, in_disc = seen(KINDS[name], cut)
        assert not torch.equal(pictures, first), name
        row = first_alarms(watched(monitored, {CAMERA: pictures}, state, action), in_disc)
        assert set(row) == {"appearance", "dynamics", "stopped", "harm", "most"}
