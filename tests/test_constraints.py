"""Constraints of a few frames: their margin, what the critic reads of them, and what is no constraint."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe.constraint_training import fit_likeness, numbers_named, with_random_sets
from lerobot_latentsafe.constraints import (
    KEY,
    MOST,
    REACH,
    SLOTS,
    Constrained,
    ConstraintError,
    Likeness,
    LikenessConfig,
    SetNetwork,
    cover,
    margin_of,
    random_sets,
)
from lerobot_latentsafe.critic import SafetyCritic
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.labels import UnlabelledDatasetError
from lerobot_latentsafe.experiments.dubins.privileged import DubinsImagination
from lerobot_latentsafe.labeling.constraints import add_constraint
from lerobot_latentsafe.labeling.store import LabelStore
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.reachability import LatentReachability
from lerobot_latentsafe.runtime.hub import save_policy
from lerobot_latentsafe.training import train_reachability

ALIKE = {"x.pos": 0.25, "y.pos": 0.5}
KNOWN = {
    "zone": [{"x.pos": [0.5, 0.25], "y.pos": [0.0, 0.5]}],
    "line": [{"x.pos": [-1.0, 0.5]}],
    "many": [{"x.pos": [0.1 * i, 0.25], "y.pos": [0.0, 0.5]} for i in range(SLOTS)],
}
KNOWN |= LikenessConfig().own_failure
CONFIG = LikenessConfig(ALIKE, [-1.0, -1.0], [1.0, 1.0], KNOWN)


def margins(names, places, own=0.9):
    """Margins of places in robot units, where the filter's own margin is so much."""
    where = torch.tensor(places) / torch.tensor([*ALIKE.values()])
    return margin_of(torch.cat([where, torch.full((len(where), 1), own)], 1), CONFIG.tensor(names))


# -- the margin ---


@pytest.mark.parametrize(
    ("names", "place", "beyond"),
    [
        (["zone"], (0.5, 0.0), -1.0),
        (["zone"], (0.75, 0.0), 0.0),
        (["zone"], (1.0, 0.0), 1.0),
        (["zone"], (0.5, 1.0), 1.0),
        (["line"], (-1.0, 7.0), -1.0),
        (["line"], (-0.5, 0.0), 0.0),
        (["zone", "line"], (-1.0, 0.0), -1.0),
        (["line", "zone"], (0.5, 0.0), -1.0),
        ([], (0.5, 0.0), np.inf),
    ],
)
def test_margin_is_the_distance_beyond_the_nearest_reach(names, place, beyond):
    assert margins(names, [place]).item() == pytest.approx(np.tanh(beyond), abs=1e-6)


@pytest.mark.parametrize("own", [-0.9, -0.1, 0.0, 0.6])
def test_the_failure_of_the_filter_itself_is_a_constraint(own):
    assert margins(["failure"], [(0.5, 0.0)], own).item() == pytest.approx(np.tanh(own), abs=1e-6)
    assert margins(["failure", "zone"], [(0.5, 0.0)], own).item() == pytest.approx(np.tanh(-1), abs=1e-6)


def test_margin_of_a_set_is_the_least_of_its_members():
    places = torch.rand(50, 2).tolist()
    each = torch.stack([margins([name], places) for name in ("zone", "line")])
    torch.testing.assert_close(margins(["zone", "line"], places), each.amin(0))


@pytest.mark.parametrize("names", [["zone"], ["line"], []])
def test_a_place_that_is_not_known_is_never_safe(names):
    assert margins(names, [(np.nan, 0.0)]).isnan().all()


def test_an_absurd_place_is_not_known():
    likeness = Likeness(3, LikenessConfig({"x": 1.0}))
    likeness.net[-1].bias.data.fill_(1e9)
    assert likeness(torch.zeros(2, 3)).isnan().all()


# -- which constraints count ---


@pytest.mark.parametrize(
    ("config", "names", "message"),
    [
        (LikenessConfig(), ["zone"], "takes none.*--alike"),
        (CONFIG, ["spilled"], "knows zone, line, many, failure. Add spilled.*add-constraint"),
        (CONFIG, [], "nothing would count as a failure; this filter knows zone"),
        (CONFIG, ["zone", "many"], f"have {SLOTS + 1} prototypes together.*{SLOTS} at most"),
    ],
)
def test_constraints_that_cannot_count_are_refused(config, names, message):
    with pytest.raises(ConstraintError, match=message):
        config.require_known(names, trained=True)


