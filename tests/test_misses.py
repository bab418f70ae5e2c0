"""Which part of a filter is to blame for a failure that it did not warn of in time."""

import json

import numpy as np
import pytest
import tiny

from lerobot_latentsafe.cli.evaluate import ExplainMisses
from lerobot_latentsafe.cli.options import DatasetSource
from lerobot_latentsafe.cli.places import PolicySource
from lerobot_latentsafe.datasets.labels import FAILING
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.evaluation import misses
from lerobot_latentsafe.evaluation.decision_values import EpisodeDecisions
from lerobot_latentsafe.evaluation.misses import CAUSES, explain_misses, imagined_margin, read_causes
from lerobot_latentsafe.reports.figures import causes_of_misses, save
from lerobot_latentsafe.training import load_with_cache

TABLE = {
    # first failing frame of 6, V, l of the failing frame, l imagined there -> why
    "warned": (4, [0.9, 0.9, 0.1, 0.9, 0.9, 0.9], -0.5, -0.5, None),
    "no number is a warning, too": (4, [0.9, 0.9, np.nan, 0.9, 0.9, 0.9], -0.5, -0.5, None),
    "doomed": (1, [-0.5] * 6, -0.5, -0.5, "doomed"),
    "late": (4, [0.9, 0.9, 0.9, 0.1, 0.1, 0.1], -0.5, -0.5, "fallback"),
    "blind": (4, [0.9] * 6, 0.3, -0.5, "margin"),
    "no number shows nothing": (4, [0.9] * 6, np.nan, -0.5, "margin"),
    "imagined otherwise": (4, [0.9] * 6, -0.5, 0.3, "world_model"),
    "hopeful": (4, [0.9] * 6, -0.5, -0.5, "value"),
}


@pytest.fixture(scope="module")
def filter_and_reader(tiny_filter, cache_meta):
    policy, reader = load_with_cache(tiny_filter, cache_meta)
    policy.config.change(law=policy.config.law.changed(LawOptions(epsilon=0.2)))
    return policy.model, reader


@pytest.mark.parametrize(("failed", "value", "seen", "imagined", "cause"), TABLE.values(), ids=TABLE)
def test_the_first_cause_that_holds_is_to_blame(filter_and_reader, monkeypatch, failed, value, seen, imagined, cause):
    failure, margin = (np.arange(6) >= failed).astype(np.int8), np.full(6, 0.5)
    margin[failed] = seen
    row = EpisodeDecisions(3, np.array(value), margin, failure)
    monkeypatch.setattr(misses, "decision_values", lambda *_: [row])
    monkeypatch.setattr(misses, "imagined_margin", lambda *_: imagined)
    found = explain_misses(*filter_and_reader, np.array([3]), lead_steps=2)
    assert found.warned == ([3] if cause is None else [])
    assert {c: some for c, some in found.missed.items() if some} == ({} if cause is None else {cause: [3]})
    assert found.shares() == ({} if cause is None else {c: float(c == cause) for c in CAUSES})


@pytest.mark.parametrize("skip", [1, 3])
@pytest.mark.parametrize("history", [0, 6])
def test_what_is_imagined_begins_with_what_was_seen(cache_meta, skip, history):
    """With nothing left to imagine but one step, it is that step from the last frame that was seen."""
    policy = tiny.new_policy(
        cache_meta, world_model=tiny.rssm_config(frame_skip=skip, clip_length=5), law_history_frames=history
    ).eval()
    reader, model = policy.reader, policy.model
    seen, start = 13, int(np.flatnonzero(reader.labels.episode == 2)[0])
    found = imagined_margin(model, reader, 2, seen, seen + skip)
    first = max(seen % skip, seen - skip * (-(-history // skip) // 2 - 1)) if history else seen % skip
    clip = reader.cut(np.array([start + first]), model.world_model, length=(seen - first) // skip + 2)
    latents = model.world_model.encode(clip)
    latent = model.world_model.step({key: value[:, -2] for key, value in latents.items()}, clip.action[:, -1])
    assert found == pytest.approx(model.imagination.margin(latent).item(), abs=1e-5)


def test_episodes_that_never_fail_explain_nothing(filter_and_reader):
    model, reader = filter_and_reader
    failing = np.unique(reader.labels.episode[reader.labels.failure == FAILING])
    never = np.setdiff1d(reader.labels.episode, failing)
    with pytest.raises(ValueError, match=f"none of {len(never)} episodes fails"):
        explain_misses(model, reader, never, 1)


def test_command_writes_causes_that_a_report_draws(tiny_filter, cache_root, tmp_path, capsys):
    file, picture = tmp_path / "misses.json", tmp_path / "misses.png"
    dataset = DatasetSource(tiny.REPO_ID, str(cache_root))
    law = LawOptions(epsilon=-1.0)  # of which nothing is warned
    ExplainMisses(PolicySource(str(tiny_filter)), dataset, law=law, json=file, figure=picture).run()
    written, counts = json.loads(file.read_text()), read_causes(file)
    assert not written["warned"] and written["epsilon"] == -1 and list(counts) == list(CAUSES)
    assert f"0 of {sum(counts.values())} failing episodes warned of in time" in capsys.readouterr().out
    assert sum(written["shares"].values()) == pytest.approx(1) and picture.stat().st_size > 1000
    save(causes_of_misses({"one": counts, "other": dict.fromkeys(CAUSES, 0)}), tmp_path / "two.png")


@pytest.mark.parametrize("content", ["{", "[]", '{"missed": {"margin": []}}', '{"missed": 3}'])
def test_a_file_that_explains_nothing_is_refused(content, tmp_path):
    file = tmp_path / "misses.json"
    file.write_text(content)
    with pytest.raises(ValueError, match="is no file of latentsafe explain-misses"):
        read_causes(file)
