import importlib
import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe.cli import GROUPS, VERBS, main
from lerobot_latentsafe.cli.command_line import described, parsed, renamed
from lerobot_latentsafe.cli.evaluate import DrawFeatures
from lerobot_latentsafe.datasets.frame_cache import FrameCache
from lerobot_latentsafe.datasets.labels import read_frames
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.dubins.ground_truth import exact_value
from lerobot_latentsafe.labeling.store import LabelStore
from lerobot_latentsafe.runtime import locations

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
    for verb, entry in VERBS.items():
        assert verb in text and entry.what in text
    for group, title in GROUPS.items():
        assert f"{group}: {title}" in text


def test_help_lists_each_verb_under_its_group(capsys):
    main(["--help"])
    text = capsys.readouterr().out
    starts = [text.index(f"\n{group}: ") for group in GROUPS]
    parts = dict(zip(GROUPS, (text[a:b] for a, b in zip(starts, [*starts[1:], len(text)]))))
    assert starts == sorted(starts)
    for verb, entry in VERBS.items():
        assert f"\n  {verb} " in parts[entry.group]


@pytest.mark.parametrize("argv", [["{verb}", "--help"], ["help", "{verb}"], ["{verb}", "--seed=1", "-h"]])
@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_says_what_it_is_for_then_an_example_then_its_options(capsys, verb, argv):
    main([word.format(verb=verb) for word in argv])
    purpose, example, *rest = capsys.readouterr().out.split("\n\n")
    assert purpose[0].isupper() and len(purpose.splitlines()) <= 2 and purpose.endswith(".")
    assert example.startswith(f"    latentsafe {verb} --")
    assert "\n  --" in rest[-1]


@pytest.mark.parametrize("verb", VERBS)
def test_the_example_of_every_verb_has_options_that_it_knows(capsys, verb, monkeypatch):
    entry = VERBS[verb]
    options = getattr(importlib.import_module(entry.module), entry.name)
    monkeypatch.setattr(options, "run", lambda self: print("read"))
    monkeypatch.chdir(Path(__file__).parents[1])  # an example may name a file of configs/
    main([verb, "--help"])
    example = capsys.readouterr().out.split("\n\n")[1]
    main(shlex.split(example.replace("\\\n", ""))[1:])
    assert capsys.readouterr().out == "read\n"


def test_help_shows_the_options_of_what_was_chosen(capsys):
    main(["eval-shield", "--help"])
    assert "\n  --env.episode_length=" not in capsys.readouterr().out
    main(["eval-shield", "--env.type=latentsafe_dubins", "--help"])
    assert "\n  --env.episode_length=<int>" in capsys.readouterr().out


def test_unknown_verb_lists_the_known_ones(capsys):
    message = fails(capsys, "fly")
    assert "unknown verb 'fly'" in message and "eval-shield" in message


ON_THE_CAR = ["eval-shield", "--env.type=latentsafe_dubins"]
SHIELDED = ["teleoperate", "--robot.type=latentsafe_shielded"]