@pytest.mark.parametrize("names", [["zone"], ["line", "zone"], ["many"], ["zone", "zone"]])
def test_constraints_that_are_known_count(names):
    CONFIG.require_known(names, trained=True)
    assert (CONFIG.tensor(names)[:, 3:] > 0).any(1).sum() == sum(len(KNOWN[name]) for name in {*names})


@pytest.mark.parametrize("apart", [0.0, -1.0, float("nan"), float("inf")])
def test_a_distance_that_is_none_is_refused(apart):
    with pytest.raises(ConstraintError, match=r"x\.pos; expected a distance"):
        LikenessConfig({"x.pos": apart})


# -- what is made of marked frames ---


def ball(centre, radius, n=200, seed=0):
    """Places within and around a ball: those that fail, and those that do not."""
    places = np.random.default_rng(seed).uniform(-4, 4, (20 * n, 2))
    inside = np.linalg.norm(places - centre, axis=1) < radius
    return places[inside], places[~inside]


def test_marked_frames_alone_are_prototypes():
    failing = np.array([[0.0, 0.0], [1.0, 1.0]])
    found = CONFIG.prototypes(failing, failing[:0])
    assert found == [{"x.pos": [0.0, 0.25], "y.pos": [0.0, 0.5]}, {"x.pos": [0.25, 0.25], "y.pos": [0.5, 0.5]}]


def test_labelled_frames_tell_how_far_a_failure_reaches():
    (where, reach), *more = cover(*ball(np.array([1.0, -1.0]), 1.6))
    assert np.linalg.norm(where - [1.0, -1.0]) < 0.4 and abs(reach - 1.6) < 0.4 and len(more) < MOST


def test_two_places_take_two_prototypes():
    first, rest = ball(np.array([-2.0, 0.0]), 1.0)
    second = rest[np.linalg.norm(rest - [2.0, 0.0], axis=1) < 1]
    safe = rest[np.linalg.norm(rest - [2.0, 0.0], axis=1) >= 1]
    found = cover(np.concatenate([first, second]), safe)
    assert {np.sign(where[0]) for where, _ in found[:2]} == {-1.0, 1.0}


def test_numbers_that_do_not_count_are_left_out():
    failing, safe = np.array([[-4.0, 0.0]]), np.array([[0.0, 0.0], [1.0, 2.0]])
    (found,) = CONFIG.prototypes(failing, safe, ["x.pos"])
    assert [*found] == ["x.pos"] and 0.5 * 0.25 <= found["x.pos"][1] < 1.0


@pytest.mark.parametrize(
    ("failing", "safe", "of", "message"),
    [
        (np.zeros((0, 2)), np.zeros((3, 2)), None, "no frame is marked"),
        (np.zeros((MOST + 1, 2)), np.zeros((0, 2)), None, f"{MOST + 1} frames.*expected 1 to {MOST}"),
        (np.zeros((2, 2)), np.zeros((2, 2)), None, "lie among those marked as safe"),
        (np.zeros((2, 2)), np.zeros((0, 2)), ["z.pos"], "z.pos says nothing.*x.pos, y.pos"),
    ],
)
def test_frames_that_make_no_constraint_are_refused(failing, safe, of, message):
    with pytest.raises(ConstraintError, match=message):
        CONFIG.prototypes(failing, safe, of)


# -- what the critic reads ---


def test_random_sets_are_of_one_to_all_slots():
    sets = random_sets(torch.randn(30, 2), 500, torch.Generator().manual_seed(0))
    weight = sets[..., 3:5]
    count = (sets[..., 3:] > 0).any(-1).sum(1)
    assert sets.shape == (500, SLOTS, 6) and count.min() == 1 and count.max() == SLOTS
    reach = 1 / weight[weight > 0]
    assert reach.min() >= REACH[0] - 1e-5 and reach.max() <= REACH[1] + 1e-5
    assert ((weight > 0).sum(-1) == 1).any()
    own = sets[..., 5] > 0
    assert 0.2 < own.any(1).float().mean() < 0.45 and (sets[own] == torch.tensor([0, 0, -1, 0, 0, 1.0])).all()


def set_network():
    return SetNetwork(5, 3, 8, torch.nn.Linear(5 + 8 + 1, 3))


