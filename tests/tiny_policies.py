"""Every policy type of LeRobot: whole and tiny where it can be built offline, else with a network that only counts.

A counting policy is LeRobot's own class, with its own queues, that plans the number of the tick for the tick itself,
one more for the next, and so on. What it does tells when it planned.
"""

from types import SimpleNamespace

import tiny
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from torch import nn

STATE, CAMERA = "observation.state", "observation.image"
SEEN = {STATE: PolicyFeature(FeatureType.STATE, (2,))}
POSITION = {"observation.environment_state": PolicyFeature(FeatureType.ENV, (2,))}
PICTURE = {CAMERA: PolicyFeature(FeatureType.VISUAL, (3, 128, 128))}
ACTION = {"action": PolicyFeature(FeatureType.ACTION, (tiny.ACTION_DIM,))}

TRANSFORMER = dict(
    chunk_size=6, n_action_steps=4, dim_model=16, n_heads=2, dim_feedforward=16, n_encoder_layers=1, n_decoder_layers=1,
    n_vae_encoder_layers=1, latent_dim=4,
)  # fmt: skip
AVERAGED = {"temporal_ensemble_coeff": 0.01}
SEARCH = dict(
    horizon=5, latent_dim=8, q_ensemble_size=2, mlp_dim=16, cem_iterations=2, n_gaussian_samples=16, n_elites=4,
    n_pi_samples=4, state_encoder_hidden_dim=16,
)  # fmt: skip
BEHAVIOUR = dict(
    n_obs_steps=2, n_action_pred_token=2, action_chunk_size=4, crop_shape=(120, 120), vqvae_n_embed=4,
    vqvae_embedding_dim=8, vqvae_enc_hidden_dim=16, gpt_block_size=32, gpt_input_dim=16, gpt_output_dim=16,
    gpt_n_layer=1, gpt_n_head=2, gpt_hidden_dim=16, pretrained_backbone_weights=None,
)  # fmt: skip

WHOLE = {
    "act": ("act", {**SEEN, **POSITION}, TRANSFORMER),
    "act, averaged": ("act", {**SEEN, **POSITION}, {**TRANSFORMER, "n_action_steps": 1, **AVERAGED}),
    "diffusion": ("diffusion", None, None),
    "vqbet": ("vqbet", {**SEEN, **PICTURE}, BEHAVIOUR),
    "tdmpc": ("tdmpc", {**SEEN, **POSITION}, {**SEARCH, "n_action_repeats": 1}),
    "tdmpc, four steps": ("tdmpc", {**SEEN, **POSITION}, {**SEARCH, "n_action_repeats": 1, "n_action_steps": 4}),
    "tdmpc, repeated": ("tdmpc", {**SEEN, **POSITION}, {**SEARCH, "n_action_repeats": 3}),
    "tdmpc, no search": ("tdmpc", {**SEEN, **POSITION}, {**SEARCH, "n_action_repeats": 1, "use_mpc": False}),
    "gaussian_actor": ("gaussian_actor", {**SEEN, **POSITION}, {"latent_dim": 8, "state_encoder_hidden_dim": 16}),
}  # fmt: skip
"""What can be built whole without `transformers`: name -> type, input features, sizes."""


def whole_config(name):
    """The configuration of a policy of `WHOLE`."""
    kind, seen, sizes = WHOLE[name]
    if kind == "diffusion":
        return tiny.diffusion_config()
    config = PreTrainedConfig.get_choice_class(kind)
    return config(input_features=seen, output_features=ACTION, device="cpu", push_to_hub=False, **sizes)


def statistics(config):
    """Of a dataset of the car: the speed does not vary."""
    stats = {}
    for key, feature in {**config.input_features, **config.output_features}.items():
        one = torch.ones(3, 1, 1) if feature.type is FeatureType.VISUAL else torch.ones(feature.shape)
        low, high = -1.1 * one, 1.1 * one
        if key == "action":
            low, high = torch.tensor([-1.25, 0.0]), torch.tensor([1.25, 1.0])
        stats[key] = {"min": low, "max": high, "mean": (low + high) / 2, "std": (high - low) / 2}
    return stats


