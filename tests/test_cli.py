import json

import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe.cli import VERBS, main
from lerobot_latentsafe.dubins.ground_truth import exact_value
from lerobot_latentsafe.runtime import checkpoint

PROVENANCE = {"command", "commit", "seeds", "cpu_minutes", "machine", "date"}


def fails(capsys, *argv):
    """The message of a command that must fail, and leave no traceback."""
    with pytest.raises(SystemExit) as stopped:
        main(list(argv))
    assert stopped.value.code not in (0, None)
    message = f"{stopped.value.code} {capsys.readouterr().err}"
    assert "Traceback" not in message
    return message


@pytest.mark.parametrize("argv", [[], ["--help"], ["-h"], ["help"]])
def test_help_lists_every_verb(capsys, argv):
    main(argv)
    text = capsys.readouterr().out
    for verb, (_, what) in VERBS.items():
        assert verb in text and what in text


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_its_options(capsys, verb):
    with pytest.raises(SystemExit) as stopped:
        main([verb, "--help"])
    assert stopped.value.code == 0
    assert "--" in capsys.readouterr().out


def test_unknown_verb_lists_the_known_ones(capsys):
    message = fails(capsys, "fly")
    assert "unknown verb 'fly'" in message and "eval-shield" in message


def test_path_prints_a_committed_checkpoint(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "PRETRAINED", tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "config.json").write_text("{}")
    main(["path", "--name=mine"])
    assert capsys.readouterr().out.strip() == str(tmp_path / "mine")
    assert "one of mine" in fails(capsys, "path", "--name=yours")


def test_collect_and_cache(capsys, tmp_path):
    root, cache = tmp_path / "car", tmp_path / "car_cache"
    main(["collect", "--source=random", "--repo_id=me/car", f"--root={root}", "--n_episodes=2", "--seed=3"])
    main(["cache", "--dataset.repo_id=me/car", f"--dataset.root={root}", f"--output_dir={cache}", "--image_size=16"])
    printed = capsys.readouterr().out
    assert "2 episodes" in printed and f"--dataset.root={cache}" in printed
    assert json.loads((cache / "frame_cache" / "manifest.json").read_text())["image_size"] == 16


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--source=brave", "--repo_id=me/x", "--root=new"], "--source is 'brave'"),
        (["--source=random", "--repo_id=me/x", "--root=."], "exists; choose another --root"),
        (["--source=random", "--repo_id=me/x", "--root=new", "--n_episodes=many"], "n_episodes"),
        (["--source=random"], "repo_id"),
        (["--source=random", "--repo_id=me/x", "--root=new", "--colour=red"], "colour"),
    ],
    ids=["unknown source", "existing folder", "no number", "option missing", "unknown option"],
)
def test_bad_options_are_named_without_a_traceback(capsys, tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    assert message in fails(capsys, "collect", *options)


def test_train_reachability_with_several_seeds(tiny_world_model, cache_root, tmp_path):
    main(
        ["train-reachability", f"--policy.path={tiny_world_model}", f"--dataset.repo_id={tiny.REPO_ID}",
         f"--dataset.root={cache_root}", f"--output_dir={tmp_path}", "--seeds=[0,1]", "--steps=3"]
    )  # fmt: skip
    weights = [(tmp_path / f"seed_{seed}" / "model.safetensors").read_bytes() for seed in (0, 1)]
    assert weights[0] != weights[1]


def test_untrained_filter_is_a_message(capsys, tiny_world_model):
    message = fails(capsys, "eval-monitor", f"--policy.path={tiny_world_model}", "--env.type=latentsafe_dubins")
    assert "never" in message and "train-reachability" in message


def test_policy_of_another_type_is_a_message(capsys, tiny_diffusion):
    message = fails(capsys, "eval-monitor", f"--policy.path={tiny_diffusion}", "--env.type=latentsafe_dubins")
    assert "expected a 'latentsafe' filter" in message


def test_eval_monitor_writes_the_documented_keys(tiny_filter, tmp_path):
    states = np.random.default_rng(0).uniform(-1.1, 1.1, (60, 3))
    np.save(tmp_path / "states.npy", states)
    main(
        ["eval-monitor", f"--policy.path={tiny_filter}", "--env.type=latentsafe_dubins", "--truth=discrete",
         f"--states={tmp_path / 'states.npy'}", f"--values_out={tmp_path / 'new' / 'values.npy'}",
         f"--json={tmp_path / 'row.json'}"]
    )  # fmt: skip
    row = json.loads((tmp_path / "row.json").read_text())
    documented = {"f1_safe", "f1_unsafe", "balanced_accuracy", "false_safe_rate", "false_unsafe_rate", "n", "truth"}
    assert documented | PROVENANCE | {"safe_policy"} <= set(row)
    assert (row["n"], row["truth"]) == (60, "discrete") and set(row["safe_policy"]) == {"safe", "n"}
    value, truth = np.load(tmp_path / "new" / "values.npy"), exact_value(states)
    assert value.shape == (60,)
    assert row["false_safe_rate"] == pytest.approx((value > 0)[truth <= 0].mean())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--truth=paper"], "--truth is 'paper'"),
        (["--states=missing.npy"], "missing.npy"),
        (["--states=flat.npy"], "expected finite (N, 3)"),
        (["--env.fps=10"], "--env.fps is 10"),
    ],
)
def test_bad_evaluations_are_messages(capsys, tiny_filter, tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    np.save("flat.npy", np.zeros(3))
    np.save("one.npy", np.zeros((1, 3)))
    base = ["eval-monitor", f"--policy.path={tiny_filter}", "--env.type=latentsafe_dubins", "--states=one.npy"]
    given = [o for o in base if not any(o.split("=")[0] == option.split("=")[0] for option in options)]
    assert message in fails(capsys, *given, *options)


def test_eval_shield_writes_the_documented_keys(tiny_filter, tiny_diffusion, tmp_path):
    main(
        ["eval-shield", f"--policy.path={tiny_filter}", f"--base_policy_path={tiny_diffusion}",
         "--env.type=latentsafe_dubins", "--env.variant=discrete", "--env.episode_length=6", "--n_episodes=3",
         "--seed=4", "--epsilon=0.1", f"--video={tmp_path / 'videos'}", "--n_videos=1",
         f"--figure={tmp_path / 'trajectories.png'}", f"--json={tmp_path / 'row.json'}"]
    )  # fmt: skip
    row = json.loads((tmp_path / "row.json").read_text())
    assert set(row) >= PROVENANCE and row["seeds"] == [4] and row["epsilon"] == 0.1
    for name in ("bare", "shielded"):
        assert set(row[name]) == {"success", "violation", "incompletion", "overridden_share", "mean_action_change"}
        for outcome in ("success", "violation", "incompletion"):
            assert set(row[name][outcome]) == {"k", "n", "low", "high"} and row[name][outcome]["n"] == 3
    assert len(list((tmp_path / "videos").glob("*.mp4"))) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "nothing to shield"),
        (["--n_episodes=0"], "--n_episodes is 0"),
        (["--base_policy_path=no/where/at/all"], "no checkpoint at no/where/at/all"),
        (["--env.variant=sideways", "--base_policy_path={base}"], "'sideways'"),
    ],
    ids=["no base", "no episodes", "missing base", "unknown variant"],
)
def test_bad_shieldings_are_messages(capsys, tiny_filter, tiny_diffusion, options, message):
    options = [option.format(base=tiny_diffusion) for option in options]
    base = ["eval-shield", f"--policy.path={tiny_filter}", "--env.type=latentsafe_dubins", "--env.episode_length=2"]
    assert message in fails(capsys, *base, *options)


