"""DINO-WM: the contract, exact streaming, and that it obeys the action."""

from pathlib import Path

import draccus
import pytest
import tiny
import torch
import yaml

from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.latent import map_latent, select
from lerobot_latentsafe.world_models import DinoWM, WorldModelConfig

KEYS, STATE_DIM, ACTION_DIM = ["observation.images.wrist", "observation.images.front"], 3, 2
SIDE, TOKEN_DIM = 3, 4
P = SIDE**2
PAPER = Path(__file__).parents[1] / "configs" / "bag_dino_wm_paper.yaml"


def build(**changes):
    return DinoWM(tiny.dino_wm_config(**changes), KEYS, STATE_DIM, ACTION_DIM, P, TOKEN_DIM)


@pytest.fixture(params=["adaln", "concat"])
def model(request):
    model = build(conditioning=request.param).eval()
    for block in model.transformer.blocks:
        if block.modulation is not None:  # starts at zero, where all actions are alike
            torch.nn.init.normal_(block.modulation.weight, std=0.2)
    return model


def random_clip(batch=3, length=8):
    return _clip(torch.randn(batch, length, P, TOKEN_DIM), torch.randn(batch, length, STATE_DIM), None)


def blobs(batch=32, length=8):
    """A blob that both cameras see and the action moves; proprioception says nothing of it."""
    action = 2 * torch.rand(batch, length, ACTION_DIM) - 1
    place = (0.5 * action).cumsum(1) + SIDE / 2 - 0.5 + 0.5 * torch.randn(batch, 1, ACTION_DIM)
    grid = torch.cartesian_prod(torch.arange(SIDE), torch.arange(SIDE)).float()
    brightness = torch.exp(-(grid - place[:, :, None]).square().sum(-1) / 2)
    tokens = brightness[..., None] * torch.tensor([1.0, -1.0, 0.5, 2.0])
    return _clip(tokens, torch.randn(batch, length, STATE_DIM) * 0.01, action)


def _clip(tokens, state, action):
    batch, length = state.shape[:2]
    is_first = torch.zeros(batch, length, dtype=torch.bool)
    is_first[:, 0] = True
    action = 2 * torch.rand(batch, length, ACTION_DIM) - 1 if action is None else action
    unknown = torch.full((batch, length), -1)
    return Clip({"tokens": tokens}, state, action, is_first, torch.ones_like(is_first), unknown, unknown.clone())


def filtered(model, clip, n):
    latent = None
    for t in range(n):
        percepts = {"tokens": clip.percepts["tokens"][:, t]}
        latent = model.observe(latent, clip.action[:, t], percepts, clip.state[:, t])
    return latent


def assert_same(latent, other, **tolerance):
    assert latent.keys() == other.keys()
    for name in latent:
        torch.testing.assert_close(latent[name], other[name], **tolerance)


# -- the contract ---


def test_latent_is_batch_first_and_remembers_the_action(model):
    latent = filtered(model, random_clip(), 4)
    assert all(len(value) == 3 for value in latent.values())
    action = torch.rand(3, ACTION_DIM)
    after = model.step(latent, action)
    assert torch.equal(after["action"], action) and {k: v.shape for k, v in after.items()} == {
        k: v.shape for k, v in latent.items()
    }
    assert model.features(latent).shape == (3, model.feature_dim)
    assert model.percept_names == ["tokens"]


@torch.no_grad()
def test_streaming_equals_the_full_forward(model):
    """Frame by frame, through the public contract, against all frames at once, well beyond the window."""
    clip = random_clip(length=12)
    tokens, state = clip.percepts["tokens"], clip.state
    seen = model._frames_seen(clip.is_first)
    known = {"tokens": tokens[:, :-1], "state": state[:, :-1]}
    ahead = model._advance(known, clip.action[:, 1:], seen[:, :-1]).frames
    latent = model.initial(3)
    for t in range(11):
        latent = model.observe(latent, clip.action[:, t], {"tokens": tokens[:, t]}, state[:, t])
        predicted = model.step(latent, clip.action[:, t + 1])
        for name in ("tokens", "state", "context"):
            torch.testing.assert_close(predicted[name], ahead[name][:, t], atol=1e-5, rtol=0)