def save_whole(name, folder):
    """A policy of `WHOLE` with random weights, saved with its processors as lerobot-train saves them."""
    torch.manual_seed(1)
    config = whole_config(name)
    get_policy_class(config.type)(config).save_pretrained(folder)
    for pipeline in make_pre_post_processors(config, dataset_stats=statistics(config)):
        pipeline.save_pretrained(folder)
    return folder


CHUNK, PLAYED = 6, 4
COUNTING = (
    "act", "diffusion", "eo1", "evo1", "fastwam", "groot", "lingbot_va", "molmoact2", "multi_task_dit", "pi0", "pi05",
    "pi0_fast", "smolvla", "tdmpc", "vla_jepa", "vqbet", "wall_x", "xvla",
)  # fmt: skip
"""Types that plan chunks, and play them from a queue."""
CUT_TO_WHAT_IS_PLAYED = ("diffusion", "lingbot_va", "multi_task_dit")


def counting(kind):
    """A policy of LeRobot's class of this type, whose plan counts on from the tick that it sees in the state."""
    policy_class = get_policy_class(kind)
    policy = policy_class.__new__(policy_class)
    nn.Module.__init__(policy)
    policy.config = _settings(kind)

    def plan(batch, *_, **__):
        if kind == "lingbot_va":  # what it saw last is what it keeps for its own feedback
            batch = batch or policy._obs_buffer[-1]
        now = batch[STATE] if batch[STATE].dim() == 2 else batch[STATE][:, -1]
        steps = PLAYED if kind == "vqbet" else CHUNK
        if kind in CUT_TO_WHAT_IS_PLAYED:
            steps = policy.config.n_action_steps
        chunk = torch.stack([now + i for i in range(steps)], 1)
        return chunk.transpose(0, 1) if kind == "tdmpc" else chunk

    policy.predict_action_chunk = policy._get_action_chunk = plan
    policy.temporal_ensembler, policy._action_queue_steps, policy._frozen = None, PLAYED, {}
    trained = SimpleNamespace(discretized=torch.tensor(True))
    policy.vqbet = SimpleNamespace(action_head=SimpleNamespace(vqvae_model=trained))
    policy._ensure_frozen_modules = policy._maybe_init_prompt = lambda *_: None
    policy._extract_raw_obs = lambda batch: batch
    policy._rtc_enabled = lambda: False
    policy._prepare_batch = lambda batch: batch
    policy._keep_frozen_embedder_eval = lambda: None
    policy.reset()
    return policy


def seen(tick):
    """What a counting policy is shown at a tick: it reads the state alone."""
    return {STATE: torch.full((2, 1), float(tick)), CAMERA: torch.zeros(2, 3, 2, 2)}


def _settings(kind):
    """What the class of a type reads of its configuration to play a chunk."""
    settings = SimpleNamespace(
        type=kind, chunk_size=CHUNK, action_chunk_size=PLAYED, n_action_steps=PLAYED, n_action_repeats=1, n_obs_steps=2,
        temporal_ensemble_coeff=None, image_features={}, env_state_feature=None, rtc_config=None, use_mpc=True,
        use_relative_actions=False, action_per_frame=4, guidance_scale=1, action_guidance_scale=1, snr_shift=1.0,
        action_snr_shift=1.0, input_features={}, output_features={},
    )  # fmt: skip
    if kind in ("diffusion", "multi_task_dit"):
        settings.horizon = CHUNK + 1
    elif kind == "tdmpc":
        settings.horizon, settings.n_obs_steps = CHUNK, 1
    elif kind == "vqbet":
        settings.image_features = {CAMERA: None}
    return settings
