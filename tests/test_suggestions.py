import multiprocessing
import os
import shutil
import signal
from queue import Queue
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tiny
import torch

from lerobot_latentsafe.cli import main
from lerobot_latentsafe.datasets import contract
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.reading import DatasetContractError
from lerobot_latentsafe.evaluation import along_episodes
from lerobot_latentsafe.evaluation.along_episodes import episode_margins
from lerobot_latentsafe.labeling import suggestions
from lerobot_latentsafe.labeling.disagreements import find_disagreements
from lerobot_latentsafe.labeling.store import LabelStore
from lerobot_latentsafe.labeling.suggestions import Suggester, Suggestion, best_split, contradiction

PATIENCE_S = 1200
"""For a process that yields to all others."""


@pytest.fixture
def root(dataset_root, tmp_path):
    return shutil.copytree(dataset_root, tmp_path / "car")


@pytest.mark.parametrize(
    ("margin", "first"),
    [([1, 1, -1, -1], 2), ([1, 1, 1], 3), ([-1, -1], 0), ([1, -0.1, 1, -1, -1, 0.1, -1], 3), ([0.0, 0.0], 2)],
)
def test_guess_is_the_split_that_fits_best(margin, first):
    assert best_split(np.array(margin, float)) == first


def test_doubtful_failures_teach_most_and_surely_safe_episodes_nothing():
    safe, failing = Suggestion.of(np.ones(40)), Suggestion.of(np.r_[np.ones(20), -np.ones(20)])
    border = Suggestion.of(np.r_[np.ones(20), 0.1 * np.ones(5), np.ones(20)])
    doubtful = Suggestion.of(np.r_[np.ones(20), -0.5 * np.ones(5), np.ones(20)])
    assert safe.usefulness == 0.0 < border.usefulness < failing.usefulness < doubtful.usefulness == 1.0
    assert 0 <= Suggestion.of(np.array([0.3])).usefulness <= 1  # shorter than what is judged


def test_contradiction_counts_labelled_frames_only():
    margin = np.r_[np.ones(10), -np.ones(10)]
    failure = np.r_[np.zeros(10), np.ones(10)].astype(int)
    assert contradiction(margin, failure) == 0.0
    assert contradiction(margin, 1 - failure) == 1.0
    assert contradiction(margin, np.full(20, -1)) == 0.0
    failure[3:8] = -1
    assert contradiction(-margin, np.where(failure < 0, -1, 1 - failure)) == 0.0


def test_margins_are_those_of_filtering_frame_by_frame(policy, dataset_meta, cache_root, cache_meta):
    from lerobot_latentsafe.modeling_latentsafe import adopt

    found = dict(episode_margins(policy.model, DatasetFrames(dataset_meta), batch_size=5))
    assert sorted(found) == list(range(14))
    reader, episode = adopt(policy.config, cache_meta), 3
    index = np.flatnonzero(reader.labels.episode == episode)
    images, state = reader.cache.frames(index)
    action = policy.model.units.normalise_action(torch.from_numpy(reader.cache.action[index]))
    latent, margin = None, []
    with torch.no_grad():
        for t in range(len(index)):
            frame = {k: v[t : t + 1] for k, v in images.items()}
            before = action[t - 1 : t] if t else None
            latent = policy.model.world_model.observe(
                latent, before, frame, policy.model.units.normalise_state(state[t : t + 1])
            )
            margin.append(policy.model.margin.bounded(policy.model.world_model.features(latent)).item())
    np.testing.assert_allclose(found[episode], margin, atol=1e-4)


def test_a_process_of_its_own_judges_all_episodes(root, tiny_filter):
    told = Queue()
    suggester = Suggester(str(tiny_filter), tiny.REPO_ID, root, told.put)
    new = [told.get(timeout=PATIENCE_S) for _ in range(13)]
    suggester.close()
    assert sorted(suggester.known) == list(range(14)) and sorted(new) == list(range(1, 14))


def broken_state(root, policy, monkeypatch):
    file = next((root / "data").glob("*/*.parquet"))
    table = pq.read_table(file)
    states = np.stack(table["observation.state"].to_numpy())
    states[np.flatnonzero(np.asarray(table["episode_index"]) == 4)[2]] = np.nan
    place = table.schema.get_field_index("observation.state")
    column = pa.array(list(states), table.schema.field(place).type)
    pq.write_table(table.set_column(place, table.schema.field(place), column), file)


def broken_pictures(root, policy, monkeypatch):
    inputs = along_episodes._model_inputs

    def read(model, frames, episode):
        if episode == 4:
            raise OSError("a picture is cut")
        return inputs(model, frames, episode)

    monkeypatch.setattr(along_episodes, "_model_inputs", read)


def broken_margin(root, policy, monkeypatch):
    imagination = type(policy.model.imagination)
    margin = imagination.margin

    def absurd(self, latents):
        found = margin(self, latents)
        found[4, 2] = torch.nan
        return found

    monkeypatch.setattr(imagination, "margin", absurd)