@torch.no_grad()
def test_imagining_a_batch_equals_imagining_one_by_one(model):
    clip = random_clip(batch=5)
    start = filtered(model, clip, 4)
    together, alone = start, [select(start, slice(i, i + 1)) for i in range(5)]
    for t in range(4, 8):
        together = model.step(together, clip.action[:, t])
        alone = [model.step(z, clip.action[i : i + 1, t]) for i, z in enumerate(alone)]
    joined = {name: torch.cat([z[name] for z in alone]) for name in together}
    assert_same(together, joined, atol=1e-5, rtol=1e-5)


def test_gradients_reach_the_action_through_imagination(model):
    action = torch.zeros(3, ACTION_DIM, requires_grad=True)
    latent = filtered(model, random_clip(), 3)
    for _ in range(3):
        latent = model.step(latent, action)
    model.features(latent).square().sum().backward()
    assert action.grad.isfinite().all() and (action.grad != 0).all()


@torch.no_grad()
def test_correcting_takes_over_what_was_seen_and_keeps_the_past(model):
    clip = random_clip()
    predicted = model.step(filtered(model, clip, 3), clip.action[:, 3])
    seen = model.correct(predicted, {"tokens": clip.percepts["tokens"][:, 3]}, clip.state[:, 3])
    assert torch.equal(seen["tokens"], clip.percepts["tokens"][:, 3]) and torch.equal(seen["state"], clip.state[:, 3])
    assert all(torch.equal(seen[name], predicted[name]) for name in (*model.past_names, "seen", "context"))
    for changed in (
        model.correct(predicted, {"tokens": 1 + clip.percepts["tokens"][:, 3]}, clip.state[:, 3]),
        model.correct(predicted, {"tokens": clip.percepts["tokens"][:, 3]}, 1 + clip.state[:, 3]),
    ):
        assert not torch.allclose(model.features(changed), model.features(seen))
        after, other = (model.step(z, clip.action[:, 4]) for z in (changed, seen))
        assert not torch.allclose(after["context"], other["context"])


@torch.no_grad()
def test_nothing_before_the_first_frame_matters(model):
    clip, other = random_clip(), random_clip()
    clip.is_first[:, 3] = True
    for old, new in (
        (other.percepts["tokens"], clip.percepts["tokens"]), (other.state, clip.state), (other.action, clip.action)
    ):  # fmt: skip
        old[:, 4:] = new[:, 4:]
    other.percepts["tokens"][:, 3], other.state[:, 3] = clip.percepts["tokens"][:, 3], clip.state[:, 3]
    other.is_first = clip.is_first
    late = [model.features(map_latent(model.encode(c), lambda t: t[:, 3:])) for c in (clip, other)]
    torch.testing.assert_close(*late)
    clip.is_first[:, 3] = False
    assert not torch.allclose(model.features(model.encode(clip))[:, 3:], late[0])


@torch.no_grad()
def test_the_first_frame_has_no_context_whatever_led_to_it(model):
    clip = random_clip()
    a = model.observe(None, clip.action[:, 0], {"tokens": clip.percepts["tokens"][:, 0]}, clip.state[:, 0])
    b = model.observe(None, -clip.action[:, 0], {"tokens": clip.percepts["tokens"][:, 0]}, clip.state[:, 0])
    torch.testing.assert_close(model.features(a), model.features(b))
    torch.testing.assert_close(model.step(a, clip.action[:, 1])["tokens"], model.step(b, clip.action[:, 1])["tokens"])


def test_nothing_has_ended_before_an_end_was_ever_seen():
    model, clip = build().train(), random_clip()
    with torch.no_grad():
        model.continues[-1].bias.fill_(-100.0)  # the head says that every episode is over
    model.loss(clip)
    assert not model.ended(model.encode(clip)).any()
    clip.terminal[0, -1] = 1
    model.loss(clip)
    assert model.ended(model.encode(clip)).all()


# -- learning ---


@torch.no_grad()
@pytest.mark.parametrize("options", [{}, {"open_loop": 0.0}, {"change_weight": 0.0}, {"blind": True}])
def test_padding_and_other_episodes_count_for_nothing(options):
    model, losses = build(**options).eval(), []
    clip = random_clip()
    clip.valid[0, 5:] = False
    clip.is_first[1, 4] = True
    for _ in range(2):
        loss, features, _ = model.loss(clip)
        losses.append((loss, torch.where(clip.valid[..., None], features, 0.0)))
        clip.percepts["tokens"][0, 5:] += 100
        clip.state[0, 5:] -= 100
    torch.testing.assert_close(*losses)