def test_the_order_of_a_set_does_not_matter_and_empty_slots_say_nothing():
    network, here, action = set_network(), torch.randn(1, 5), torch.randn(1, 1)
    sets = random_sets(torch.randn(30, 2), 1, torch.Generator().manual_seed(1))
    read = lambda sets: network(torch.cat([here, sets.flatten(1), action], 1))  # noqa: E731
    torch.testing.assert_close(read(sets), read(sets[:, torch.randperm(SLOTS)]))
    empty = (sets[..., 3:] > 0).any(-1, keepdim=True).logical_not()
    torch.testing.assert_close(read(sets), read(sets + empty * torch.tensor([5.0, 5.0, 5.0, 0.0, 0.0, 0.0])))


class Places(torch.nn.Module):
    """Where the true car is, as multiples of `apart`."""

    def __init__(self, apart):
        super().__init__()
        self.apart = apart

    def forward(self, features):
        return features[..., :2] / self.apart


def car_of(sets):
    """The true car, whose failures are sets of prototypes, from everywhere in view."""
    imagination = Constrained(DubinsImagination(), Places(0.25), torch.zeros(SLOTS, 6))
    generator = torch.Generator().manual_seed(0)
    scale = torch.tensor([1.1, 1.1, torch.pi])
    draw = lambda n: {"state": (2 * torch.rand(n, 3, generator=generator) - 1) * scale}  # noqa: E731
    return imagination, with_random_sets(draw, sets, generator)


def test_a_latent_keeps_its_set_in_imagination():
    imagination, starts = car_of(torch.randn(20, 2))
    latent = starts(6)
    after = imagination.step(latent, torch.zeros(6, 1))
    assert torch.equal(after[KEY], latent[KEY])
    features, margin = imagination.judged(after)
    assert features.shape == (6, 4 + 3 + SLOTS * 6) and torch.equal(margin, imagination.margin(after))


def test_a_critic_learns_sets_that_it_was_never_given():
    places = (2 * torch.rand(500, 2) - 1) * 4
    imagination, starts = car_of(places)
    config = tiny.reachability_config(
        critic_hidden=(64, 64), steps=300, pool=4096, horizon=12, batch_size=256, refresh=100
    )
    critic = SafetyCritic(4, 1, torch.tensor([[-1.0], [0.0], [1.0]]), config, numbers=3)
    learner = LatentReachability(imagination, critic, starts, config, torch.Generator().manual_seed(0))
    for _ in range(config.steps):
        learner.update()
    zone = torch.zeros(SLOTS, 6)
    zone[0] = torch.tensor([1.0, 1.0, 0.0, 0.7, 0.7, 0.0])  # around (0.25, 0.25)
    heading_for_it = torch.tensor([[-0.25, 0.25, 0.0], [0.9, 0.25, torch.pi], [0.25, 0.25, 1.0]])
    passing_by = torch.tensor([[-0.9, -0.9, 0.0], [0.9, 0.25, 0.0], [-0.5, 0.25, torch.pi]])
    latent = {"state": torch.cat([heading_for_it, passing_by])}
    latent[KEY] = zone.expand(len(latent["state"]), -1, -1)
    with torch.no_grad():
        value = critic.value(*imagination.judged(latent))
    assert value[:1].item() < value[3:].min().item() and (value[3:] > 0).all() and value[2] < 0


# -- learned from a recording ---


def test_likeness_is_learned_and_its_error_told():
    features = torch.randn(2000, 6)
    where = torch.stack([features[:, 0] * 2, features[:, 1]], -1)
    likeness = Likeness(6, LikenessConfig(ALIKE))
    held_out = torch.arange(2000) >= 1800
    error = fit_likeness(likeness, features, where, held_out, torch.Generator().manual_seed(0), steps=300)
    assert error.shape == (2,) and (error < 0.3).all()


def test_numbers_are_found_by_name_wherever_they_are(dataset_meta):
    found = numbers_named(dataset_meta, ["heading_sin.pos"])
    assert found.shape == (dataset_meta.total_frames, 1) and np.abs(found).max() <= 1
    with pytest.raises(ConstraintError, match=r"no numbers of that name.*heading_cos\.pos"):
        numbers_named(dataset_meta, ["turn_rate.vel"])


@pytest.fixture(scope="module")
def constrained_filter(tiny_world_model, cache_meta, tmp_path_factory):
    """Folder of a filter that takes constraints, of where the car heads."""
    folder = tmp_path_factory.mktemp("constrained") / "filter"
    alike = {"heading_cos.pos": 8.0, "heading_sin.pos": 8.0}  # so far that the least world model tells it
    train_reachability(tiny_world_model, cache_meta, folder, alike=alike)
    return folder


