"""The task policy learned in imagination, as a LeRobot policy, and its training, killed and not."""

import json
import shutil
from multiprocessing.pool import ThreadPool
from pathlib import Path
from types import SimpleNamespace

import draccus
import numpy as np
import pytest
import tiny
import torch
from safetensors.torch import load_file
from test_hub import hub  # noqa: F401

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.cli.deploy import Push
from lerobot_latentsafe.cli.places import PolicySource
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.experiments.blocks import dreamer_training, recorders
from lerobot_latentsafe.experiments.blocks.dreamer_training import DreamerTraining, TrainDreamer
from lerobot_latentsafe.experiments.blocks.replay import CAMERA_KEYS, Replay
from lerobot_latentsafe.experiments.blocks.study import world_model_of
from lerobot_latentsafe.franka.actions import STATE_NAMES, action_limits
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.policies.dreamer.modeling_dreamer import LatentSafeDreamerPolicy, WorldModelMismatchError
from lerobot_latentsafe.runtime.files import FolderInUseError, OtherRunError
from lerobot_latentsafe.runtime.hub import halve_weights
from lerobot_latentsafe.runtime.locations import CheckpointError
from lerobot_latentsafe.safety_model import UntrainedFilterError
from lerobot_latentsafe.training import train_reachability


@pytest.fixture(scope="module", autouse=True)
def short_blocks():
    with tiny.short_blocks():
        yield


@pytest.fixture(scope="module")
def trained(tiny_dreamer):
    return tiny_dreamer


@pytest.fixture
def task_policy(trained):
    return LatentSafeDreamerPolicy.from_pretrained(trained / "policy")


def observation(n=2, size=128, seed=0):
    rng = torch.Generator().manual_seed(seed)
    images = {key: torch.rand(n, 3, size, size, generator=rng) for key in CAMERA_KEYS}
    return {**images, "observation.state": torch.randn(n, 14, generator=rng)}


def drive(policy, n=3):
    policy.reset()
    return torch.stack([policy.select_action(observation(seed=t)) for t in range(n)])


# Acting


def test_actions_that_are_drawn_far_out_of_range_are_executed_and_remembered_clipped(task_policy, monkeypatch):
    monkeypatch.setattr(task_policy.actor, "sample", lambda features: torch.full((2, 7), 50.0))
    task_policy.reset()
    action = task_policy.act(observation(), explore=True)
    torch.testing.assert_close(task_policy.executed, torch.ones(2, 7))
    torch.testing.assert_close(action, task_policy.model.units.denormalise_action(torch.ones(2, 7)))


def test_a_hand_that_is_led_astray_goes_there_for_some_steps_and_the_policy_remembers(task_policy):
    def acts(rng):
        torch.manual_seed(0)
        explore = recorders._Exploring(task_policy, rng)
        for t in range(60):
            action = torch.from_numpy(explore(observation(1, seed=t)))
            torch.testing.assert_close(task_policy.model.units.denormalise_action(task_policy.executed), action)
            yield explore.straying and explore.straying.left, action

    left, action = zip(*acts(np.random.default_rng(1)))
    _, alone = zip(*acts(None))
    begun = next(t for t in range(60) if left[t])
    assert torch.equal(torch.cat(action[:begun]), torch.cat(alone[:begun]))
    led = torch.cat(action[begun : begun + left[begun] + 1])
    assert 2 <= len(led) <= 6 and torch.equal(led[:, :3], led[:1, :3].expand(len(led), 3))
    assert not torch.equal(led[0, :3], alone[begun][0, :3])


def test_at_the_first_frame_it_knows_what_its_fingers_do(task_policy, monkeypatch):
    model, seen = task_policy.model, []
    observe = model.world_model.observe
    monkeypatch.setattr(model.world_model, "observe", lambda *args: seen.append(args[1]) or observe(*args))
    for opening in (0.0, 1.0):
        batch = observation()
        batch["observation.state"][:, STATE_NAMES.index("gripper.pos")] = opening
        task_policy.reset()
        task_policy.select_action(batch)
    closed, opened = seen[0], seen[2]  # it looks twice
    assert (closed[:, -1] == -1).all() and (opened[:, -1] == 1).all() and not closed[:, :-1].any()


# Training


def weights(folder):
    return {name: load_file(folder / name / "model.safetensors") for name in ("policy", "policy/world_model")}


class Killed(BaseException):
    pass