def test_wrap_writes_one_folder(tiny_filter, tiny_diffusion, tmp_path):
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

    main(
        ["wrap", f"--policy.path={tiny_filter}", f"--base_policy_path={tiny_diffusion}", "--epsilon=0.125",
         "--mode=monitor", "--half=true", f"--output_dir={tmp_path / 'wrapped'}"]
    )  # fmt: skip
    policy = LatentSafePolicy.from_pretrained(tmp_path / "wrapped")
    assert (policy.config.epsilon, policy.config.mode, policy.base.config.type) == (0.125, "monitor", "diffusion")


def test_wrap_can_leave_out_what_draws(capsys, tiny_filter, tmp_path):
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

    main(["wrap", f"--policy.path={tiny_filter}", "--drawing=false", f"--output_dir={tmp_path / 'small'}"])
    small, whole = (LatentSafePolicy.from_pretrained(p) for p in (tmp_path / "small", tiny_filter))
    weights = small.state_dict()
    assert all(torch.equal(weights[k], v) for k, v in whole.state_dict().items() if "decoders" not in k)
    assert whole.world_model.draws and not small.world_model.draws
    of_tokens = tiny.save_franka_filter(tmp_path / "tokens", world_model=tiny.gru_config())
    options = [f"--policy.path={of_tokens}", "--drawing=false", f"--output_dir={tmp_path / 'w'}"]
    assert "the gru world model draws nothing" in fails(capsys, "wrap", *options)


def test_wrap_sets_how_much_is_remembered(capsys, tiny_filter, tmp_path):
    options = [f"--policy.path={tiny_filter}", f"--output_dir={tmp_path / 'w'}"]
    assert "--policy.memory is 1" in fails(capsys, "wrap", "--memory=1", *options) and not (tmp_path / "w").exists()
    main(["wrap", "--memory=24", *options])
    assert json.loads((tmp_path / "w" / "config.json").read_text())["memory"] == 24


def test_wrap_refuses_a_retreat_that_cannot_be_before_it_writes(capsys, tiny_filter, tmp_path):
    options = [f"--policy.path={tiny_filter}", "--retreat={down.pos: -0.1}", f"--output_dir={tmp_path / 'w'}"]
    assert "retreat moves down.pos; the actions are turn_rate.vel" in fails(capsys, "wrap", *options)
    assert not (tmp_path / "w").exists()


def test_wrap_refuses_an_unknown_mode(capsys, tiny_filter, tmp_path):
    message = fails(capsys, "wrap", f"--policy.path={tiny_filter}", "--mode=watch", f"--output_dir={tmp_path / 'w'}")
    assert "expected one of filter, monitor" in message and not (tmp_path / "w").exists()