@torch.no_grad()
def test_features_of_the_loss_are_those_of_latents_seen_and_then_imagined():
    model, clip = build(observed=3).eval(), random_clip()
    features = model.loss(clip)[1]
    encoded = model.encode(clip)
    torch.testing.assert_close(features[:, :3], model.features(encoded)[:, :3], atol=1e-5, rtol=1e-4)
    latent = map_latent(encoded, lambda t: t[:, 2])
    for t in range(3, 8):
        latent = model.step(latent, clip.action[:, t])
        torch.testing.assert_close(features[:, t], model.features(latent), atol=1e-5, rtol=1e-4)


def test_every_parameter_learns_but_the_continuation_until_ends_are_known():
    for conditioning in ("adaln", "concat"):
        model = build(conditioning=conditioning).train()
        for block in model.transformer.blocks:
            if block.modulation is not None:
                torch.nn.init.normal_(block.modulation.weight)
        loss, features, metrics = model.loss(random_clip())
        (loss + features.square().sum()).backward()
        idle = {name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()}
        assert idle and all(name.startswith("continues.") for name in idle)
        assert all(value.isfinite() for value in metrics.values())


def learn(**options):
    torch.manual_seed(0)
    model = build(**{"clip_length": 8, **options}).train()
    optimizer = torch.optim.AdamW(model.parameters(), 3e-3)
    for _ in range(200):
        loss, *_ = model.loss(blobs())
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
    return model.eval()


@torch.no_grad()
def imagined_error(model, clip, action, observed=2):
    latent = filtered(model, clip, observed)
    for t in range(observed, clip.state.shape[1]):
        latent = model.step(latent, action[:, t])
    return model.error(latent, {key: value[:, -1] for key, value in clip.percepts.items()}, clip.state[:, -1]).mean()


def test_it_learns_to_obey_the_action():
    model = learn()
    clip = blobs(batch=128)
    true = imagined_error(model, clip, clip.action)
    assert imagined_error(model, clip, clip.action[torch.randperm(128)]) > 1.5 * true
    copied = (clip.percepts["tokens"][:, 1] - clip.percepts["tokens"][:, -1]).square().mean()
    assert true < 0.5 * copied


# -- the recipe: merged patches, a frame token ---

GRID, MERGED = 4, {"merge_patches": 2, "frame_token": True, "token_weight": 0.1}


def build_merged(**changes):
    config = tiny.dino_wm_config(**{**MERGED, **changes})
    return DinoWM(config, KEYS, STATE_DIM, ACTION_DIM, GRID**2, TOKEN_DIM)


def merged_clip(batch=3, length=8):
    clip = _clip(torch.randn(batch, length, GRID**2, TOKEN_DIM), torch.randn(batch, length, STATE_DIM), None)
    clip.percepts["vector"] = torch.randn(batch, length, tiny.COMPONENTS)
    return clip


def test_merged_patches_lie_side_by_side_camera_by_camera():
    model = build_merged()
    rows, columns = torch.meshgrid(torch.arange(GRID), torch.arange(GRID), indexing="ij")
    tokens = torch.stack([camera * 100 + 10 * rows + columns for camera in (0, 0, 1, 1)], -1).flatten(0, 1).float()
    merged = model._merged(tokens[None])[0]
    assert merged.shape == (4, 4 * TOKEN_DIM)
    expected = [0, 0, 1, 1, 10, 10, 11, 11, 100, 100, 101, 101, 110, 110, 111, 111]
    for token, corner in enumerate((0, 2, 20, 22)):
        assert merged[token].tolist() == [corner + number for number in expected]


def test_merged_patches_come_apart_again():
    model, tokens = build_merged(), torch.randn(2, GRID**2, TOKEN_DIM)
    assert torch.equal(model._apart(model._merged(tokens)), tokens)
    latent = {"tokens": model._merged(tokens), "vector": torch.zeros(2, tiny.COMPONENTS)}
    assert torch.equal(model.tokens_of(latent), tokens)  # without an encoder, tokens are whole