def killed(*given, **options):
    raise Killed


def log_of(folder):
    rows = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    return [{name: value for name, value in row.items() if name != "cpu_s"} for row in rows]


def same_run(folder, trained):
    """Whether a run left what another left, to the last bit."""
    for name, expected in weights(trained).items():
        found = weights(folder)[name]
        assert found.keys() == expected.keys()
        assert all(torch.equal(found[key], expected[key]) for key in expected), name
    for name in (*CAMERA_KEYS, "action", "terms"):
        np.testing.assert_array_equal(*(np.load(f / "replay" / f"{name}.npy") for f in (folder, trained)))
    assert log_of(folder) == log_of(trained)
    assert sorted(p.name for p in folder.iterdir()) == sorted(p.name for p in trained.iterdir())
    assert [p.name for p in (folder / "checkpoints").iterdir()] == [f"{tiny.dreamer_options(folder).steps:07d}"]


def test_a_killed_run_ends_as_one_that_was_not(trained, tmp_path):
    folder = tmp_path / "run"
    run = DreamerTraining(tiny.dreamer_options(folder))
    update = run.update

    def update_or_die():
        if run.step == 5:  # a round of episodes after the checkpoint of step 4
            raise Killed
        return update()

    run.update = update_or_die
    with pytest.raises(Killed):
        run.run()
    assert [p.name for p in (folder / "checkpoints").iterdir()] == ["0000004"]
    with (folder / "log.jsonl").open("a") as log:
        log.write('{"step": 5, "cp')  # torn by the kill
    resumed = DreamerTraining(tiny.dreamer_options(folder))
    assert resumed.step == 4
    resumed.run()
    same_run(folder, trained)


KILLS = ["claim", "save_optimizer_state", "discard", "export", "Recorders", "LatentSafeDreamerPolicy"]


@pytest.mark.parametrize("step", KILLS)
def test_a_run_killed_while_it_writes_ends_as_one_that_was_not(trained, tmp_path, monkeypatch, step):
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(dreamer_training, step, killed)
        DreamerTraining(tiny.dreamer_options(tmp_path / "run")).run()
    DreamerTraining(tiny.dreamer_options(tmp_path / "run")).run()
    same_run(tmp_path / "run", trained)


@pytest.mark.fault(
    "K11", "options.json of train-dreamer is torn by a kill", "That one file is to be removed; the run goes on"
)
def test_a_note_torn_by_a_kill_is_told_and_the_rest_goes_on(trained, tmp_path):
    folder = shutil.copytree(trained, tmp_path / "run")
    (folder / "options.json").write_text("")
    with pytest.raises(OtherRunError, match=r"options\.json .* not readable .*remove this one file"):
        DreamerTraining(tiny.dreamer_options(folder))
    (folder / "options.json").unlink()
    assert DreamerTraining(tiny.dreamer_options(folder)).step == 7


@pytest.mark.fault("K14", "two train-dreamer write one folder", "The second is refused (`FolderInUseError`)")
def test_two_at_once_are_told_apart(tmp_path):
    with tiny.written_elsewhere(tmp_path / "run"), pytest.raises(FolderInUseError, match=r"is writing .*run already"):
        tiny.dreamer_options(tmp_path / "run").run()
    assert not (tmp_path / "run").exists()


def test_other_workers_record_the_same_episodes(monkeypatch):
    monkeypatch.setattr(recorders, "get_context", lambda method: SimpleNamespace(Pool=ThreadPool))
    episodes = []
    for workers in (0, 1):
        those = recorders.Recorders(seed=3, image_size=16, workers=workers)
        episodes.append(list(those([0, 1], None)))
        those.close()
    for here, there in zip(*episodes):
        assert here.keys() == there.keys()
        for name in here:
            np.testing.assert_array_equal(here[name], there[name])


def test_step_sizes_rise_at_first_and_fall_to_nothing_over_the_last_fifth(trained):
    run = DreamerTraining(tiny.dreamer_options(trained))
    run.options.steps = 1000
    for run.step, share in ((0, 0.01), (99, 1), (800, 1), (900, 0.5), (999, 0.005)):
        run._descend("behavior")
        found = [group["lr"] for group in run.optimizers["behavior"].param_groups]
        assert found == pytest.approx([lr * share for lr in run.step_sizes["behavior"]])