@pytest.mark.parametrize(
    ("argv", "meant"),
    [
        (["eval-sheild"], "did you mean eval-shield?"),
        (["trainreachability"], "did you mean train-reachability?"),
        ([*ON_THE_CAR, "--law.epsilom=0.1"], "did you mean --law.epsilon?"),
        ([*ON_THE_CAR, "--gaurd=2"], "did you mean --law.proposal_steps?"),
        (
            ["eval-shield", "--env.type=latentsafe_dubins", "--env.episode_lenght=5"],
            "did you mean --env.episode_length?",
        ),
        (["eval-shield", "--env.type=latentsafe_dubin"], "did you mean latentsafe_dubins?"),
        (["eval-shield", "--env=latentsafe_dubins"], "did you mean --env.type?"),
        (["cache", "--repo_id=me/car", "--output_dir=x"], "did you mean --dataset.repo_id?"),
        (["wrap", "--policy.pth=dubins", "--output_dir=x"], "did you mean --policy.path?"),
        (
            [*SHIELDED, "--robot.law.epsilo=1"],
            "did you mean --robot.law.epsilon?",
        ),
    ],
)
def test_the_nearest_verb_or_option_is_suggested_in_one_line(capsys, argv, meant):
    message = fails(capsys, *argv)
    assert meant in message and len(message.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["path", "bag"], "unexpected 'bag'; options are given as --name=value"),
        (["path", "--name"], "--name has no value"),
        (["path", "--zzzz=1"], "unknown option --zzzz; latentsafe path --help lists all"),
        (["wrap", "--law.retreat={a"], "--law.retreat is '{a', which is not YAML"),
        (["wrap", "--law.epsilon=0.1"], "give --policy.path, --output_dir"),
        (["wrap", "--policy.path=x", "--output_dir=y", "--law.epsilon=much"], "--law.epsilon: Couldn't parse 'much'"),
        (["wrap", "--policy.path=x", "--output_dir=y", "--half=maybe"], "--half: Couldn't parse"),
        (["eval-shield", "--env.type=latentsafe_dubins", "--env.fps=fast"], "--env.fps: Couldn't parse 'fast'"),
        (["record", "--robot.type=latentsafe_shielded", "--robot.filter=x"], "no robot to shield"),
        (["cache", "--output_dir=x", "--dataset.episodes=three"], "--dataset.episodes: "),
    ],
)
def test_what_is_not_understood_is_one_line(capsys, argv, words):
    message = fails(capsys, *argv)
    assert words in message and len(message.strip().splitlines()) == 1


def test_values_may_stand_apart(capsys):
    main(["path", "--name", "dubins"])
    assert capsys.readouterr().out.strip().endswith("dubins")


@pytest.mark.parametrize(
    ("verb", "old", "new"),
    [
        ("collect", "--repo_id=me/x", "dataset.repo_id"),
        ("collect", "--root=x", "dataset.root"),
        ("collect", "--n_episodes=3", "dataset.num_episodes"),
        ("wrap", "--epsilon=0.5", "law.epsilon"),
        ("wrap", "--release=0.5", "law.resume_above"),
        ("wrap", "--guard=2", "law.proposal_steps"),
        ("wrap", "--retreat={up.pos: 1.0}", "law.retreat"),
        ("wrap", "--patience=2", "law.retreat_after"),
        ("wrap", "--dwell=2", "law.min_retreat_steps"),
        ("wrap", "--memory=24", "law.history_frames"),
        ("wrap", "--mode=monitor", "law.mode"),
        ("eval-shield", "--law=plan", "law.name"),
        ("report", "--law=margin", "law.name"),
        ("train-dreamer", "--model.margin_layers=3", "model.margin.layers"),
        ("train-dreamer", "--model.lookahead=0", "model.law.lookahead"),
        ("record", "--robot.epsilon=0.5", "robot.law.epsilon"),
    ],
)
def test_old_options_are_understood_with_a_warning(caplog, verb, old, new):
    chosen = {"record": ("robot.type", "latentsafe_shielded"), "train-dreamer": ("model.type", "latentsafe")}.get(verb)
    given = [chosen] if chosen else []
    name, _, value = old.removeprefix("--").partition("=")
    assert renamed(described(verb, dict(given)), [*given, (name, value)])[-1] == (new, value)
    assert f"--{name} is now --{new}" in caplog.text


def test_a_law_may_be_given_as_a_whole_or_by_its_old_name():
    for law in ("--law=plan", "--law.name=plan", "--law={name: plan}"):
        parsed_law = parsed("wrap", ["--policy.path=x", "--output_dir=y", law]).law
        assert parsed_law == LawOptions(name="plan")


def test_an_option_of_another_robot_is_not_renamed():
    """The old `--robot.mode` of a shielded robot; a robot may have an option of that name."""
    given = [("robot.type", "latentsafe_franka"), ("robot.monitor", "true")]
    assert renamed(described("record", dict(given)), given) == given


