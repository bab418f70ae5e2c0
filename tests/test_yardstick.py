"""The yardstick for world models, held to futures whose scores are known."""

import json
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe.cli.evaluate import EvalWorldModel
from lerobot_latentsafe.cli.options import DatasetSource
from lerobot_latentsafe.cli.places import OptionalPolicySource
from lerobot_latentsafe.datasets.frame_cache import FrameCacheError
from lerobot_latentsafe.encoders.perception import FrameBasis
from lerobot_latentsafe.evaluation import token_space, yardstick
from lerobot_latentsafe.evaluation.token_space import ALL, SPACES, Copy, Imagination, Mean, Moment, TokenSpace, moments
from lerobot_latentsafe.evaluation.yardstick import (
    Branches,
    branches_of,
    compare_world_models,
    counterfactual_r2,
    loaded,
    missed_failures,
    prediction_errors,
    summarised,
)

KINDS = {
    "gru": tiny.gru_config,
    "dino_wm": tiny.dino_wm_config,
    "blind gru": lambda: tiny.gru_config(blind=True),
    "blind dino_wm": lambda: tiny.dino_wm_config(blind=True),
    "rssm": tiny.rssm_config,
}
TELL_TOKENS = ("gru", "dino_wm")


SHORT = [Moment(name, ticks) for (name, _), ticks in zip(moments(15), (1, 2, 3, 4, 5, 10))]
"""The car's episodes are short."""


@pytest.fixture(scope="module", autouse=True)
def short():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(token_space, "moments", lambda fps: SHORT)
        patch.setattr(yardstick, "moments", lambda fps: SHORT)
        yield


@pytest.fixture(scope="module")
def meta(token_root):
    return tiny.metadata(token_root, f"{tiny.REPO_ID}_cache")


@pytest.fixture(scope="module")
def space(meta):
    return TokenSpace(meta)


@pytest.fixture(scope="module")
def long(meta):
    """Episodes that last longer than is compared, four that follow each other."""
    length = np.array([row["length"] for row in meta.episodes])
    episodes = np.flatnonzero(length > SHORT[-1].ticks + 8)
    assert len(episodes) >= 4
    return episodes


@pytest.fixture(scope="module")
def filters(meta, cache_meta, tmp_path_factory):
    """Folders of a little trained filter of each kind."""
    folder = tmp_path_factory.mktemp("filters")
    return {
        name: str(
            tiny.train_stage_one(
                cache_meta if name == "rssm" else meta, folder / name, 2, world_model=kind(),
                fallback_action_candidates=None,
            )
        )
        for name, kind in KINDS.items()
    }  # fmt: skip


@pytest.fixture(scope="module")
def models(filters, space, meta, cache_meta):
    return {name: loaded(path, space, meta, cache_meta) for name, path in filters.items()}


@pytest.fixture
def branches(meta, long):
    """As if the first four long episodes started from two states."""
    first = np.array([meta.episodes[int(e)]["dataset_from_index"] for e in long[:4]])
    return Branches(first[[0, 0, 2, 2]], first, np.array([0, 0, 1, 1]))


def windows(meta, long):
    return np.array([meta.episodes[int(e)]["dataset_from_index"] + 4 for e in long])


def truth(space):
    """Foretells what was recorded after `follow`, wherever it starts."""
    return lambda start, follow, observed: ((m, space.recorded(follow + m.ticks)) for m in SHORT)


def generator():
    return torch.Generator().manual_seed(0)


def of_all(scores):
    """Of all cameras: (space, moment) -> what is told."""
    return {(s, moment): views[ALL] for s, told in scores.items() for moment, views in told.items()}


@pytest.mark.parametrize("name", KINDS)
def test_the_tokens_of_what_was_seen_are_those_recorded_as_far_as_a_model_knows_them(models, space, name):
    model, reader = models[name]
    latent = Imagination(model, reader, space)._seen(np.array([0, 5]), 1)
    tokens, recorded = space.imagined(model, latent), space.recorded(np.array([0, 5]))
    assert (model.world_model.tokens_of(latent) is None) == (name not in TELL_TOKENS)
    if name.startswith("blind"):
        assert tokens is None
    elif name == "rssm":  # what it draws, seen by the encoder
        assert tokens.shape == recorded.shape
    else:
        torch.testing.assert_close(space.basis(tokens), space.basis(recorded), rtol=0, atol=0.02)
        assert (name == "gru") != torch.allclose(tokens, recorded)