def test_resuming_with_other_options_is_refused(trained):
    with pytest.raises(ValueError, match="run with other options \\(batch_size = 4\\)"):
        DreamerTraining(tiny.dreamer_options(trained, batch_size=5))


def test_a_finished_run_has_nothing_left_to_do(trained):
    run = DreamerTraining(tiny.dreamer_options(trained))
    assert run.step == run.options.steps
    run.run()


def test_all_parts_learn(trained, tmp_path):
    run = DreamerTraining(tiny.dreamer_options(tmp_path / "run"))
    before = {k: v.clone() for k, v in run.policy.state_dict().items()}
    world_model = {k: v.clone() for k, v in run.policy.model.state_dict().items()}
    for run.step in (0, 3, 4):
        metrics = run.update()
    assert {"loss", "loss_margin", "loss_reward", "loss_cloning", "loss_actor", "loss_critic"} <= set(metrics)
    moved = {k.split(".")[0] for k, v in run.policy.state_dict().items() if not torch.equal(v, before[k])}
    assert moved == {"actor", "critic", "reward", "slow_critic", "return_range"}
    moved = {k.split(".")[0] for k, v in run.policy.model.state_dict().items() if not torch.equal(v, world_model[k])}
    assert moved == {"world_model", "margin"}


def test_batches_hold_demonstrations_by_their_share_of_episodes_and_a_least_share(trained):
    run = DreamerTraining(tiny.dreamer_options(trained))
    run.step, run.options.batch_size = 5, 20
    share = run.options.demonstrations / run.n_episodes
    assert run.options.demonstration_share < share < 1
    assert run._batch()[2].sum() == round(20 * share)
    run.options.demonstration_share = 0.9
    reward, _, demonstrated, starts, weights, *clip = run._batch()
    valid = clip[5]
    assert demonstrated.sum() == 18 and reward.shape == valid.shape == (20, 6)
    assert valid.flatten()[starts].all() and weights.tolist() == pytest.approx([1.0, 0.1])
    run.step = 2  # before the policy has episodes
    _, _, demonstrated, _, weights, *_ = run._batch()
    assert demonstrated.all() and weights.tolist() == [0.0, 1.0]


def test_rewards_are_those_of_the_frames(trained):
    run = DreamerTraining(tiny.dreamer_options(trained))
    run.step = 0
    reward, _, _, _, _, *clip = run._batch()
    terms = run.replay.arrays["terms"]
    every = run.policy.config.behavior.rewards.reward(torch.from_numpy(terms[: 2 * tiny.BLOCKS_FRAMES]))
    for row, valid in zip(reward, clip[5]):
        kept = row[valid]
        windows = every.unfold(0, len(kept), 1)
        assert (windows - kept).abs().amax(1).min() < 1e-6


def test_demonstrations_show_what_the_operator_meant_beside_what_a_jostled_hand_did(trained):
    replay = DreamerTraining(tiny.dreamer_options(trained)).replay
    n = 2 * tiny.BLOCKS_FRAMES
    meant, done = replay.arrays["meant"][:n], replay.arrays["action"][:n]
    speed = 20 * np.linalg.norm(meant[:, :3], axis=1)
    assert speed.max() == pytest.approx(0.3, abs=1e-3)  # on the way to the blocks
    assert 0.1 < (meant != done).any(1).mean() < 0.6 and replay.written.all()


def test_a_hand_is_led_astray_at_up_to_full_speed_and_jostled_only_while_its_fingers_are_open():
    steps = [np.array([0.002, 0, 0, 0, 0, 0, grip]) for grip in (1.0, 0.0) for _ in range(400)]
    low, high = action_limits(20)
    operator = recorders._Scripted(iter(steps), 20, np.random.default_rng(0))
    done = np.array([operator({})[0] for _ in steps])
    astray = np.isclose(np.abs(done[:, :3]).max(1) / high[0], 1, atol=1e-6)
    moved = (done[:, :3] != np.array(steps)[:, :3]).any(1)
    assert 0.02 < astray.mean() < 0.2 and (done[:, 6] == np.array(steps)[:, 6]).all()
    assert 0.2 < moved[:400].mean() < 0.45 and 0.05 < moved[400:].mean() < 0.3
    assert ((done >= low) & (done <= high)).all()


