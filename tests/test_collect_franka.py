from dataclasses import replace

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tiny import save_franka_filter

from lerobot_latentsafe.cli.options import NewDataset
from lerobot_latentsafe.cli.record import Collect
from lerobot_latentsafe.collection import franka
from lerobot_latentsafe.collection import parts as collection_parts
from lerobot_latentsafe.collection.franka import SOURCES, Source
from lerobot_latentsafe.collection.franka import collect_franka as collect
from lerobot_latentsafe.collection.interventions import BRIEF, RETREATING, Interventions
from lerobot_latentsafe.collection.policy_operator import check_policy
from lerobot_latentsafe.collection.quiet import quiet_recording
from lerobot_latentsafe.datasets.labels import FailureLabels
from lerobot_latentsafe.franka.actions import action_limits
from lerobot_latentsafe.franka.bag import MIDDLE, TAIL, VARIANTS, Variant
from lerobot_latentsafe.robots.franka_mujoco.config_franka_mujoco import LatentSafeFrankaMujocoConfig
from lerobot_latentsafe.robots.franka_mujoco.franka_mujoco import LatentSafeFrankaMujoco
from lerobot_latentsafe.runtime.locations import CheckpointError

COLUMNS = ("observation.state", "action", "failure", "next.reward", "episode_index")


@pytest.fixture
def tiny(monkeypatch):
    """Blocks at 32 pixels, an episode a part."""
    scene = replace(franka.SCENES["blocks"], image_size=32)
    monkeypatch.setitem(franka.SCENES, "blocks", scene)
    monkeypatch.setattr(franka, "EPISODES_A_PART", 1)
    monkeypatch.setitem(SOURCES, "tiny", Source("blocks", {"pluck_careless": 1, "pluck_careful": 1}))


def columns(dataset):
    return {name: np.array(dataset.hf_dataset[name]) for name in COLUMNS}


def test_a_killed_recording_goes_on_and_equals_an_undisturbed_one(tiny, tmp_path, monkeypatch):
    whole = columns(collect("tiny", "me/tiny", tmp_path / "whole", 2, seed=0))
    record, left = franka.episode_frames, iter([True, False])

    def killed_in_the_second(*args):
        frames = record(*args)
        if next(left):
            return frames
        next(frames)
        raise KeyboardInterrupt

    monkeypatch.setattr(franka, "episode_frames", killed_in_the_second)
    with pytest.raises(KeyboardInterrupt):
        collect("tiny", "me/tiny", tmp_path / "cut", 2, seed=0)
    assert not (tmp_path / "cut").exists()
    calls = []
    monkeypatch.setattr(franka, "episode_frames", lambda *args: calls.append(args[2]) or record(*args))
    resumed = columns(collect("tiny", "me/tiny", tmp_path / "cut", 2, seed=0))
    assert calls == [1]  # the finished part was kept
    for name in COLUMNS:
        np.testing.assert_array_equal(resumed[name], whole[name])
    assert [path.name for path in tmp_path.iterdir()].count("cut.parts") == 0

    labels = FailureLabels.load(tmp_path / "whole")
    for episode in range(2):
        failing = labels.failure[labels.episode == episode]
        assert (np.diff(failing) >= 0).all()  # one first failing frame, all later ones fail
    assert set(labels.failure) == {0, 1}
    dataset = LeRobotDataset("me/tiny", root=tmp_path / "whole")
    assert dataset[0]["observation.images.front"].shape == (3, 32, 32)
    assert dataset.meta.info.robot_type == "latentsafe_franka_mujoco" and dataset.num_frames == 120


def test_a_quiet_recording_prints_nothing_of_its_videos(tiny, tmp_path, capfd, caplog):
    quiet_recording()
    with caplog.at_level("INFO"):
        collect("tiny", "me/tiny", tmp_path / "quiet", 2, seed=0)
    printed = capfd.readouterr()
    assert "libx264" not in printed.err and "Map" not in printed.err and "codec" not in caplog.text


