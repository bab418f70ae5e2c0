"""CPU time of one step of DINO-WM's predictor, ours against the authors' public code, and of imagination in batches."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import draccus
import torch
import yaml
from torch import Tensor

from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.evaluation.statistics import provenance
from lerobot_latentsafe.experiments.timing import cpu_seconds, ratio, spread
from lerobot_latentsafe.latent import select
from lerobot_latentsafe.runtime.malloc import keep_freed_memory
from lerobot_latentsafe.world_models import DinoWM, DinoWMConfig, WorldModelConfig
from lerobot_latentsafe.world_models.frame_transformer import FrameTransformer

PAPER = Path(__file__).parents[3] / "configs" / "bag_dino_wm_paper.yaml"
CAMERAS, STATE_DIM, ACTION_DIM = ["front", "wrist"], 14, 7
DROPOUT = 0.1
"""Of the authors' predictor, by its configuration."""
TOLERANCE = 1e-5


def authors_predictor(path: Path, n_patches: int, config: DinoWMConfig, dim: int) -> Any:
    """Their ViTPredictor on the CPU; it names the GPU in one place, which is read as the CPU."""
    if not (path / "models" / "vit.py").exists():
        raise SystemExit(f"--authors={path} lacks models/vit.py; give a clone of gaoyuezhou/dino_wm")
    sys.path.insert(0, str(path))
    vit: Any = importlib.import_module("models.vit")
    to = Tensor.to
    Tensor.to = lambda self, *args, **options: self if args == ("cuda",) else to(self, *args, **options)
    try:
        sizes = dict(num_patches=n_patches, num_frames=config.history, dim=dim, depth=config.depth, heads=config.heads)
        vit.NUM_PATCHES, vit.NUM_FRAMES = n_patches, config.history
        return vit.ViTPredictor(**sizes, mlp_dim=config.mlp, dim_head=config.head_dim, dropout=DROPOUT)
    finally:
        Tensor.to = to


def copy_weights(ours: Any, theirs: Any) -> None:
    """Make ours compute what theirs does, but for the embeddings of their frames."""
    ours.angle.zero_()
    ours.norm.load_state_dict(theirs.norm.state_dict())
    for block, (attention, feed_forward) in zip(ours.blocks, theirs.layers):
        pairs = (
            (block.attention_norm, attention.norm), (block.qkv, attention.to_qkv), (block.out, attention.to_out[0]),
            (block.mlp_norm, feed_forward.net[0]), (block.mlp[0], feed_forward.net[1]),
            (block.mlp[2], feed_forward.net[4]),
        )  # fmt: skip
        for to, source in pairs:
            to.load_state_dict(source.state_dict())


def paper_steps(path: Path) -> tuple[dict[str, Callable[[], object]], float]:
    """What is timed at the paper's size, and the largest difference of outputs."""
    config = paper_config()
    n, history, dim = 256, config.history, config.dim
    theirs = authors_predictor(path, n, config, dim)
    ours = FrameTransformer(dim, config.depth, config.heads, config.head_dim, config.mlp, history).eval()
    copy_weights(ours, theirs.transformer)
    tokens, seen = torch.randn(1, history, n, dim), torch.arange(1, history + 1)[None]
    x = tokens + theirs.pos_embedding.detach().view(1, history, n, dim)
    last = slice(history - 1, history)
    with torch.no_grad():
        expected = theirs.eval()(tokens.flatten(1, 2)).view(1, history, n, dim)
        whole, kept = ours(x, seen)
        past = [k[:, -history:-1].clone() for k in kept]
        stepped = ours(x[:, last], seen[:, last], past)[0]
    difference = max(float((whole - expected).abs().max()), float((stepped - expected[:, last]).abs().max()))

    def authors() -> None:
        theirs.train()(tokens.flatten(1, 2))

    return {
        "authors": authors,
        "authors_no_grad": torch.no_grad()(lambda: theirs.eval()(tokens.flatten(1, 2))),
        "window": torch.no_grad()(lambda: ours(x, seen)),
        "step": torch.no_grad()(lambda: ours(x[:, last], seen[:, last], past)),
    }, difference


COMPACT = DinoWMConfig(
    clip_length=9,
    frame_skip=1,
    dim=96,
    depth=3,
    heads=3,
    mlp=384,
    merge_patches=1,
    frame_token=False,
    change_weight=0.7,
)
"""36 tokens of two cameras, every tick: what was compared with the authors' predictor at a size for two cores."""