def test_what_was_meant_is_imitated_not_what_was_done(trained):
    run = DreamerTraining(tiny.dreamer_options(trained))
    run.step = 0
    _, meant, *_ = run._batch()
    every = run.policy.model.units.normalise_action(torch.from_numpy(np.array(run.replay.arrays["meant"]))).clamp(-1, 1)
    for row in meant:
        windows = every.unfold(0, 3, 1)  # (N, A, 3)
        assert (windows - row[:3].T).abs().amax((1, 2)).min() < 1e-6
    features = torch.zeros(*meant.shape[:2], run.policy.model.world_model.feature_dim)
    known = torch.ones(meant.shape[:2], dtype=torch.bool)
    loss = run.policy.cloning_loss(features, meant, known).item()
    assert loss == pytest.approx(-run.policy.actor.log_prob(features, meant).mean().item(), rel=1e-5)


def test_replay_of_another_size_is_refused(tmp_path):
    Replay.open(tmp_path, 2, 60, 16)
    with pytest.raises(ValueError, match=r"shape \(120, 3, 16, 16\), expected \(180, 3, 16, 16\)"):
        Replay.open(tmp_path, 3, 60, 16)


NONSENSE = {
    "pretraining": 9, "steps": 0, "demonstrations": 0, "collect_every": 0, "n_envs": -1, "batch_size": 0,
    "save_every": 0, "log_every": 0, "workers": -1, "seed": -1, "demonstration_share": float("nan"),
}  # fmt: skip


@pytest.mark.parametrize(
    "changes, message",
    [({"model": 0}, "model.type"), *(({name: value}, f"--{name} is {value}") for name, value in NONSENSE.items())],
)
def test_bad_options_are_refused(tmp_path, changes, message):
    if "model" in changes:
        changes = {"model": tiny.dreamer_options(tmp_path).policy}
    with pytest.raises(ValueError, match=message):
        tiny.dreamer_options(tmp_path, **changes)


def test_the_configuration_that_is_shipped_is_understood(tmp_path):
    file = Path(__file__).parents[1] / "configs" / "blocks_dreamer.yaml"
    changes = ["--policy.behavior.rewards.topple=5", f"--output_dir={tmp_path}"]
    options = draccus.parse(TrainDreamer, config_path=file, args=changes)
    assert options.model.world_model.classes == 16 and options.policy.behavior.rewards.topple == 5


# The policy


def test_loaded_policy_acts_as_the_saved_one(task_policy, tmp_path):
    task_policy.save_pretrained(tmp_path / "copy")
    actions = drive(LatentSafeDreamerPolicy.from_pretrained(tmp_path / "copy"))
    torch.testing.assert_close(actions, drive(task_policy), rtol=0, atol=0)
    assert actions.shape == (3, 2, 7) and task_policy.config.world_model_path != "world_model"


def test_a_policy_may_share_the_world_model_of_another_checkpoint(task_policy, trained, tmp_path):
    shared = tmp_path / "shared"
    shutil.copytree(trained / "policy", shared)
    (shared / "world_model").rename(tmp_path / "filter")
    config = json.loads((shared / "config.json").read_text())
    for path in ("no/such/filter", str(tmp_path / "filter")):
        (shared / "config.json").write_text(json.dumps({**config, "world_model_path": path}))
        assert world_model_of(str(shared)) == path
        if path.startswith("no"):
            with pytest.raises(CheckpointError, match="no checkpoint at no/such/filter"):
                LatentSafeDreamerPolicy.from_pretrained(shared)
    torch.testing.assert_close(drive(LatentSafeDreamerPolicy.from_pretrained(shared)), drive(task_policy))
    assert world_model_of(str(trained / "policy")) == str(trained / "policy/world_model")


def test_lerobot_makes_it_by_its_type(trained):
    base = BasePolicy.load(trained / "policy")
    assert base.config.type == "latentsafe_dreamer"
    base.reset()
    assert base.propose(observation()).shape == (2, 7)


def test_halved_weights_still_load(task_policy, tmp_path):
    task_policy.save_pretrained(tmp_path / "half")
    halve_weights(tmp_path / "half")
    drive(LatentSafeDreamerPolicy.from_pretrained(tmp_path / "half"))


def test_history_matters_until_reset(task_policy):
    first = drive(task_policy, 2)
    task_policy.reset()
    assert not torch.equal(task_policy.select_action(observation(seed=1)), first[1])
    torch.testing.assert_close(drive(task_policy, 2), first)


