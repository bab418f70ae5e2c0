"""What the models say at each tick: by compiled graphs if the law asks for them, else by torch.

Graphs are an option (`law.engine: onnx`), for they say what torch says to five digits and not to the last bit. They are
made between episodes, for one robot on the CPU, and are compared with torch before they are used. Whatever does not fit
them, or fails, is done by torch; that is said once, and loudly.
"""

import logging
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lerobot_latentsafe.latent import Latent, map_latent
from lerobot_latentsafe.runtime.onnx_graph import TOLERANCE, Graph, GraphError
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.tick import Frame, Thought, think, together

logger = logging.getLogger(__name__)

PROBES = 4
"""Frames about which both are asked before a graph is used."""
Numbers = dict[str, Tensor]


class Hold(NamedTuple):
    """What the law `nearest` asks of one robot: V of so many actions, each held; and whether roughly."""

    n: int
    roughly: bool


class Thinking:
    """Asks the models of a filter.

    Args:
        model: a trained safety model, and by its configuration the law.
        holds: what the law `nearest` asks.
    """

    def __init__(self, model: SafetyModel, holds: Iterable[Hold] = ()):
        self.model, self.holds = model, list(holds)
        self._told: set[str] = set()
        self._drop()

    def __getstate__(self) -> dict[str, Any]:
        """A copy has no graphs until it is prepared."""
        return {"model": self.model, "holds": self.holds}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)

    def _drop(self) -> None:
        self._graphs: dict[object, Graph] = {}
        self._weights: list[Tensor] = []
        self._made_for: tuple | None = None

    # -- asking ---

    def think(self, latent: Latent, begins: Tensor, frame: Frame, blind: Tensor | None = None) -> Thought:
        """See `tick.think`."""
        if blind is None and self._compiles:
            answer = self._answer("think", _numbers(latent, begins, frame))
            if answer is not None:
                return Thought(_under("latent", answer), *(answer[name] for name in Thought._fields[1:]))
        return think(self.model, latent, begins, frame, blind)

    def hold(self, latent: Latent, heard: Tensor, roughly: bool) -> Tensor:
        """V of actions (N R, A), as they are heard, each held from latents (R, ...), N times over: (N R,)."""
        given = {**_over("latent", latent), "heard": heard}
        answer = self._answer(Hold(len(heard), roughly), given) if self._compiles else None
        return (_hold(self.model, roughly, **given) if answer is None else answer)["value"]

    @property
    def compiled(self) -> bool:
        """Whether graphs answer."""
        return self._compiles and bool(self._graphs)

    @property
    def _compiles(self) -> bool:
        return self.model.config.law.engine == "onnx"

    def _answer(self, of: object, given: Numbers) -> Numbers | None:
        """What a graph says; None where torch is to be asked."""
        if self._made_for != self._now():
            other = "it is of another law, or of other weights, until the next episode begins"
            self._say("it is made by Shield.warm_up, which nobody called" if self._made_for is None else other)
            return None
        graph = self._graphs.get(of)
        if graph is None or not graph.fits(given):
            if self._graphs:  # else why is said already
                self._say("it decides for one robot on the CPU, and was asked something else")
            return None
        try:
            return graph(given)
        except Exception as e:
            self._graphs = {}
            self._say(f"it failed ({type(e).__name__}: {e})")
            return None

    def _say(self, why: str) -> None:
        if why not in self._told:
            self._told.add(why)
            logger.warning("THE COMPILED FILTER IS NOT USED: %s. Torch decides instead, as well but slower", why)

    def _now(self) -> tuple:
        """What graphs hold of law and weights; of another law, or of weights that were changed, they say nothing."""
        law = self.model.config.law
        rule = law.name, law.proposal_steps, law.lookahead, law.samples, law.history_frames
        return *rule, [0 if weight.is_inference() else weight._version for weight in self._weights]

    # -- making graphs ---

    @torch.no_grad()
    def prepare(self, images: dict[str, Tensor]) -> None:
        """Make the graphs that the law asks for, if any, and compare them with torch; that takes seconds.

        Args:
            images: camera key -> (1, 3, S, S) in [0, 1], of any content.
        """
        perception = self.model.world_model.frozen_perception()
        if perception is not None:
            perception.use_graphs(self._compiles)
        if not self._compiles or self.model.config.law.name == "guard":
            return
        weights = [*self.model.parameters(), *self.model.buffers()]
        known = len(weights) == len(self._weights) and all(a is b for a, b in zip(weights, self._weights))
        if known and self._made_for == self._now():
            return
        self._drop()
        self._weights = weights
        self._made_for = self._now()
        try:
            self._graphs = self._made(images)
        except GraphError as e:
            self._say(str(e))
        except Exception as e:
            self._say(f"it could not be made ({type(e).__name__}: {e})")

    def _made(self, images: dict[str, Tensor]) -> dict[object, Graph]:
        model, law = self.model, self.model.config.law
        if model.device.type != "cpu":
            raise GraphError(f"it is made for the CPU, and this filter is on {model.device.type}")
        if law.samples:
            raise GraphError(f"it draws no futures, and law.samples is {law.samples}; expected 0")
        probes = list(_probes(model, images))
        perception = model.world_model.frozen_perception()
        if perception is not None:
            perception.compile()
        graphs: dict[object, Graph] = {"think": _compared(model, _think, probes)}
        latent = {key: value[:1] for key, value in _under("latent", probes[-1]).items()}
        for hold in self.holds if law.name == "nearest" else []:
            heard = [torch.cat([probe["ahead"][:, 0]] * hold.n) * torch.rand(hold.n, 1) for probe in probes]
            asked = [{**_over("latent", latent), "heard": actions} for actions in heard]
            graphs[hold] = _compared(model, partial(_hold, roughly=hold.roughly), asked)
        return graphs