def test_picture_features_is_now_draw_features(monkeypatch, caplog):
    monkeypatch.setattr(DrawFeatures, "run", lambda self: print(self.step))
    main(["picture-features", "--step=3"])
    assert "latentsafe picture-features is now latentsafe draw-features" in caplog.text


def test_path_prints_a_committed_checkpoint(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(locations, "PRETRAINED", tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "config.json").write_text("{}")
    main(["path", "--name=mine"])
    assert capsys.readouterr().out.strip() == str(tmp_path / "mine")
    assert "one of mine" in fails(capsys, "path", "--name=yours")


def test_collect_and_cache(capsys, tmp_path):
    root, cache = tmp_path / "car", tmp_path / "car_cache"
    new = ["--dataset.repo_id=me/car", f"--dataset.root={root}", "--dataset.num_episodes=2"]
    main(["collect", "--source=random", *new, "--seed=3"])
    main(["cache", "--dataset.repo_id=me/car", f"--dataset.root={root}", f"--output_dir={cache}", "--image_size=16"])
    printed = capsys.readouterr().out
    assert "2 episodes" in printed and f"--dataset.root={cache}" in printed
    assert json.loads((cache / "frame_cache" / "manifest.json").read_text())["image_size"] == 16


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--source=brave", "--dataset.repo_id=me/x", "--dataset.root=new"], "--source is 'brave'"),
        (["--source=random", "--dataset.repo_id=me/x", "--dataset.root=."], "choose another --dataset.root"),
        (["--source=random", "--dataset.repo_id=me/x", "--dataset.num_episodes=many"], "--dataset.num_episodes"),
        (["--source=random"], "--dataset.repo_id"),
        (["--source=random", "--dataset.repo_id=me/x", "--colour=red"], "--colour"),
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
         "--seed=4", "--law.epsilon=0.1", f"--video={tmp_path / 'videos'}", "--n_videos=1",
         f"--figure={tmp_path / 'trajectories.png'}", f"--json={tmp_path / 'row.json'}"]
    )  # fmt: skip
    row = json.loads((tmp_path / "row.json").read_text())
    assert set(row) >= PROVENANCE and row["seeds"] == [4] and row["epsilon"] == 0.1
    assert (row["guard"], row["release"], row["law"]) == (1, -1.0, "reachability")
    for name in ("bare", "shielded"):
        assert set(row[name]) == {
            "success",
            "violation",
            "stall",
            "incompletion",
            "overridden_share",
            "mean_action_change",
        }
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
        ["wrap", f"--policy.path={tiny_filter}", f"--base_policy_path={tiny_diffusion}", "--law.epsilon=0.125",
         "--law.mode=monitor", "--half=true", f"--output_dir={tmp_path / 'wrapped'}"]
    )  # fmt: skip
    policy = LatentSafePolicy.from_pretrained(tmp_path / "wrapped")
    assert (policy.config.law.epsilon, policy.config.law.mode, policy.base.config.type) == (
        0.125,
        "monitor",
        "diffusion",
    )


def test_wrap_can_leave_out_what_draws(capsys, tiny_filter, tmp_path):
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

    main(["wrap", f"--policy.path={tiny_filter}", "--drawing=false", f"--output_dir={tmp_path / 'small'}"])
    small, whole = (LatentSafePolicy.from_pretrained(p) for p in (tmp_path / "small", tiny_filter))
    weights = small.state_dict()
    assert all(torch.equal(weights[k], v) for k, v in whole.state_dict().items() if "decoders" not in k)
    assert whole.model.world_model.draws and not small.model.world_model.draws
    of_tokens = tiny.save_franka_filter(tmp_path / "tokens", world_model=tiny.gru_config())
    options = [f"--policy.path={of_tokens}", "--drawing=false", f"--output_dir={tmp_path / 'w'}"]
    assert "the gru world model draws nothing" in fails(capsys, "wrap", *options)