@pytest.mark.parametrize(
    ("break_it", "why"),
    [(broken_state, "is nan in frame 2 of episode 4"), (broken_pictures, "OSError: a picture is cut"),
     (broken_margin, "the filter's margin is nan in frame 2")],
)  # fmt: skip
@pytest.mark.fault("M39", "a filter cannot judge one episode", "That episode says why; the page shows all others")
def test_an_episode_that_cannot_be_judged_says_why_and_the_others_are_judged(
    root, policy, dataset_meta, break_it, why, monkeypatch
):
    sound = dict(episode_margins(policy.model, DatasetFrames(dataset_meta)))
    break_it(root, policy, monkeypatch)
    found = dict(episode_margins(policy.model, DatasetFrames(tiny.metadata(root))))
    assert list(found) == list(range(14)) and why in found.pop(4)
    for episode, margin in found.items():
        np.testing.assert_allclose(margin, sound[episode], atol=1e-4)


def test_a_dataset_without_a_sound_episode_is_refused(root, policy, monkeypatch):
    monkeypatch.setattr(contract.np, "isfinite", lambda values: np.zeros(values.shape, bool))
    with pytest.raises(DatasetContractError, match=r"not finite in .* Make a copy without those episodes"):
        next(episode_margins(policy.model, DatasetFrames(tiny.metadata(root))))


def killed(path, repo_id, root, sender):
    os.kill(os.getpid(), signal.SIGKILL)


def killed_later(path, repo_id, root, sender):
    sender.send((0, np.ones(5)))
    sender.send((1, "its state is nan"))
    killed(path, repo_id, root, sender)


def fails_later(path, repo_id, root, sender):
    sender.send((0, np.ones(5)))
    sender.send((1, "its state is nan"))
    sender.send("the disk is gone")


@pytest.fixture
def forked(monkeypatch):
    """The other process begins as a copy of this one, which knows what it was made to be."""
    if not hasattr(os, "fork"):
        pytest.skip("needs fork")
    fork = multiprocessing.get_context("fork")
    monkeypatch.setattr(multiprocessing, "get_context", lambda kind: fork)
    return lambda judge: monkeypatch.setattr(suggestions, "_judge", judge)


@pytest.mark.fault("L17", "the process that suggests labels is killed", "A message, with the remedy")
def test_a_process_that_is_killed_before_its_first_answer_is_a_message(root, forked):
    forked(killed)
    with pytest.raises(
        RuntimeError, match=r"no suggestions from x: the process .* was killed \(SIGKILL\).*--policy.path"
    ):
        Suggester("x", tiny.REPO_ID, root, print)


@pytest.mark.parametrize(("end", "why"), [(killed_later, "was killed (SIGKILL)"), (fails_later, "the disk is gone")])
def test_a_process_that_ends_later_keeps_what_it_said_and_tells_why_there_is_no_more(root, forked, end, why, caplog):
    forked(end)
    told = Queue()
    suggester = Suggester("x", tiny.REPO_ID, root, told.put)
    assert told.get(timeout=PATIENCE_S) == 1
    suggester.listener.join(PATIENCE_S)
    assert suggester.known[0].guess == 5 and suggester.why_silent(0) is None
    assert suggester.why_silent(1) == "its state is nan" and why in suggester.why_silent(2) and why in caplog.text


@pytest.mark.parametrize(
    ("path", "why"),
    [("no/such/filter", "no checkpoint"), ("dubins_diffusion_reckless", "expected a 'latentsafe' filter")],
)
def test_filter_that_cannot_judge_says_why(root, monkeypatch, path, why):
    said = []
    monkeypatch.setattr("os.nice", lambda by: None)
    suggestions._judge(path, tiny.REPO_ID, str(root), SimpleNamespace(send=said.append))
    assert len(said) == 1 and why in said[0]


def test_disagreements_name_the_slip(root, tmp_path, capsys):
    store = LabelStore(root, tiny.REPO_ID, ["spilled"])
    margins = {e: np.r_[np.ones(n - 6), -np.ones(6)] for e, n in enumerate(store.length)}
    for episode in range(5):
        store.label("spilled", episode, int(store.length[episode]) - 6, "ann")
    assert find_disagreements(store, "spilled", margins) == []
    store.label("spilled", 3, int(store.length[3]), "bo")
    assert [d.episode for d in find_disagreements(store, "spilled", margins)] == [3]
    store.close()


def test_check_labels_writes_a_page(root, tiny_filter, tmp_path, capsys, monkeypatch):
    broken_pictures(root, None, monkeypatch)
    page = tmp_path / "page.html"
    main(["check-labels", f"--policy.path={tiny_filter}", f"--dataset.repo_id={tiny.REPO_ID}",
          f"--dataset.root={root}", f"--output={page}"])  # fmt: skip
    said = capsys.readouterr().out
    assert "episode 4 was not judged, because OSError: a picture is cut" in said
    assert f"1 episodes were not judged; open {page}" in said and "disagree with the filter" in page.read_text()