@pytest.fixture
def root(dataset_root, tmp_path):
    return shutil.copytree(dataset_root, tmp_path / "car")


def marked(root, **frames):
    """The dataset's frames, of which some (episode, frame) were marked under a name."""
    for name, places in frames.items():
        store = LabelStore(root, tiny.REPO_ID, [name])
        for episode, frame in places:
            store.mark(name, episode, frame, "ann")
        store.close()
    return DatasetFrames(tiny.metadata(root))


def decide(policy):
    observation = {
        "observation.image": torch.ones(1, 3, 128, 128),
        "observation.state": torch.tensor([[1.0, 0.0]]),
    }
    policy.reset()
    return policy.shield(observation, torch.tensor([[0.0, 1.0]]))


def test_a_constraint_is_added_saved_and_counts(constrained_filter, root, tmp_path):
    policy = load_filter(constrained_filter)
    assert policy.config.constraints == ["failure"] and policy.config.likeness.known == LikenessConfig().own_failure
    add_constraint(policy, marked(root, left=[(0, 1), (2, 3), (3, 0)]), "left")
    assert policy.config.constraints == ["failure", "left"] and len(policy.config.likeness.known["left"]) == 3
    save_policy(policy, tmp_path / "with_left")
    again = load_filter(tmp_path / "with_left")
    assert again.config.likeness == policy.config.likeness
    both = decide(again)
    again.config.change(constraints=["failure"])
    alone = decide(again)
    assert both.margin <= alone.margin and np.isfinite(alone.value.item())


def test_a_changed_constraint_makes_a_calibration_outdated(constrained_filter, root):
    policy = load_filter(constrained_filter)
    before = policy.belonging()
    add_constraint(policy, marked(root, left=[(0, 1)]), "left")
    assert before["law"]["constraints"] != policy.belonging()["law"]["constraints"]


def unknown_name(policy, root):
    add_constraint(policy, marked(root), "nothing_of_that_name")


def no_mark(policy, root):
    add_constraint(policy, marked(root, left=[(0, 1), (0, 1)]), "left")


def another_camera(policy, root):
    frames = marked(root, left=[(0, 1)])
    frames.cameras = ["observation.images.wrist"]
    add_constraint(policy, frames, "left")


def another_scene(policy, root):
    frames = marked(root, left=[(0, 1)])
    looks = {key: replace(look, furthest=1e-6) for key, look in policy.config.trained_on.looks.items()}
    policy.config.trained_on.looks = looks
    add_constraint(policy, frames, "left")


def another_place(policy, root):
    likeness = replace(policy.config.likeness, low=[50.0, 50.0], high=[60.0, 60.0])
    policy.config.change(likeness=likeness)
    add_constraint(policy, marked(root, left=[(0, 1)]), "left")


BAD = {
    unknown_name: (UnlabelledDatasetError, "nothing_of_that_name"),
    no_mark: (ConstraintError, "no frame is marked"),
    another_camera: (ValueError, "looks through observation.image"),
    another_scene: (ConstraintError, "frame 1 of episode 0 .* filter's data never do"),
    another_place: (ConstraintError, "frame 1 of episode 0 .* filter's data never do"),
}


@pytest.mark.parametrize("fault", BAD, ids=lambda fault: fault.__name__)
def test_frames_of_something_else_are_refused(constrained_filter, root, fault):
    error, message = BAD[fault]
    policy = load_filter(constrained_filter)
    with pytest.raises(error, match=message):
        fault(policy, root)
    assert policy.config.constraints == ["failure"]


def test_a_filter_of_one_failure_takes_no_constraints(policy, root):
    with pytest.raises(ConstraintError, match="train-reachability --alike"):
        add_constraint(policy, marked(root, left=[(0, 1)]), "left")
    with pytest.raises(ConstraintError, match="takes none"):
        policy.config.change(constraints=["left"])


def test_a_risk_is_of_one_failure(tiny_world_model, cache_meta, tmp_path):
    with pytest.raises(ConstraintError, match="--target=risk"):
        train_reachability(
            tiny_world_model, cache_meta, tmp_path / "out", target="risk", alike={"heading_cos.pos": 1.0}
        )


def test_what_the_pictures_do_not_show_is_refused(tiny_world_model, cache_meta, tmp_path):
    with pytest.raises(ConstraintError, match="the pictures tell it to within"):
        train_reachability(tiny_world_model, cache_meta, tmp_path / "out", alike={"heading_cos.pos": 1e-4})
    assert not (tmp_path / "out").exists()