@pytest.mark.parametrize("options", [{}, {"memory": 0}, {"conditioning": "concat"}])
@torch.no_grad()
def test_streaming_with_a_frame_token_equals_the_full_forward(options):
    model, clip = build_merged(**options).eval(), merged_clip(length=12)
    frames = {**model._looked_at(clip.percepts), "state": clip.state}
    seen = model._frames_seen(clip.is_first)
    known = {name: values[:, :-1] for name, values in frames.items()}
    ahead = model._advance(known, clip.action[:, 1:], seen[:, :-1]).frames
    latent = model.initial(3)
    for t in range(11):
        percepts = {name: values[:, t] for name, values in clip.percepts.items()}
        latent = model.observe(latent, clip.action[:, t], percepts, clip.state[:, t])
        predicted = model.step(latent, clip.action[:, t + 1])
        for name in ("tokens", "vector", "state", "context"):
            torch.testing.assert_close(predicted[name], ahead[name][:, t], atol=1e-5, rtol=0)
    assert model.features(latent).shape == (3, model.feature_dim) and model.percept_names == ["tokens", "vector"]


@pytest.mark.parametrize("options", [{"depth": 1}, {"depth": 3}, {"memory": 0}, {"conditioning": "concat"}])
@torch.no_grad()
def test_what_is_seen_takes_no_prediction(options):
    """Observing is predicting and correcting, though it skips what would be corrected."""
    model, clip = build_merged(**options).eval(), merged_clip()
    latent = model.initial(3)
    for t in range(8):
        percepts = {name: values[:, t] for name, values in clip.percepts.items()}
        whole = model.correct(model.step(latent, clip.action[:, t]), percepts, clip.state[:, t])
        latent = model.observe(latent, clip.action[:, t], percepts, clip.state[:, t])
        assert latent.keys() == whole.keys()
        for name, value in whole.items():
            torch.testing.assert_close(latent[name], value, atol=1e-5, rtol=0)


def test_every_parameter_of_the_recipe_learns():
    for options in ({}, {"memory": 0}, {"conditioning": "concat"}):
        model = build_merged(**options).train()
        loss, features, metrics = model.loss(merged_clip())
        (loss + features.square().sum()).backward()
        idle = {name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()}
        assert idle and all(name.startswith("continues.") for name in idle)
        assert {"loss_frame", "loss_frame_open_loop"} <= metrics.keys()


@torch.no_grad()
def test_a_part_of_the_clips_teaches_the_patches_and_all_teach_the_frame():
    """Whichever clips show their patches, each frame token is foretold as if all did."""
    part, whole = build_merged(token_share=0.25), build_merged(token_share=1.0)
    whole.load_state_dict(part.state_dict())
    clip = merged_clip(batch=8)
    (_, some, told), (_, all_of_them, _) = part.eval().loss(clip), whole.eval().loss(clip)
    assert some.shape == all_of_them.shape == (8, 8, part.feature_dim) and "loss_tokens" in told
    torch.testing.assert_close(some[:2], all_of_them[:2])  # 2 of 8 clips
    n = 2 * part.config.summary  # what is learned of patches comes first
    torch.testing.assert_close(some[2:, :, n:], all_of_them[2:, :, n:])
    assert not some[2:, :, :n].any() and all_of_them[2:, :, :n].any()


def test_without_a_memory_all_clips_show_their_patches():
    for options in ({"memory": 0}, {"frame_token": False}):
        model = build_merged(token_share=0.1, **options).eval()
        _, features, _ = model.loss(merged_clip())
        assert features[..., : 2 * model.config.summary].abs().sum((1, 2)).all()


def test_a_grid_that_does_not_fall_into_squares_is_refused():
    with pytest.raises(ValueError, match="9 patches a camera: 2 x 2 of them do not fill"):
        build(merge_patches=2)
    with pytest.raises(ValueError, match="12 patches"):
        DinoWM(tiny.dino_wm_config(merge_patches=2), KEYS, STATE_DIM, ACTION_DIM, 12, TOKEN_DIM)


def test_blind_control_sees_nothing():
    model = build(blind=True).eval()
    clip, other = random_clip(), random_clip()
    other.state, other.action = clip.state, clip.action
    with torch.no_grad():
        seen, unseen = (model.features(filtered(model, c, 3)) for c in (clip, other))
    torch.testing.assert_close(seen, unseen)
    assert "loss_tokens" not in model.loss(clip)[2]


# -- from configuration to filter ---