def test_what_a_camera_shows_adds_up():
    n_cameras, n_patches, dim, k = 2, 3, 4, 5
    basis = FrameBasis(n_patches * n_cameras * dim, k)
    basis.axes.normal_()
    basis.fitted.fill_(True)
    difference = torch.randn(6, n_patches, n_cameras * dim)
    views = TokenSpace.views(SimpleNamespace(cameras=["front", "wrist"], basis=basis), difference)
    components, tokens = (views[s] for s in SPACES)
    torch.testing.assert_close(components[ALL], basis(difference))
    torch.testing.assert_close(components["front"] + components["wrist"], components[ALL])
    torch.testing.assert_close(tokens["front"], difference[..., :dim].flatten(1))
    assert tokens["front"].square().sum() + tokens["wrist"].square().sum() == pytest.approx(
        float(tokens[ALL].square().sum()), rel=1e-5
    )


def test_the_truth_has_no_error_and_foretells_all_differences(space, meta, long, branches):
    errors = of_all(prediction_errors(truth(space), space, windows(meta, long), generator()))
    assert all(told["true"] == 0 < told["shuffled"] for told in errors.values())
    assert all(r2 == 1 for r2 in of_all(counterfactual_r2(truth(space), space, branches)).values())


@pytest.mark.parametrize("who", ["copy", "mean", "deaf gru", "deaf dino_wm"])
def test_who_does_not_hear_the_action_is_found_out(models, space, meta, long, branches, who):
    deaf = {f"deaf {name}": Imagination(*models[name], space, deaf=True) for name in TELL_TOKENS}
    futures = ({"copy": Copy(space), "mean": Mean(space)} | deaf)[who]
    errors = of_all(prediction_errors(futures, space, windows(meta, long), generator()))
    assert all(told["shuffled / true"] == 1 for told in errors.values())
    assert all(abs(r2) < 1e-5 for r2 in of_all(counterfactual_r2(futures, space, branches)).values())


def test_r2_is_that_of_all_pairs_of_branches(space, branches):
    guess = lambda start, follow, observed: (  # noqa: E731
        (m, space.recorded(follow + m.ticks) + torch.randn(len(follow), 1, 1, generator=generator())) for m in SHORT
    )
    told = of_all(counterfactual_r2(guess, space, branches))
    for moment, tokens in guess(branches.start, branches.follow, 1):
        recorded = space.recorded(branches.follow + moment.ticks)
        wrong = total = 0.0
        for i, j in combinations(range(4), 2):
            if branches.group[i] == branches.group[j]:
                true = space.basis(recorded[i]) - space.basis(recorded[j])
                wrong += float((space.basis(tokens[i]) - space.basis(tokens[j]) - true).square().sum())
                total += float(true.square().sum())
        assert told[SPACES[0], moment.name] == pytest.approx(1 - wrong / total, rel=1e-3)


def test_steps_that_skip_frames_tell_nothing_in_between(models, space, monkeypatch):
    config = models["gru"][0].config
    assert [token_space.steps_of(config, moment.ticks) for moment in moments(15)] == [5, 6, 10, 12, 15, 30]
    monkeypatch.setattr(token_space, "ticks_a_step", lambda config: 3)
    assert [token_space.steps_of(config, moment.ticks) for moment in moments(15)] == [None, 2, None, 4, 5, 10]
    told = yardstick._by_space({"0.4 s": {s: {ALL: 1.0} for s in SPACES}}, space)
    assert told[SPACES[0]]["0.4 s"] == {ALL: 1.0} and told[SPACES[0]]["0.33 s"] is None
    assert summarised({"errors": None, "counterfactual": None, "verdicts": None, "seen": None})["tells_apart"] is None


