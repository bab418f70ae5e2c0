"""What this package does in a second on one GPU, at the papers' sizes, on random clips and with random weights."""

import contextlib
import math
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import draccus
import torch
import yaml
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from torch import Tensor, nn

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.critic import ReachabilityConfig
from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.decision import LawConfig
from lerobot_latentsafe.experiments.blocks.cuda_graph import Replayed
from lerobot_latentsafe.experiments.dubins.training_cost import TrainingCost, authors_step, record
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reachability import LatentReachability
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.shield import Shield
from lerobot_latentsafe.units import TrainedOn
from lerobot_latentsafe.world_models import DinoWMConfig, RSSMConfig
from lerobot_latentsafe.world_models.base import WorldModel
from lerobot_latentsafe.world_models.dino_wm import DinoWM

CONFIGS = Path(__file__).parents[2] / "configs"
STATES, ACTIONS, CAMERAS = 8, 7, ["observation.images.front", "observation.images.wrist"]
"""An arm's."""
PATCHES, TOKEN = 256, 384
"""Of a picture of 224 pixels by DINOv2 ViT-S/14."""
PRECISIONS = ("float32", "tf32", "bfloat16", "bfloat16 compiled")


@dataclass(frozen=True)
class Sizes:
    """How much is measured at once.

    Attributes:
        batch: clips of a training step.
        encoded: pictures that are encoded together.
        patches: of a frame of the DINO-WM.
        seconds: each measurement takes about so long.
        rssm, dino_wm, reachability: changes of the papers' configurations.
        vit: width, layers and heads of the encoder.
    """

    batch: int
    encoded: int
    patches: int
    seconds: float
    rssm: dict[str, Any]
    dino_wm: dict[str, Any]
    reachability: dict[str, Any]
    vit: tuple[int, int, int]


PAPER = Sizes(16, 64, PATCHES, 5.0, {}, {}, {}, (384, 12, 6))
TOY = Sizes(
    2, 2, 4, 0.0, dict(image_size=32, clip_length=4, deterministic=8, hidden=8, cnn_depth=2, state_units=8),
    dict(clip_length=4, dim=768, depth=1, heads=2, head_dim=4, mlp=8, summary=4, conditioning="adaln"),
    dict(pool=64, horizon=2, batch_size=8, refresh=2, critic_hidden=(8,), actor_hidden=(8,)), (12, 1, 2),
)  # fmt: skip
"""The same in a second on a CPU, so that the script works the first time that it sees a GPU."""


def measure(device: str, sizes: Sizes, parts: list[str] | None = None) -> dict[str, Any]:
    """All numbers; a part that fails is told, and the others go on.

    Args:
        device: cuda, or cpu to try it.
        parts: names in PARTS; None: all.
    """
    found: dict[str, Any] = {"device": _named(device), "torch": torch.__version__}
    for name in parts or PARTS:
        torch.manual_seed(0)
        found[name] = attempt(lambda part=PARTS[name]: part(torch.device(device), sizes))
        print(name, found[name], flush=True)
        if device == "cuda":
            torch.cuda.empty_cache()
    return found


def _named(device: str) -> str:
    return torch.cuda.get_device_name() if device == "cuda" else device


# -- timing ---


def rate(call: Callable[[], object], device: torch.device, seconds: float, each: int = 1) -> float:
    """How often a second, times `each`: after a call that warms up, until the seconds are over, at least once."""
    call()
    _finish(device)
    n, began = 0, time.perf_counter()
    while n == 0 or time.perf_counter() - began < seconds:
        call()
        n += 1
        if n % 8 == 0:  # what is queued counts when it is done
            _finish(device)
    _finish(device)
    return n * each / (time.perf_counter() - began)