def test_wrap_sets_how_much_is_remembered(capsys, tiny_filter, tmp_path):
    options = [f"--policy.path={tiny_filter}", f"--output_dir={tmp_path / 'w'}"]
    said = fails(capsys, "wrap", "--law.history_frames=1", *options)
    assert "--policy.law.history_frames is 1" in said and not (tmp_path / "w").exists()
    main(["wrap", "--law.history_frames=24", *options])
    assert json.loads((tmp_path / "w" / "config.json").read_text())["law"]["history_frames"] == 24


def test_wrap_refuses_a_retreat_that_cannot_be_before_it_writes(capsys, tiny_filter, tmp_path):
    options = [f"--policy.path={tiny_filter}", "--law.retreat={down.pos: -0.1}", f"--output_dir={tmp_path / 'w'}"]
    assert "retreat moves down.pos; the actions are turn_rate.vel" in fails(capsys, "wrap", *options)
    assert not (tmp_path / "w").exists()


def test_wrap_refuses_an_unknown_mode(capsys, tiny_filter, tmp_path):
    message = fails(
        capsys, "wrap", f"--policy.path={tiny_filter}", "--law.mode=watch", f"--output_dir={tmp_path / 'w'}"
    )
    assert "expected one of filter, monitor" in message and not (tmp_path / "w").exists()


# -- some episodes of a dataset ---


@pytest.fixture(scope="module")
def some(dataset_root, tmp_path_factory):
    """A cache of five episodes of fourteen, as `latentsafe cache` makes it of a dataset with a label file."""
    root = shutil.copytree(dataset_root, tmp_path_factory.mktemp("some") / "car")
    store = LabelStore(root, tiny.REPO_ID, ["spilled"])
    for episode in range(len(store)):
        store.label("spilled", episode, episode % 3, "me")
    store.close()
    options = [f"--dataset.repo_id={tiny.REPO_ID}", f"--dataset.root={root}", f"--output_dir={root.parent / 'cache'}"]
    main(["cache", *options, "--dataset.episodes=[9,2,3,11,5]"])
    return root.parent / "cache"


def test_a_cache_of_some_episodes_holds_what_the_whole_one_does(some, cache_root):
    names = ["next.done", "failure", "action"]
    whole, part = (read_frames(root, names) for root in (cache_root, some))
    kept = [2, 3, 5, 9, 11]
    rows = np.isin(whole["episode_index"], kept)
    assert np.array_equal(part["episode_index"], np.searchsorted(kept, whole["episode_index"][rows]))
    assert all(np.array_equal(part[name], whole[name][rows]) for name in names)
    caches = [FrameCache.open(root, tiny.metadata(root, f"{tiny.REPO_ID}_cache")) for root in (cache_root, some)]
    for name in ("state", "action"):
        assert np.array_equal(getattr(caches[1], name), getattr(caches[0], name)[rows])
    for name, pictures in caches[0].percepts.items():
        assert np.array_equal(caches[1].percepts[name], pictures[rows])


def test_label_files_go_with_the_episodes(some):
    store = LabelStore(some, f"{tiny.REPO_ID}_cache", [])
    assert [store.verdict("spilled", i).first for i in range(5)] == [e % 3 for e in (2, 3, 5, 9, 11)]
    store.close()


def test_a_cache_of_other_episodes_is_not_gone_on_with(some, dataset_root, tmp_path, capsys):
    unfinished = shutil.copytree(some, tmp_path / "cache")
    (unfinished / "frame_cache" / "manifest.json").unlink()
    options = [f"--dataset.repo_id={tiny.REPO_ID}", f"--dataset.root={dataset_root}", f"--output_dir={unfinished}"]
    assert "unfinished cache of another choice of episodes" in fails(
        capsys, "cache", *options, "--dataset.episodes=[1,2]"
    )
    main(["cache", *options, "--dataset.episodes=[2,3,5,9,11]"])
    assert (unfinished / "frame_cache" / "manifest.json").exists()


