"""Causes of misses by branching the simulator: which of them a run is put down to."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lerobot_latentsafe.experiments.bag.branching import HORIZON, Run, cause_of, imagined_margin, last_way_out

T, FAILED, SKIP = 20, 12, 3


def policy(imagined: list[float]):
    """A filter that imagines these margins, one a step."""
    imagination = SimpleNamespace(
        follow=lambda latent, action: {"n": latent["n"] + 1, "action": action},
        margin=lambda latent: torch.tensor([imagined[int(latent["n"]) - 1]]),
    )
    config = SimpleNamespace(world_model=SimpleNamespace(frame_skip=SKIP))
    return SimpleNamespace(model=SimpleNamespace(imagination=imagination, config=config))


def run(acts: int | None, margin_after: float, spills: bool = True) -> Run:
    ticks = np.arange(T)
    return Run(
        states=[0] * T, latents=[{"n": 0}] * T, actions=np.zeros((T, 7), np.float32), heard=torch.zeros(T, 7),
        acts=ticks >= acts if acts is not None else np.zeros(T, bool),
        margin=np.where(ticks >= FAILED, margin_after, 0.5), spilled=(ticks >= FAILED) & spills,
    )  # fmt: skip


@pytest.mark.parametrize(
    "run, way_out, imagined, cause",
    [
        (run(None, 0.5, spills=False), 5, [0.5] * 9, None),
        (run(3, -0.5), None, [0.5] * 9, "doomed"),
        (run(3, -0.5), 5, [0.5] * 9, "fallback"),
        (run(6, 0.5), 5, [0.5] * 9, "margin"),
        (run(6, -0.5), 5, [0.5] * 9, "world_model"),
        (run(6, -0.5), 5, [0.5, 0.5, -0.1], "value"),
        (run(None, -0.5), 5, [-0.5] * 9, "value"),
    ],
)
def test_a_miss_is_put_down_to_the_first_cause_that_holds(run, way_out, imagined, cause):
    assert cause_of(policy(imagined), run, way_out) == cause


def test_what_was_executed_is_imagined_up_to_the_failure():
    """From tick 5 to tick 12 are three steps of three ticks."""
    assert imagined_margin(policy([0.4, 0.3, 0.2, -1.0]), run(None, 0), 5, FAILED) == pytest.approx(0.2)


class Countdown:
    """Candies fall so many ticks after tick `since`, unless the hand comes down before."""

    since, delay = 8, 4

    def set_state(self, state):
        self.t, self.down = state, False

    def step(self, action):
        self.down |= action[2] < -0.005 and self.t <= self.since
        self.t += 1

    def truth(self):
        return {"failure": self.t >= self.since + self.delay and not self.down}


def test_the_last_way_out_is_the_last_moment_from_which_something_saves():
    at_risk = run(None, -0.5)
    assert last_way_out(Countdown(), Run(**{**vars(at_risk), "states": list(range(T))}), FAILED) == Countdown.since
    late = list(range(T, 2 * T))
    assert last_way_out(Countdown(), Run(**{**vars(at_risk), "states": late}), FAILED) is None and HORIZON > 10
