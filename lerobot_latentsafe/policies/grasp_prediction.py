"""Where to grasp, seen by a frozen encoder, as `observation.environment_state` for any LeRobot policy.

The step adds to live observations what a policy was trained on by `grasp_training.py`, so that the trained policy runs
wherever there are cameras.
"""

from typing import Any

import torch
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.processor import ObservationProcessorStep, PolicyActionProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor, nn
from tqdm import trange

from lerobot_latentsafe.encoders.perception import Perception, PerceptionConfig
from lerobot_latentsafe.pictures import to_model_images

KEYPOINTS, HIDDEN, DROPOUT = 16, 128, 0.1
STEPS, LEARNING_RATE = 4000, 3e-3
SMALL = 0.2
"""Motions below this share of their deviation are shown enlarged: a policy that goes down 20 mm beside is of no use."""
MOSTLY, RARELY = 112, 16
"""Frames of a batch from before the fingers close, the few that matter, and of any frames."""


class GraspPredictor(nn.Module):
    """How the hand will move until the fingers next close, foreseen from a frame.

    Each camera's patches vote for the places of a few learned keypoints (a spatial softmax): what is learned of an
    object in one place then holds in others, which components of whole pictures would have to be shown.

    Args:
        n_cameras, n_patches, token_dim: of the tokens (N, n_patches, token_dim) of all cameras.
        state_dim: S, of proprioception.
        n_moves: M, numbers that tell a motion.
    """

    token_mean: Tensor
    token_std: Tensor
    state_mean: Tensor
    state_std: Tensor
    move_mean: Tensor
    move_std: Tensor

    def __init__(self, n_cameras: int, n_patches: int, token_dim: int, state_dim: int, n_moves: int):
        super().__init__()
        side = round(n_patches**0.5)
        places = torch.linspace(-1, 1, side)
        self.places = torch.cartesian_prod(places, places)
        self.votes = nn.ModuleList([nn.Linear(token_dim // n_cameras, KEYPOINTS) for _ in range(n_cameras)])
        self.head = nn.Sequential(
            nn.Linear(n_cameras * KEYPOINTS * 2 + state_dim, HIDDEN),
            nn.ReLU(),
            nn.Dropout(DROPOUT),
            nn.Linear(HIDDEN, n_moves),
        )
        for name, size in {"token": token_dim, "state": state_dim, "move": n_moves}.items():
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    def forward(self, tokens: Tensor, state: Tensor) -> Tensor:
        """Tokens (N, P, C) and proprioception (N, S) -> the motion (N, M), in the units of proprioception."""
        tokens = (tokens - self.token_mean) / self.token_std
        cameras = tokens.chunk(len(self.votes), -1)
        places = self.places.to(tokens)
        points = [
            torch.einsum("npk,pd->nkd", vote(part).softmax(1), places).flatten(1)
            for vote, part in zip(self.votes, cameras)
        ]
        moves = self.head(torch.cat([*points, (state - self.state_mean) / self.state_std], -1))
        return moves * self.move_std + self.move_mean

    def in_detail(self, moves: Tensor) -> Tensor:
        """Motions (N, M) as policies read them (N, 2M): as they are, and enlarged where they are small."""
        return torch.cat([moves, (moves / (SMALL * self.move_std)).tanh()], -1)

    def fit(self, tokens: Tensor, state: Tensor, move: Tensor) -> None:
        """Learn from frames: tokens (N, P, C), proprioception (N, S), the motion that came (N, M)."""
        self.token_mean.copy_(tokens.mean((0, 1)))
        self.token_std.copy_(tokens.std((0, 1)).clamp(min=1e-4))
        self.state_mean.copy_(state.mean(0))
        self.state_std.copy_(state.std(0).clamp(min=1e-3))
        optimizer = torch.optim.AdamW(self.parameters(), LEARNING_RATE, weight_decay=1e-2)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
        self.train()
        before = move.any(-1).nonzero()[:, 0]
        self.move_mean.copy_(move[before].mean(0))
        self.move_std.copy_(move[before].std(0).clamp(min=1e-3))
        for _ in trange(STEPS, desc="aim", unit="step"):
            drawn, any_frames = torch.randint(len(before), (MOSTLY,)), torch.randint(len(state), (RARELY,))
            rows = torch.cat([before[drawn.to(before.device)], any_frames.to(before.device)])
            error = (self(tokens[rows], state[rows]) - move[rows]) / self.move_std
            loss = error.square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        self.eval()


@ProcessorStepRegistry.register("latentsafe_perceive")
class GraspPredictionStep(ObservationProcessorStep):
    """Adds the aim to an observation whose images are tensors.

    Args:
        encoder, encoder_hash: see `PerceptionConfig`.
        image_size: side to which images (B, 3, H, W) in [0, 1] are area-averaged.
        cameras: their keys in the observation.
        state_dim, n_moves: see `GraspPredictor`.
    """

    def __init__(
        self, encoder: str, encoder_hash: str, image_size: int, cameras: list[str], state_dim: int, n_moves: int
    ):
        self.perception = Perception(PerceptionConfig(encoder, encoder_hash), cameras, image_size)
        self.sizes = {"state_dim": state_dim, "n_moves": n_moves}
        self.aim = GraspPredictor(
            len(cameras), self.perception.n_patches, self.perception.token_dim, **self.sizes
        ).eval()

    @torch.no_grad()
    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """An observation with the motion until the next grasp as `observation.environment_state` (B, 2M)."""
        perception = self.perception
        missing = [key for key in (*perception.image_keys, OBS_STATE) if key not in observation]
        if missing:
            raise KeyError(
                f"observation lacks {', '.join(missing)}, which this policy sees by; got {', '.join(observation)}"
            )
        images = {key: to_model_images(observation[key], perception.image_size) for key in perception.image_keys}
        tokens = perception.tokens(images)
        aim = self.aim.to(tokens.device)
        return {**observation, OBS_ENV_STATE: aim.in_detail(aim(tokens, observation[OBS_STATE]))}

    def get_config(self) -> dict[str, Any]:
        """What makes this step again."""
        return {
            "encoder": self.perception.config.encoder,
            "encoder_hash": self.perception.config.encoder_hash,
            "image_size": self.perception.image_size,
            "cameras": self.perception.image_keys,
            **self.sizes,
        }

    def state_dict(self) -> dict[str, Tensor]:
        """Weights of the network, not of the encoder."""
        return {name: value.clone() for name, value in self.aim.state_dict().items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take over weights of `state_dict`."""
        self.aim.load_state_dict(state)

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Features with what this step adds."""
        seen = PolicyFeature(FeatureType.ENV, (2 * self.sizes["n_moves"],))
        observed = {**features.get(PipelineFeatureType.OBSERVATION, {}), OBS_ENV_STATE: seen}
        return {**features, PipelineFeatureType.OBSERVATION: observed}


@ProcessorStepRegistry.register("latentsafe_two_valued")
class FewValuedStep(PolicyActionProcessorStep):
    """Commands that only ever took two or three values in the demonstrations, as of fingers, are given as the nearest.

    A denoised command falls a little short of them. The robot follows, and a policy that reads how far its fingers have
    closed, never having seen them in between, takes that for the beginning of a grasp, and closes on nothing.

    Args:
        levels: index of a command -> its values.
    """

    def __init__(self, levels: dict[str, tuple[float, ...]]):
        self.levels = levels

    def action(self, action: Tensor) -> Tensor:
        """(..., A) -> (..., A)."""
        action = action.clone()
        for index, values in self.levels.items():
            command, known = action[..., int(index)], action.new_tensor(values)
            action[..., int(index)] = known[(command[..., None] - known).abs().argmin(-1)]
        return action

    def get_config(self) -> dict[str, Any]:
        """What makes this step again."""
        return {"levels": self.levels}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Features with what this step adds."""
        return features