def test_a_filter_can_be_trained_on_a_cache_of_some_episodes(some, tiny_world_model, tmp_path):
    options = [f"--dataset.repo_id={tiny.REPO_ID}_cache", f"--dataset.root={some}", f"--output_dir={tmp_path / 'f'}"]
    main(["train-reachability", f"--policy.path={tiny_world_model}", *options, "--steps=3"])
    assert (tmp_path / "f" / "model.safetensors").exists()


@pytest.mark.parametrize("verb", ["calibrate", "eval-world-model"])
def test_held_out_episodes_may_be_named(tiny_filter, cache_root, tmp_path, monkeypatch, verb):
    asked = []

    def note(model, reader, episodes, *_, **__):
        asked.append(episodes.tolist())
        raise ValueError("enough")

    monkeypatch.setattr("lerobot_latentsafe.cli.train.decision_values", note)
    monkeypatch.setattr("lerobot_latentsafe.cli.train.refuse_trained_on", lambda *_: True)
    monkeypatch.setattr("lerobot_latentsafe.cli.evaluate.evaluate_world_model", note)
    options = [f"--policy.path={tiny_filter}", f"--dataset.root={cache_root}", f"--dataset.repo_id={tiny.REPO_ID}"]
    options += [f"--output_dir={tmp_path / 'out'}"] if verb == "calibrate" else []
    for more in (["--dataset.episodes=[4,1]"], ["--n_episodes=3"]):
        with pytest.raises(SystemExit, match="enough"):
            main([verb, *options, *more])
    assert asked == [[1, 4], [11, 12, 13]]


def test_only_the_named_episodes_are_labelled_and_checked(capsys, tiny_filter, dataset_root, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = shutil.copytree(dataset_root, tmp_path / "car")
    (tmp_path / "mine_to_label.py").write_text("def never(episode):\n    return episode.length\n")
    options = [f"--dataset.repo_id={tiny.REPO_ID}", f"--dataset.root={root}", "--dataset.episodes=[0,12]"]
    main(["auto-label", *options, "--labeller=mine_to_label:never", "--specification=spilled"])
    store = LabelStore(root, tiny.REPO_ID, ["spilled"])
    assert [e for e in range(len(store)) if store.verdict("spilled", e).first is not None] == [0, 12]
    store.close()
    asked = []
    monkeypatch.setattr(
        "lerobot_latentsafe.cli.label.find_disagreements", lambda _, __, margins: asked.append(list(margins)) or []
    )
    main(["check-labels", f"--policy.path={tiny_filter}", *options])
    assert asked == [[0, 12]]


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["train-margin", "--policy.path=x", "--output_dir=y"], "cache those episodes"),
        (["train-reachability", "--policy.path=x", "--output_dir=y"], "cache those episodes"),
        (["label"], "the page shows all episodes"),
        (["write-labels", "--output_dir=y", "--new_repo_id=z"], "lerobot-edit-dataset"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_verbs_that_read_whole_datasets_refuse_episodes(capsys, argv, words):
    message = fails(capsys, *argv, "--dataset.episodes=[0,1]")
    assert "--dataset.episodes: " in message and words in message


@pytest.mark.parametrize("episodes", ["[3,14]", "[-1]", "[]"])
def test_episodes_that_are_not_there_are_named(capsys, cache_root, dataset_root, tiny_filter, tmp_path, episodes):
    source = [f"--dataset.repo_id={tiny.REPO_ID}", f"--dataset.episodes={episodes}"]
    said = fails(capsys, "cache", *source, f"--dataset.root={dataset_root}", f"--output_dir={tmp_path / 'new'}")
    assert "which are 0 to 13" in said and not (tmp_path / "new").exists()
    evaluated = ["eval-world-model", f"--policy.path={tiny_filter}", f"--dataset.root={cache_root}"]
    assert "which are 0 to 13" in fails(capsys, *evaluated, *source)
    assert "which are 0 to 13" in fails(capsys, "check-labels", *source, f"--dataset.root={dataset_root}")
