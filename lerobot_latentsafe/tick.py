"""What a tick asks of the models, as functions of tensors alone, so that they can be compiled (see `compiled.py`)."""

from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_latentsafe.latent import Latent, is_sound, map_latent, replace_rows
from lerobot_latentsafe.safety_model import SafetyModel


class Frame(NamedTuple):
    """A frame of B robots, and what led to it.

    Attributes:
        percepts: of the frame, (B, ...).
        state: (B, S), normalised.
        led: (B, K A), actions that led here, as they were heard.
        ahead: (B, K, A), the action that is judged, and after it what is to come, as they are heard.
    """

    percepts: Latent
    state: Tensor
    led: Tensor
    ahead: Tensor


class Thought(NamedTuple):
    """What the models say.

    Attributes:
        latent: what is believed after the frame, (N B, ...).
        value, margin: (B,), V of the action that is judged, and l now.
        here: (B,), V of now.
        action: (B, A) in [-1, 1], the fallback.
    """

    latent: Latent
    value: Tensor
    margin: Tensor
    here: Tensor
    action: Tensor


def together(latents: list[Latent | None], fresh: Latent) -> tuple[Latent, Tensor]:
    """N latents of B robots as one (N B, ...), and which rows begin an episode: bool (N B,)."""
    whole = [fresh if latent is None else latent for latent in latents]
    begins = torch.tensor([latent is None for latent in latents], device=fresh["action"].device)
    n = len(fresh["action"])
    return {key: torch.cat([latent[key] for latent in whole]) for key in fresh}, begins.repeat_interleave(n)


def think(model: SafetyModel, latent: Latent, begins: Tensor, frame: Frame, blind: Tensor | None = None) -> Thought:
    """Take in a frame, and look ahead.

    Args:
        latent: what was believed before, of N memories of B robots: (N B, ...). The first is decided by.
        begins: bool (N B,), rows that begin an episode.
        blind: bool (B,), robots that go on by imagination alone; None: none of them.
    """
    latent = take_in(model, latent, begins, frame, blind)
    return Thought(latent, *look_ahead(model, map_latent(latent, lambda t: t[: len(frame.led)]), frame.ahead))


def take_in(model: SafetyModel, latent: Latent, begins: Tensor, frame: Frame, blind: Tensor | None = None) -> Latent:
    """What the world model makes of a frame: (N B, ...); see `think`."""
    world_model, n = model.world_model, len(begins) // len(frame.led)
    new = world_model.initial(len(begins))
    lost = begins | ~is_sound(latent)  # what went wrong once must not poison the rest of an episode
    led, first, state = (t.repeat(n, 1) for t in (frame.led, model.units.first_action(frame.led), frame.state))
    percepts = map_latent(frame.percepts, lambda t: t.repeat(n, *[1] * (t.dim() - 1)))
    latent, led = replace_rows(latent, new, where=lost), torch.where(lost[:, None], first, led)
    if blind is None:
        return world_model.observe(latent, led, percepts, state)
    predicted = world_model.step(latent, led)
    return replace_rows(world_model.correct(predicted, percepts, state), predicted, where=blind.repeat(n))


def look_ahead(model: SafetyModel, latent: Latent, ahead: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """V of actions, l and V of latents (B, ...) now, and the fallback; see `Thought` and `Frame`."""
    margin = model.imagination.margin(latent)
    predicted, on_the_way = model.go_on(latent, ahead)
    both = {key: torch.cat([predicted[key], latent[key]]) for key in latent}  # one pass through imagination
    sizes = [len(on_the_way), len(margin)]
    (value, here), (_, action) = (part.split(sizes) for part in model.plan(both))
    return model.through(latent, margin, on_the_way, value), margin, here, action