def test_filter_is_trained_saved_and_loaded(token_root, tmp_path):
    """From a token cache to a shielded action, by the commands' functions; the checkpoint holds no encoder."""
    from safetensors import safe_open

    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
    from lerobot_latentsafe.training import train_margin, train_reachability

    meta = tiny.metadata(token_root)
    options = dict(world_model=tiny.dino_wm_config(), fallback_action_candidates=None, margin_clips=32)
    stage_one = tiny.train_stage_one(meta, tmp_path / "one", **options)
    train_margin(stage_one, meta, tmp_path / "two")
    train_reachability(tmp_path / "two", meta, tmp_path / "three")
    policy = LatentSafePolicy.from_pretrained(tmp_path / "three")
    assert all(d.action.isfinite().all() and d.value.isfinite().all() for d in tiny.drive(policy))
    with safe_open(tmp_path / "three" / "model.safetensors", "pt") as file:
        names = list(file.keys())
    assert not [name for name in names if "encoder" in name or "basis" in name]


def test_latents_that_imagination_starts_from_fit_in_memory(token_root, monkeypatch):
    from lerobot_latentsafe import training

    policy = tiny.new_policy(
        tiny.metadata(token_root), world_model=tiny.dino_wm_config(), fallback_action_candidates=None
    )
    length, cut, windows = policy.config.world_model.clip_length, policy.reader.cut, []
    monkeypatch.setattr(policy.reader, "cut", lambda first, names: windows.extend(first) or cut(first, names))
    latent = sum(t.nbytes for t in policy.model.world_model.initial(1).values())
    monkeypatch.setattr(training, "STARTS_BYTES", 2 * latent * 3 * length)
    draw = training.encoded_starts(policy.model, policy.reader, torch.Generator())
    assert len(windows) == 3 and len(draw(5)["tokens"]) == 5


def test_the_papers_sizes_train_save_load_and_stream(tmp_path):
    """With 4 patches instead of 256; scripts/bench_dino_wm.py measures them all."""
    sizes = yaml.safe_load(PAPER.read_text())["policy"]["world_model"]
    config = draccus.decode(WorldModelConfig, sizes)
    model = DinoWM(config, KEYS, 14, 7, n_patches=4, token_dim=2 * 384).train()
    assert (config.dim, config.depth, config.heads, config.history) == (788, 6, 16, 3)
    clip = random_clip(batch=1, length=config.clip_length)
    clip.percepts = {"tokens": torch.randn(1, config.clip_length, 4, 768)}
    clip.state, clip.action = torch.randn(1, config.clip_length, 14), torch.rand(1, config.clip_length, 7)
    loss, *_ = model.loss(clip)
    loss.backward()
    torch.optim.SGD(model.parameters(), 1e-3).step()
    torch.save(model.state_dict(), tmp_path / "model.pt")
    again = DinoWM(config, KEYS, 14, 7, n_patches=4, token_dim=2 * 384).eval()
    again.load_state_dict(torch.load(tmp_path / "model.pt", weights_only=True))
    with torch.no_grad():
        assert_same(filtered(model.eval(), clip, 4), filtered(again, clip, 4))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"conditioning": "add"}, r"'add'.*adaln, concat"),
        ({"clip_length": 3}, "clip_length is 3.*history=3 frames needs at least 4"),
        ({"history": 0}, "history is 0.*at least 1"),
        ({"frame_percept": "cls"}, "'cls'; expected one of components, class"),
        ({"memory": -1}, "memory is -1.*0 .none."),
        ({"token_share": 0.0}, "token_share is 0.0.*above 0"),
        ({"token_share": 1.5}, "token_share is 1.5.*up to 1"),
        ({"head_dim": 7}, "head_dim is 7.*even"),
        ({"conditioning": "concat", "embedding": 16}, "dim is 32.*embedding=16"),
    ],
)
def test_sizes_that_cannot_be_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        build(**options)


def test_model_without_a_camera_is_refused():
    with pytest.raises(ValueError, match="at least one camera"):
        tiny.dino_wm_config().build([], STATE_DIM, ACTION_DIM)


def test_model_made_for_tokens_cannot_see_images():
    with pytest.raises(RuntimeError, match="build it from its configuration"):
        build().perceive({key: torch.rand(1, 3, 32, 32) for key in KEYS})