def test_small_failures_are_counted_by_themselves(models, long):
    model, reader = models["gru"]
    episodes, failing = np.unique(reader.labels.episode), reader.labels.failure == 1
    few = failing & (np.arange(len(failing)) % 2 == 0)
    alarm = model.margin.net[-1]
    with torch.no_grad():
        alarm.weight.zero_()
        alarm.bias.fill_(1.0)
    told = missed_failures(model, reader, episodes, few)
    assert (told["missed"]["k"], told["missed"]["n"]) == (failing.sum(), failing.sum())
    assert (told["few_missed"]["k"], told["few_missed"]["n"]) == (few.sum(), few.sum())
    assert told["false_alarms"]["k"] == 0 and missed_failures(model, reader, episodes, None)["few_missed"] is None
    safe = np.array([e for e in episodes if not failing[reader.labels.episode == e].any()])
    assert missed_failures(model, reader, safe, None)["missed"] is None


@pytest.fixture
def told(filters, meta, cache_meta, long):
    return compare_world_models(filters, meta, long, pictures=cache_meta, n_windows=16)


def test_all_kinds_stand_side_by_side_and_controls_beside_them(told, tmp_path):
    assert list(told) == [*KINDS, "gru, deaf", "copy of the last frame", "mean of the data"]
    for name, row in told.items():
        blind = name.startswith("blind")
        assert (row["errors"] is None) == blind and row["counterfactual"] is None
        assert blind or all(np.isfinite(views["true"]) for views in of_all(row["errors"]).values())
        assert row["world_model"] == (name.split()[-1] if name in KINDS else None)
        assert (row["verdicts"] is None) == (name not in KINDS and name != "gru, deaf")
    assert told["gru, deaf"]["verdicts"]["verdicts"] == told["gru"]["verdicts"]["still"]


def test_the_same_seed_gives_the_same_numbers(filters, meta, long):
    rows = [compare_world_models({"gru": filters["gru"]}, meta, long, n_windows=16) for _ in range(2)]
    assert json.dumps(rows[0]) == json.dumps(rows[1])


def test_the_verb_compares_several(filters, meta, long, tmp_path, capsys):
    source = DatasetSource(meta.repo_id, str(meta.root), long.tolist())
    policies = {name: filters[name] for name in TELL_TOKENS}
    EvalWorldModel(policies=policies, dataset=source, json=tmp_path / "out.json").run()
    written = json.loads((tmp_path / "out.json").read_text())
    assert set(written["summary"]) == set(written["models"]) > {"gru", "dino_wm"} and "commit" in written
    hears = written["summary"]["gru"]["hears"]["all tokens"]
    assert hears["2 s"] == written["models"]["gru"]["errors"]["all tokens"]["2 s"][ALL]["shuffled / true"]
    assert "dino_wm" in capsys.readouterr().out


@pytest.mark.parametrize("given", [{}, {"policies": {}}, {"policies": {"a": "b"}, "policy": OptionalPolicySource("c")}])
def test_one_model_or_several(given):
    with pytest.raises(ValueError, match="give one checkpoint, or several"):
        EvalWorldModel(**given)


def test_what_cannot_be_compared_is_refused(filters, meta, cache_meta, long, space, tmp_path):
    rssm = {"rssm": filters["rssm"]}
    with pytest.raises(ValueError, match=r"reads pictures.*--image_size=32.*--pictures"):
        compare_world_models(rssm, meta, long)
    with pytest.raises(FrameCacheError, match="an encoder's tokens"):
        compare_world_models(rssm, cache_meta, long)
    other = tiny.altered_dataset(cache_meta.root, tmp_path / "other", action_names=["a", "b"])
    with pytest.raises(ValueError, match=r"another|trained"):
        compare_world_models(rssm, meta, long, pictures=other)
    with pytest.raises(ValueError, match=r"start from states that differ.*number of branches"):
        compare_world_models({"gru": filters["gru"]}, meta, np.arange(meta.total_episodes), branches=5)
    with pytest.raises(ValueError, match=r"no two of the 1 episodes"):
        branches_of(space, meta, long[:1], 5)


def test_short_episodes_are_named(filters, meta, long, monkeypatch):
    monkeypatch.setattr(yardstick, "moments", lambda fps: [Moment("100 s", 100 * fps)])
    with pytest.raises(ValueError, match=r"no episode of me/car_cache has more than 2003 frames.*100.0 s ahead"):
        compare_world_models({"gru": filters["gru"]}, meta, long)