def test_several_workers_record_the_same(tiny, tmp_path, monkeypatch):
    from multiprocessing.dummy import Pool
    from queue import SimpleQueue
    from types import SimpleNamespace

    alone = columns(collect("tiny", "me/tiny", tmp_path / "alone", 2, seed=0))
    # A thread in place of processes, which would not know of the tiny source.
    threads = SimpleNamespace(Pool=lambda workers, *start: Pool(1, *start), SimpleQueue=SimpleQueue)
    monkeypatch.setattr(collection_parts, "get_context", lambda method: threads)
    together = columns(collect("tiny", "me/tiny", tmp_path / "together", 2, seed=0, workers=2))
    for name in COLUMNS:
        np.testing.assert_array_equal(together[name], alone[name])


def test_branches_share_their_grasp_and_differ_after_it():

    with LatentSafeFrankaMujoco(LatentSafeFrankaMujocoConfig(image_size=32)) as robot:
        first = {}
        for episode in (0, 1, 5):
            frames = franka.episode_frames(robot, SOURCES["bag_branches"], episode, 0)
            first[episode] = [next(frames) for _ in range(4)]
            assert robot.scene.held_segment() is not None
    state = lambda episode, t: first[episode][t]["observation.state"]  # noqa: E731
    np.testing.assert_array_equal(state(0, 0), state(1, 0))
    assert np.abs(state(0, 3) - state(1, 3)).max() > 0
    assert np.abs(state(0, 0) - state(5, 0)).max() > 0.01


def test_a_bag_that_is_being_lowered_is_put_down_and_lifted_by_its_middle():
    source = replace(SOURCES["bag_mixed"], mix={"regrasp": 1}, grasps=(1, 0, 0, 0, 0, 0, 0))
    with LatentSafeFrankaMujoco(LatentSafeFrankaMujocoConfig(image_size=32, variant="sealed")) as robot:
        truths = list(franka.episode_truths(robot, source, 0, 0))
    grasps = [truth["grasp"] for truth in truths if truth["grasp"] >= 0]
    assert grasps[0] == TAIL and grasps[-1] == MIDDLE and -1 in [truth["grasp"] for truth in truths]
    assert not truths[0]["lifted"] and truths[-1]["is_success"]


@pytest.mark.parametrize("source", [name for name, source in SOURCES.items() if source.varied])
def test_starts_of_varied_bags_have_bags_of_their_own(source):
    """Branches share theirs, it is not one of the bags that filters are tested on, and it depends on the seed alone."""
    bags = {}
    with LatentSafeFrankaMujoco(LatentSafeFrankaMujocoConfig(image_size=32)) as robot:
        for episode in (0, 1, 2, 0):
            next(franka.episode_frames(robot, SOURCES[source], episode, 3))
            bag = robot.scene.variant
            assert bags.setdefault(episode, bag) == bag
    assert bags[0] != bags[2] and (bags[0] == bags[1]) == (SOURCES[source].branches > 1)
    for bag in bags.values():
        looks = replace(bag, stiffness=Variant.stiffness, candy_mass=Variant.candy_mass, friction=Variant.friction)
        assert looks == Variant()
        assert bag.stiffness < VARIANTS["stiff"].stiffness and bag.candy_mass < VARIANTS["heavy"].candy_mass


@pytest.mark.parametrize("source", [name for name, source in SOURCES.items() if source.speeds])
def test_speeds_of_a_source_are_drawn_from_its_range_by_the_seed_alone(source, monkeypatch):
    asked = []
    config = franka.LatentSafeScriptedConfig
    monkeypatch.setattr(
        franka, "LatentSafeScriptedConfig", lambda **options: asked.append(options["speed"]) or config(**options)
    )
    with LatentSafeFrankaMujoco(LatentSafeFrankaMujocoConfig(image_size=32)) as robot:
        for episode in (0, 1, 0):
            next(franka.episode_frames(robot, SOURCES[source], episode, 3))
    slowest, fastest = SOURCES[source].speeds
    assert asked[0] == asked[2] != asked[1] and all(slowest <= speed <= fastest for speed in asked)