def milliseconds(call: Callable[[], object], device: torch.device, seconds: float) -> dict[str, float]:
    """Median and 99th percentile of calls that are waited for one by one."""
    for _ in range(3):
        call()
    took: list[float] = []
    over = time.perf_counter() + seconds
    while len(took) < 3 or time.perf_counter() < over:
        _finish(device)
        began = time.perf_counter()
        call()
        _finish(device)
        took.append(1e3 * (time.perf_counter() - began))
    took.sort()
    return {"median": took[len(took) // 2], "p99": took[math.ceil(0.99 * len(took)) - 1]}


def _finish(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()


@contextlib.contextmanager
def precision(name: str, device: torch.device) -> Iterator[None]:
    """One of PRECISIONS, without what is compiled."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if name == "tf32" else "highest")
    try:
        with torch.autocast(device.type, torch.bfloat16, enabled=name.startswith("bfloat16")):
            yield
    finally:
        torch.set_float32_matmul_precision(before)


def waits(call: Callable[[], object], device: torch.device) -> list[str]:
    """Where a call makes the host wait for the GPU: file:line of each, by torch's own watch; none on a CPU."""
    if device.type != "cuda":
        return []
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return sorted({f"{Path(w.filename).name}:{w.lineno}" for w in caught if "synchroniz" in str(w.message)})


# -- world models ---


def preset(file: str) -> LatentSafeConfig:
    """A configuration in configs/."""
    return draccus.decode(PreTrainedConfig, yaml.safe_load((CONFIGS / file).read_text())["policy"])


def rssm(sizes: Sizes) -> RSSMConfig:
    """The paper's RSSM."""
    config: RSSMConfig = replace(preset("dubins_rssm_paper.yaml").world_model, **sizes.rssm)
    return config


def dino_wm(sizes: Sizes, device: torch.device) -> DinoWM:
    """The paper's DINO-WM, which reads tokens of two cameras."""
    config: DinoWMConfig = replace(preset("bag_dino_wm_paper.yaml").world_model, **sizes.dino_wm)
    return DinoWM(config, CAMERAS, STATES, ACTIONS, sizes.patches, len(CAMERAS) * TOKEN).to(device)


def random_clip(percepts: Mapping[str, tuple[int, ...]], batch: int, length: int, device: torch.device) -> Clip:
    """Clips of noise, of which half fail at their end.

    Args:
        percepts: name -> shape of a frame.
    """
    shape = (batch, length)
    first = torch.zeros(shape, dtype=torch.bool, device=device)
    first[:, 0] = True
    failure = torch.zeros(shape, dtype=torch.long, device=device)
    failure[::2, -1] = 1
    return Clip(
        {name: torch.rand(*shape, *size, device=device) for name, size in percepts.items()},
        torch.randn(*shape, STATES, device=device), 2 * torch.rand(*shape, ACTIONS, device=device) - 1, first,
        torch.ones_like(first), failure, torch.zeros_like(failure),
    )  # fmt: skip


def training(
    model: WorldModel, clip: Clip, device: torch.device, seconds: float, compiled: str = "loss"
) -> dict[str, Any]:
    """Frames a second of training steps, by precision; and where a step waits for the GPU.

    Args:
        compiled: the method that is compiled.
    """
    optimizer = torch.optim.Adam(model.parameters(), 1e-4, fused=device.type == "cuda")
    found: dict[str, Any] = {"batch": len(clip.valid), "clip": clip.valid.shape[1], "compiled": compiled}

    def step(name: str) -> None:
        with precision(name, device):
            value = model.loss(clip)[0]
        optimizer.zero_grad()
        value.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1000.0)
        optimizer.step()

    frames = lambda name: rate(lambda: step(name), device, seconds, clip.valid.numel())  # noqa: E731
    for name in PRECISIONS[:3]:
        found[f"frames_a_second, {name}"] = frames(name)
    found["waits_of_a_step"] = waits(lambda: step("float32"), device)
    if seconds:  # compiling takes longer than a toy may
        setattr(model, compiled, torch.compile(getattr(model, compiled)))
        found[f"frames_a_second, {PRECISIONS[3]}"] = attempt(lambda: frames(PRECISIONS[3]))
    return found


def attempt(call: Callable[[], Any]) -> Any:
    """What a call returns, or in words why it failed: on a GPU, what was measured before is not lost."""
    try:
        return call()
    except Exception as e:  # those of compilers and drivers have no class in common
        return {"failed": f"{type(e).__name__}: {' '.join(str(e).split())[:200]}"}


def train_rssm(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """The RSSM of the car: one camera. Of it the cell is compiled: a graph of 64 steps takes minutes to compile."""
    config = rssm(sizes)
    model = config.build(CAMERAS[:1], STATES, ACTIONS).to(device).train()
    shape = {CAMERAS[0]: (3, config.image_size, config.image_size)}
    clip = random_clip(shape, sizes.batch, config.clip_length, device)
    return training(model, clip, device, sizes.seconds, "_recur")


def train_dino_wm(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """The DINO-WM of the arm: tokens of two cameras, attention by scaled_dot_product_attention."""
    model = dino_wm(sizes, device).train()
    shape = {"tokens": (sizes.patches, len(CAMERAS) * TOKEN)}
    clip = random_clip(shape, sizes.batch, model.config.clip_length, device)
    return training(model, clip, device, sizes.seconds)


def authors_on(device: str, authors: Path, batch: int = 16, clip: int = 16) -> dict[str, float]:
    """Frames a second of the authors' training steps; clips of 16 frames, as few recorded episodes last longer."""
    with tempfile.TemporaryDirectory() as name:
        record(Path(name), 3 * batch, seed=0)
        step = authors_step(Path(name), TrainingCost(authors.resolve(), batch, clip, 1, 1, 0), device)
        return {"batch": batch, "clip": clip, "frames_a_second": rate(step, torch.device(device), 5.0, batch * clip)}


# -- the filter ---


def arm_filter(sizes: Sizes, device: torch.device) -> LatentSafePolicy:
    """A filter of an arm with two cameras and the paper's RSSM, as if it were trained."""
    states, actions = [f"joint_{i}.pos" for i in range(STATES)], [f"delta_{i}" for i in range(ACTIONS)]
    image = PolicyFeature(FeatureType.VISUAL, (3, sizes.rssm.get("image_size", 128), sizes.rssm.get("image_size", 128)))
    config = LatentSafeConfig(
        world_model=rssm(sizes),
        law=LawConfig(lookahead=0),
        reachability=ReachabilityConfig(**sizes.reachability),
        trained_on=TrainedOn(
            stage="critic",
            fps=15,
            cameras=CAMERAS,
            state_names=states,
            action_names=actions,
            action_low=[-1.0] * ACTIONS,
            action_high=[1.0] * ACTIONS,
            action_varies=[True] * ACTIONS,
            state_mean=[0.0] * STATES,
            state_std=[1.0] * STATES,
        ),
        input_features={
            **dict.fromkeys(CAMERAS, image),
            "observation.state": PolicyFeature(FeatureType.STATE, (STATES,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTIONS,))},
        device=device.type,
        push_to_hub=False,
    )
    policy = LatentSafePolicy(config).to(device).eval()
    policy.model.lacks_weights = False
    return policy


def reachability(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """Imagined transitions, and updates of critic and actor, a second."""
    model = arm_filter(sizes, device).model
    latent: Latent = {
        name: torch.randn_like(value) if value.is_floating_point() else value
        for name, value in model.world_model.initial(4096).items()
    }
    starts = lambda n: {name: value[:n] for name, value in latent.items()}  # noqa: E731
    learner = LatentReachability(model.imagination, model.critic, starts, model.config.reachability)
    transitions = learner.chunk * learner.config.horizon
    found = {"transitions_a_second": rate(learner.imagine, device, sizes.seconds, transitions)}
    found["updates_a_second"] = rate(learner.update, device, sizes.seconds)
    found["batch"] = learner.config.batch_size
    return {**found, "waits_of_an_update": waits(learner.update, device)}


class Look(nn.Module):
    """What of a tick is tensors alone: see, step, judge what is, and what the proposal leads to."""

    def __init__(self, model: SafetyModel):
        super().__init__()
        self.model, self.names = model, sorted(model.world_model.initial(1))

    def forward(
        self, front: Tensor, wrist: Tensor, state: Tensor, action: Tensor, *latent: Tensor
    ) -> dict[str, Tensor]:
        """Pictures (1, 3, S, S), state (1, S), action (1, A), and a latent's tensors by name to V and the next one."""
        world_model = self.model.world_model
        seen = world_model.perceive(dict(zip(CAMERAS, (front, wrist))))
        now = world_model.observe(dict(zip(self.names, latent)), action, seen, state)
        features, margin = self.model.imagination.judged(world_model.step(now, action))
        return {"value": self.model.critic.value(features, margin), **now}


def tick(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """Milliseconds of a tick with two cameras: of the whole shield, and of its tensors with and without a graph."""
    policy = arm_filter(sizes, device)
    model, size = policy.model, policy.config.world_model.image_size
    observation = {key: torch.rand(1, 3, size, size, device=device) for key in CAMERAS}
    state, action = torch.zeros(1, STATES, device=device), torch.zeros(1, ACTIONS, device=device)
    shield = Shield(model)
    found: dict[str, Any] = {}
    with torch.inference_mode():
        whole = lambda: shield({**observation, "observation.state": state}, action)  # noqa: E731
        found["shield_ms"] = milliseconds(whole, device, sizes.seconds)
    with torch.no_grad():
        latent = model.world_model.initial(1)
        inputs = (*observation.values(), state, action, *(latent[name] for name in sorted(latent)))
        look = Look(model)
        found["tensors_ms"] = milliseconds(lambda: look(*inputs), device, sizes.seconds)
        if device.type == "cuda":
            replayed = Replayed(look, [])
            found["tensors_by_graph_ms"] = attempt(
                lambda: milliseconds(lambda: replayed(*inputs), device, sizes.seconds)
            )
    return found


# -- encoding ---


class ViT(nn.Module):
    """A transformer of DINOv2's kind and size: patches of 14 pixels, and a class token."""

    def __init__(self, width: int, depth: int, heads: int, patches: int = PATCHES):
        super().__init__()
        self.patch = nn.Conv2d(3, width, 14, 14)
        self.position = nn.Parameter(0.02 * torch.randn(patches + 1, width))
        layer = nn.TransformerEncoderLayer(width, heads, 4 * width, 0.0, "gelu", batch_first=True, norm_first=True)
        self.layers = nn.TransformerEncoder(layer, depth, enable_nested_tensor=False)

    def forward(self, images: Tensor) -> Tensor:
        """(N, 3, 224, 224) to tokens (N, patches + 1, width)."""
        x = self.patch(images).flatten(2).transpose(1, 2)
        return self.layers(nn.functional.pad(x, (0, 0, 1, 0)) + self.position)


def encode(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """Frames of two cameras a second, by precision."""
    model, found = ViT(*sizes.vit).to(device).eval(), {}
    images = torch.rand(sizes.encoded, 3, 224, 224, device=device)
    with torch.inference_mode():
        for name in PRECISIONS[:3]:
            with precision(name, device):
                pictures = rate(lambda: model(images), device, sizes.seconds, sizes.encoded)
            found[f"frames_a_second, {name}"] = pictures / len(CAMERAS)
    return found


PARTS: dict[str, Callable[[torch.device, Sizes], dict[str, Any]]] = {
    "train_rssm": train_rssm,
    "train_dino_wm": train_dino_wm,
    "reachability": reachability,
    "encode": encode,
    "tick": tick,
}