# -- what is asked, by names ---


def _over(name: str, latent: Latent) -> Numbers:
    return {f"{name}.{key}": value for key, value in latent.items()}


def _under(name: str, numbers: Numbers) -> Latent:
    return {key.removeprefix(f"{name}."): value for key, value in numbers.items() if key.startswith(f"{name}.")}


def _numbers(latent: Latent, begins: Tensor, frame: Frame) -> Numbers:
    whole = frame._asdict() | {"begins": begins}
    return {**_over("latent", latent), **_over("percepts", whole.pop("percepts")), **whole}


def _think(model: SafetyModel, **given: Tensor) -> Numbers:
    frame = Frame(_under("percepts", given), given["state"], given["led"], given["ahead"])
    thought = think(model, _under("latent", given), given["begins"], frame)._asdict()
    return {**_over("latent", thought.pop("latent")), **thought}


def _hold(model: SafetyModel, roughly: bool, **given: Tensor) -> Numbers:
    latent, heard = _under("latent", given), given["heard"]
    n = len(heard) // len(latent["action"])
    latent = map_latent(latent, lambda t: t.repeat(n, *[1] * (t.dim() - 1)))
    return {"value": model.value_of_holding(latent, heard, roughly)}


def _probes(model: SafetyModel, images: dict[str, Tensor]) -> Iterable[Numbers]:
    """What one robot asks along an episode of noise."""
    generator = torch.Generator().manual_seed(0)
    world_model, n_ticks = model.world_model, model.config.world_model.frame_skip
    memories = 2 if model.config.world_model.steps(model.config.law.history_frames) >= 2 else 1
    latent, begins = together([None] * memories, world_model.initial(1))
    n_actions, n_states = len(model.units.action_low), len(model.units.state_mean)
    for _ in range(PROBES):
        noise = {key: torch.rand(value.shape, generator=generator) for key, value in images.items()}
        ahead, led = 2 * torch.rand(2, 1, n_ticks, n_actions, generator=generator) - 1
        state = torch.randn(1, n_states, generator=generator)
        asked = _numbers(latent, begins, Frame(world_model.perceive(noise), state, led.flatten(1), ahead))
        yield asked
        latent, begins = _under("latent", _think(model, **asked)), torch.zeros_like(begins)


def _compared(model: SafetyModel, function: Callable[..., Numbers], asked: list[Numbers]) -> Graph:
    """A function as a graph that says the same of all that is asked.

    Raises:
        GraphError: there is none, or it does not.
    """
    graph = Graph(model, function, asked[0])
    apart = [name for given in asked for name in _differing(function(model, **given), graph(given))]
    # Where two ways back are as good as each other, rounding chooses: not at each frame, though.
    wrong = [name for name in apart if name != "action" or apart.count(name) > len(asked) // 2]
    if wrong:
        raise GraphError(f"it says another {wrong[0]} than torch")
    return graph


def _differing(expected: Numbers, said: Numbers) -> list[str]:
    """Names of what is not the same, up to TOLERANCE; what is no number must be none in both."""
    same = partial(torch.allclose, rtol=TOLERANCE, atol=TOLERANCE, equal_nan=True)
    return [name for name, value in expected.items() if not same(said[name].float(), value.float())]