def test_a_policy_of_the_users_own_acts_where_the_committed_ones_would(monkeypatch, tmp_path):
    """And an unfinished recording of it goes on with it alone."""
    acting = []

    class Still:
        begin = staticmethod(lambda seed: None)
        act = staticmethod(lambda seen: dict.fromkeys(franka.ACTION_NAMES, 0.0))

    monkeypatch.setattr(franka, "_policy_operator", lambda path, *rest: acting.append(path) or Still)
    monkeypatch.setattr(franka, "check_policy", lambda *asked: None)
    brief = replace(SOURCES["bag_policies"], seconds=0.2)
    monkeypatch.setitem(SOURCES, "bag_policies", brief)
    mine = collect("bag_policies", "me/mine", tmp_path / "mine", 3, seed=0, policy="outputs/mine")
    assert acting == ["outputs/mine"] * 3 and mine.num_episodes == 3
    monkeypatch.setattr(franka, "_record", lambda *args: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        collect("bag_policies", "me/mine", tmp_path / "cut", 3, seed=0, policy="outputs/mine")
    for other in ("outputs/other", None):
        with pytest.raises(ValueError, match="policy"):
            collect("bag_policies", "me/mine", tmp_path / "cut", 3, seed=0, policy=other)


@pytest.mark.parametrize("source", ["random", "so101_mix", "bag_mix", "blocks_demos"])
def test_a_policy_is_refused_where_operators_act(source, tmp_path):
    with pytest.raises(ValueError, match=f"no policy acts in {source}; expected --source=bag_policies or bag_shielded"):
        Collect(source=source, dataset=NewDataset("me/mine", str(tmp_path / "mine")), policy="outputs/mine")


@pytest.mark.parametrize(
    ("policy", "what"),
    [
        ("/nowhere", "no checkpoint at /nowhere"),
        ("bag", "is itself a latentsafe filter"),
        ("dubins_diffusion_careful", "cannot act on what the simulated Franka shows, which is observation.state"),
        ("blocks_dreamer", "acts at 20 fps, the simulated robot at 15"),
    ],
)
def test_a_policy_that_cannot_act_is_refused_before_anything_is_written(policy, what, tmp_path):
    with pytest.raises((ValueError, CheckpointError), match=what):
        collect("bag_policies", "me/mine", tmp_path / "mine", 1, seed=0, policy=policy)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("policy", [*SOURCES["bag_policies"].mix])
def test_the_committed_policies_may_act(policy):
    check_policy(policy, fps=15, image_size=224)


def test_what_the_operator_of_a_pushed_hand_wants_is_recorded(tiny):
    from lerobot_latentsafe.franka.actions import action_limits

    low, high = action_limits(20)
    steady = SOURCES["tiny"]
    with LatentSafeFrankaMujoco(LatentSafeFrankaMujocoConfig(scene="blocks", image_size=32)) as robot:
        runs, poses = [], []
        for source in (steady, replace(steady, pushed=0.1)):
            frames = list(franka.episode_frames(robot, source, 0, seed=3))
            runs.append(np.stack([frame["action"] for frame in frames]))
            poses.append(np.stack([frame["observation.state"][8:11] for frame in frames]))
    pushed = runs[1]
    assert ((pushed >= low - 1e-6) & (pushed <= high + 1e-6)).all()
    assert np.abs(poses[1] - poses[0]).max() > 0.005  # the hand strays
    # Recorded is not what the hand did.
    moved = np.diff(poses[1], axis=0)
    assert np.abs(moved - pushed[:-1, :3])[:20].max() > 0.002


class Closes:
    """A policy that closes the fingers at its third step and then moves up and sideways."""

    up = 0.9
    """More than the limits allow."""
    planned = coming = None
    is_told = False

    def __init__(self):
        self.executed = []

    @classmethod
    def load(cls, path):
        return cls()

    def reset(self):
        self.steps = 0

    def propose(self, batch):
        assert batch["observation.images.front"].max() <= 1 and batch["observation.state"].shape == (1, 14)
        self.steps += 1
        return torch.tensor([[0.001, 0, self.up, 0, 0, 0, float(self.steps < 3)]])

    def replan(self, executed):
        self.executed.append(executed[0, :7].numpy())


def test_a_policy_is_recorded_as_it_acts_and_is_overridden(tiny, monkeypatch):
    from lerobot_latentsafe.collection import policy_operator

    monkeypatch.setattr(policy_operator, "BasePolicy", Closes)
    franka._policy_operator.cache_clear()
    source = Source("blocks", {"closes": 2}, policies=True, style=BRIEF, seconds=3.0)
    with LatentSafeFrankaMujoco(LatentSafeFrankaMujocoConfig(scene="blocks", image_size=32)) as robot:
        runs = [list(franka.episode_frames(robot, source, episode, 0)) for episode in (0, 0, 1)]
    operator = franka._policy_operator("closes", 20, BRIEF, None)
    franka._policy_operator.cache_clear()
    actions = np.stack([[frame["action"] for frame in frames] for frames in runs])
    assert actions.shape == (3, 60, 7)
    np.testing.assert_array_equal(actions[0], actions[1])
    assert np.abs(actions[0] - actions[2]).max() > 0
    acts, overridden = actions[..., 0] > 0, actions[..., 0] == 0
    assert (acts | overridden).all() and acts[:, :3].all() and overridden.any() and acts[:, 3:].any()
    assert actions[acts][:, 2] == pytest.approx(0.3 / 20)
    assert (actions[overridden][:, 2] <= 0).all() and (actions[overridden][:, 6] == 0).all()
    # What was done instead is told to the policy, step by step.
    np.testing.assert_array_equal(np.stack(operator.policy.executed), actions[overridden])


def test_a_filter_may_say_when(tiny, tmp_path, monkeypatch):
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

    monkeypatch.setattr(Closes, "up", 0.01)
    monkeypatch.setattr(LatentSafePolicy, "attach", lambda self, path: setattr(self, "_base", [Closes()]))
    style = replace(RETREATING, steps=(2, 4), down=1.0)
    for epsilon, passes in ((2.0, False), (-2.0, True)):
        path = str(save_franka_filter(tmp_path / str(epsilon), law_epsilon=epsilon))
        source = Source("blocks", {"closes": 1}, policies=True, style=style, shield=path, seconds=1.0)
        with LatentSafeFrankaMujoco(LatentSafeFrankaMujocoConfig(scene="blocks", image_size=32)) as robot:
            frames = list(franka.episode_frames(robot, source, 0, 0))
        actions = np.stack([frame["action"] for frame in frames])
        lowered = actions[:, 0] == 0
        assert lowered[0] != passes and not (passes and lowered.any())
        assert (actions[lowered, 2] < 0).all() and (actions[~lowered, 2] == np.float32(0.01)).all()
        # What was done instead is told to the policy, and to the filter, which remembers it.
        operator = franka._policy_operator("closes", 20, style, path)
        np.testing.assert_allclose(np.reshape(operator.policy.executed, (-1, 7)), actions[lowered], atol=1e-6)
        executed = operator.filter.model.units.denormalise_action(operator.filter.shield.executed[-1])[0]
        np.testing.assert_allclose(executed.numpy(), actions[-1], atol=1e-5)
    franka._policy_operator.cache_clear()


def test_somebody_intervenes_while_the_fingers_close_and_the_operator_goes_on(tiny):

    actions = {}
    for style in (None, RETREATING):
        source = Source("bag", {"open_end": 1}, style=style, seconds=8.0)
        with LatentSafeFrankaMujoco(LatentSafeFrankaMujocoConfig(scene="bag", image_size=32)) as robot:
            frames = list(franka.episode_frames(robot, source, 3, 0))
        actions[style] = np.stack([frame["action"] for frame in frames])
    alone, intervened = actions.values()
    differs = np.abs(alone - intervened).max(1) > 0
    assert differs.any() and not differs[: np.argmax(alone[:, 6] < 0.5) + 1].any()
    first = intervened[np.argmax(differs)]
    limits = action_limits(15)
    assert (first[[0, 1, 3, 4, 5]] == 0).all() and 0.5 * limits[0][2] - 1e-6 <= first[2] <= 0 and first[6] < 0.5


def test_interventions_last_as_long_and_go_as_fast_as_they_are_asked_to():
    limits, action = action_limits(15), np.array([0.001, 0, 0.01, 0, 0, 0, 0.0])
    interventions = Interventions(RETREATING, limits, np.random.default_rng(0))
    assert not interventions(action)[1]  # fingers that were open
    taken = [interventions(action) for _ in range(20_000)]
    speeds = np.array([executed[2] / limits[0][2] for executed, intervened in taken if intervened])
    held = speeds == 0
    assert 0.2 < held.mean() < 0.4
    assert speeds[~held].min() >= 0.15 and speeds.max() <= 0.5
    flags = "".join(str(int(intervened)) for _, intervened in taken)
    lengths = [len(run) for run in flags.split("0") if run]
    assert min(lengths) == 3 and max(lengths) == 39
    passed = [executed for executed, intervened in taken if not intervened]
    assert all((executed == action).all() for executed in passed)


def test_mixes_keep_their_proportions():
    source = SOURCES["bag_mix"]
    assert source.n_episodes == 1300
    names = [source.behavior(i) for i in range(1300)]
    assert {name: names.count(name) for name in set(names)} == source.mix
    assert 60 <= [*names[:100]].count("random") <= 90


def test_bad_requests_are_refused(tiny, tmp_path):
    with pytest.raises(ValueError, match=r"--source is 'jar'; expected one of bag_mix"):
        collect("jar", "me/x", tmp_path / "x", 1, 0)
    with pytest.raises(ValueError, match="--workers is 0; expected at least 1"):
        collect("tiny", "me/x", tmp_path / "x", 1, 0, workers=0)
    for n in (0, -1):
        with pytest.raises(ValueError, match=rf"--dataset\.num_episodes is {n}; expected at least 1"):
            collect("tiny", "me/x", tmp_path / "x", n, 0)
    (tmp_path / "precious").write_text("data")
    with pytest.raises(FileExistsError, match=r"another --dataset\.root"):
        collect("tiny", "me/x", tmp_path, 1, 0)


def test_a_full_disk_leaves_finished_parts(tiny, tmp_path, monkeypatch):
    import errno

    record = franka.episode_frames

    def full_disk(robot, source, episode, seed):
        if episode == 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        return record(robot, source, episode, seed)

    monkeypatch.setattr(franka, "episode_frames", full_disk)
    with pytest.raises(OSError, match="No space left"):
        collect("tiny", "me/tiny", tmp_path / "x", 2, seed=0)
    finished = LeRobotDataset("me/tiny", root=tmp_path / "x.parts" / "000000_000001")
    assert finished.num_episodes == 1


def test_an_episode_that_is_played_again_tells_what_was_recorded(tiny):
    with LatentSafeFrankaMujoco(LatentSafeFrankaMujocoConfig(scene="blocks", image_size=32)) as robot:
        for episode in range(2):
            recorded = [bool(f["failure"]) for f in franka.episode_frames(robot, SOURCES["tiny"], episode, seed=0)]
            again = [bool(t["failure"]) for t in franka.episode_truths(robot, SOURCES["tiny"], episode, seed=0)]
            assert np.array_equal(np.logical_or.accumulate(again), recorded) and (episode == 1 or any(recorded))
        with pytest.raises(ValueError, match=r"bag_diffusion_weak.*only operators are played again"):
            next(franka.episode_truths(robot, SOURCES["bag_policies"], 0, seed=0))