def test_overridden_action_is_remembered(task_policy):
    task_policy.reset()
    action = task_policy.select_action(observation())
    torch.testing.assert_close(task_policy.model.units.denormalise_action(task_policy.executed), action)
    other = torch.zeros(2, 7)
    task_policy.was_overridden(other)
    expected = task_policy.model.units.normalise_action(other).clamp(-1, 1)
    torch.testing.assert_close(task_policy.executed, expected)


@pytest.mark.parametrize(
    "name, value",
    [("task", "lift the bag"), ("cameras", ["observation.images.top"]), ("fps", 15), ("action_names", ["x"])],
)
def test_world_model_of_something_else_is_refused(trained, name, value, tmp_path):
    copy = shutil.copytree(trained / "policy", tmp_path / "copy")
    tiny.rewrite_json(copy / "config.json", **{name: value})
    with pytest.raises(WorldModelMismatchError, match=f"the world model has {name} = .*this policy was trained with"):
        LatentSafeDreamerPolicy.from_pretrained(copy)


def test_filter_of_another_task_does_not_shield_it(trained, tmp_path):
    tiny.save_franka_filter(tmp_path / "filter", trained_on_task="lift the bag")
    filter = load_filter(tmp_path / "filter")
    with pytest.raises(ValueError, match=r"has task = pluck the green block.*, the filter lift the bag"):
        filter.attach(trained / "policy")


def test_policies_of_other_types_are_refused(tiny_diffusion, trained):
    with pytest.raises(CheckpointError, match="'diffusion' policy, expected latentsafe_dreamer"):
        LatentSafeDreamerPolicy.from_pretrained(tiny_diffusion)
    with pytest.raises(CheckpointError, match="'latentsafe_dreamer' policy, expected a 'latentsafe' filter"):
        LatentSafePolicy.from_pretrained(trained / "policy")


def test_from_nothing_it_says_how_to_train_one(task_policy):
    from lerobot_latentsafe import LatentSafeDreamerConfig

    with pytest.raises(UntrainedFilterError, match="latentsafe train-dreamer"):
        LatentSafeDreamerPolicy(LatentSafeDreamerConfig(device="cpu"))
    with pytest.raises(UntrainedFilterError, match="latentsafe train-dreamer"):
        task_policy.forward({})


# From the task policy to a filter


def test_filter_is_trained_on_its_world_model_and_shields_it(trained, tmp_path):
    from lerobot_latentsafe import LatentSafeBlocksEnv
    from lerobot_latentsafe.evaluation.rollouts import compare

    episodes = tiny.metadata(trained / "episodes", "local/blocks_dreamer")
    assert episodes.total_episodes == 2 + 2 * 2
    policy = train_reachability(trained / "policy" / "world_model", episodes, tmp_path / "filter")
    policy.attach(trained / "policy")
    env = LatentSafeBlocksEnv()
    policy.config.change(law=policy.config.law.changed(LawOptions(epsilon=2.0)))
    result = compare(policy, env, 2, seed=0)
    assert result["shielded"]["overridden_share"] == 1


def test_exported_episodes_are_the_replay(trained):
    from lerobot_latentsafe.datasets.frame_cache import FrameCache

    cache = FrameCache.open(trained / "episodes", tiny.metadata(trained / "episodes", "local/blocks_dreamer"))
    replay = np.load(trained / "replay" / "observation.images.wrist.npy")
    np.testing.assert_array_equal(cache.percepts["observation.images.wrist"], replay)
    assert cache.manifest["cameras"]["observation.images.front"] == [128, 128, 3]


def test_pulled_policy_acts_as_the_pushed_one(hub, task_policy, trained):  # noqa: F811
    Push(policy=PolicySource(str(trained / "policy")), repo_id="me/dreamer", dataset_repo_id="me/blocks").run()
    assert "world_model/model.safetensors" in hub.repos["me/dreamer"]
    assert "fails at times, on purpose" in hub.repos["me/dreamer"]["README.md"].decode()
    torch.testing.assert_close(drive(LatentSafeDreamerPolicy.from_pretrained("me/dreamer")), drive(task_policy))


def test_log_counts_outcomes_of_each_round(trained):
    rows = [json.loads(line) for line in (trained / "log.jsonl").read_text().splitlines()]
    rounds = [row for row in rows if "episodes" in row]
    assert [row["episodes"] for row in rounds] == [4, 6] and all(0 <= row["violation"] <= 2 for row in rounds)