def compact_steps(path: Path, n_episodes: int) -> dict[str, tuple[Callable[[], object], int, int]]:
    """What is timed at the compact size, how often a round, and the episodes that each call advances by a step."""
    config = COMPACT
    n_patches, token_dim = 36, 224
    model = DinoWM(config, CAMERAS, STATE_DIM, ACTION_DIM, n_patches, token_dim).eval()
    theirs = authors_predictor(path, n_patches, config, config.dim)
    window = torch.randn(1, config.history * n_patches, config.dim)
    clip = random_clip(n_episodes, config.history + 1, n_patches, token_dim)
    with torch.no_grad():
        latents = {name: value[:, -1] for name, value in model.encode(clip).items()}
        one = {name: value.clone() for name, value in select(latents, slice(1)).items()}
    action, seen = clip.action[:, -1], torch.arange(1, config.history + 1)[None]
    before = clip.action[:1, : config.history]
    frames = {name: t[:1, : config.history] for name, t in (("tokens", clip.percepts["tokens"]), ("state", clip.state))}
    return {
        "batch": (torch.no_grad()(lambda: model.step(latents, action)), 4, n_episodes),
        "one": (torch.no_grad()(lambda: model.step(one, action[:1])), n_episodes, 1),
        "one_window": (torch.no_grad()(lambda: model._advance(frames, before, seen)), n_episodes, 1),
        "authors_compact": (lambda: theirs.train()(window), n_episodes, 1),
    }


def paper_config() -> DinoWMConfig:
    """The world model of configs/bag_dino_wm_paper.yaml."""
    return draccus.decode(WorldModelConfig, yaml.safe_load(PAPER.read_text())["policy"]["world_model"])


def random_clip(batch: int, length: int, n_patches: int, token_dim: int) -> Clip:
    """Noise in the shape of a training batch."""
    is_first = torch.zeros(batch, length, dtype=torch.bool)
    is_first[:, 0] = True
    unknown = torch.full((batch, length), -1)
    return Clip(
        percepts={"tokens": torch.randn(batch, length, n_patches, token_dim)},
        state=torch.randn(batch, length, STATE_DIM),
        action=2 * torch.rand(batch, length, ACTION_DIM) - 1,
        is_first=is_first, valid=torch.ones_like(is_first), failure=unknown, terminal=unknown,
    )  # fmt: skip


def trained_step(config: DinoWMConfig, batch: int, n_patches: int, token_dim: int) -> Callable[[], object]:
    """One training step: loss, backward pass, clipping, AdamW."""
    model = DinoWM(config, CAMERAS, STATE_DIM, ACTION_DIM, n_patches, token_dim).train()
    optimizer = torch.optim.AdamW(model.parameters(), 5e-5, fused=True)
    clip = random_clip(batch, config.clip_length, n_patches, token_dim)

    def step() -> None:
        optimizer.zero_grad(set_to_none=True)
        model.loss(clip)[0].backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()

    return step


def in_turn(functions: dict[str, tuple[Callable[[], object], int, int]], rounds: int) -> dict[str, list[float]]:
    """CPU milliseconds of each function, called so often a round, for each of the episodes that a call advances."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds + 1):
        for name, (function, calls, episodes) in functions.items():
            times[name].append(cpu_ms(function, calls) / episodes)
    return {name: values[1:] for name, values in times.items()}


def cpu_ms(function: Callable[[], object], calls: int) -> float:
    """CPU milliseconds of a call, the mean of so many."""
    return 1e3 * sum(cpu_seconds(function) for _ in range(calls)) / calls


def measure(authors: Path, rounds: int, n_episodes: int) -> dict:
    """Milliseconds of everything, and ratios.

    Args:
        authors: a clone of gaoyuezhou/dino_wm.
        rounds: timed, after one to warm up.
        n_episodes: imagined at once.
    """
    torch.manual_seed(0)
    torch.set_num_threads(1)
    paper, difference = paper_steps(authors)
    if difference > TOLERANCE:
        raise SystemExit(f"outputs differ by {difference:.1e}, more than {TOLERANCE:.0e}: not the same computation")
    times = in_turn({name: (function, 1, 1) for name, function in paper.items()}, rounds)
    keep_freed_memory()
    again = {f"{name}_kept_memory": (function, 1, 1) for name, function in paper.items()}
    times |= in_turn(again, rounds)
    times |= in_turn(compact_steps(authors, n_episodes), rounds)
    training = {"compact, 16 clips": trained_step(COMPACT, 16, 36, 224)}
    training["paper, 1 clip"] = trained_step(paper_config(), 1, 256, 768)
    return {
        "what": "CPU milliseconds (user and system): a step of the predictor; at compact size per episode and step",
        "rounds": rounds,
        "episodes": n_episodes,
        "threads": 1,
        "largest_difference_of_outputs": difference,
        "paper_authors_over_step": ratio(times["authors"], times["step"]),
        "paper_authors_no_grad_over_step": ratio(times["authors_no_grad"], times["step"]),
        "paper_authors_over_step_kept_memory": ratio(times["authors_kept_memory"], times["step_kept_memory"]),
        "paper_window_over_step": ratio(times["window"], times["step"]),
        "compact_authors_over_batch": ratio(times["authors_compact"], times["batch"]),
        "compact_one_window_over_batch": ratio(times["one_window"], times["batch"]),
        "compact_one_over_batch": ratio(times["one"], times["batch"]),
        "ms": {name: spread(values) for name, values in times.items()},
        "training_step_ms": {name: min(cpu_ms(step, 1) for _ in range(3)) for name, step in training.items()},
        "torch": torch.__version__,
        **provenance([0]),
    }
