"""CPU time of one step of DINO-WM's predictor, ours against the authors' public code, and of imagination in batches.

Paper's size (256 patches, 788 numbers a token, 3 frames, depth 6, 16 heads), batch 1, one step ahead:

    authors           their ViTPredictor as their planner runs it: the whole window at every step, in training mode
                      (their plan.py loads a model and never calls eval()) and with gradients (its default planner)
    authors_no_grad   the same in evaluation mode without gradients
    window            our transformer on the whole window
    step              our transformer on the last frame, keys and values of the frames before kept: what the shield runs

The same weights, copied in memory: their learned embeddings of the three frames are added to our input, and our keys
are not turned by their age, as theirs are not. In evaluation mode outputs are compared first, and must agree to 1e-5.

Compact size (the default DinoWMConfig without its encoder), `--episodes` imagined at once, per episode and step:

    batch             all episodes in one batch, keys and values kept
    one               one episode after the other, keys and values kept
    one_window        the same, but each step passes over the whole window: what a model without kept keys must do
    authors_compact   their predictor, of the same width and depth, one episode after the other, as their planner does

All in one process, in turn, on one thread, the first round thrown away; CPU time, user and system. Much of the time of
large activations is page faults, which a setting of glibc's malloc avoids (`memory.py`). The authors do not make it, so
the paper's size is timed without it, and then again with it for all (`*_kept_memory`); the compact size is timed
with it for all. The authors' code is not part of this package. Clone https://github.com/gaoyuezhou/dino_wm yourself,
pip install einops, and run

    OMP_NUM_THREADS=1 python scripts/bench_dino_wm.py --authors=PATH --json=results/bag/bench_dino_wm.json
"""

import argparse
import importlib
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import draccus
import torch
import yaml
from torch import Tensor, nn

from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.latent import select
from lerobot_latentsafe.runtime.malloc import keep_freed_memory
from lerobot_latentsafe.world_models import DinoWM, DinoWMConfig, WorldModelConfig
from lerobot_latentsafe.world_models.frame_transformer import FrameTransformer

PAPER = Path(__file__).parents[1] / "configs" / "bag_dino_wm_paper.yaml"
CAMERAS, STATE_DIM, ACTION_DIM = ["front", "wrist"], 14, 7
DROPOUT = 0.1
"""Of the authors' predictor, by its configuration."""
TOLERANCE = 1e-5


def authors_predictor(path: Path, n_patches: int, config: DinoWMConfig, dim: int) -> nn.Module:
    """Their ViTPredictor on the CPU; it names the GPU in one place, which is read as the CPU."""
    if not (path / "models" / "vit.py").exists():
        raise SystemExit(f"--authors={path} lacks models/vit.py; give a clone of gaoyuezhou/dino_wm")
    sys.path.insert(0, str(path))
    vit = importlib.import_module("models.vit")
    to = Tensor.to
    Tensor.to = lambda self, *args, **options: self if args == ("cuda",) else to(self, *args, **options)
    try:
        sizes = dict(num_patches=n_patches, num_frames=config.history, dim=dim, depth=config.depth, heads=config.heads)
        vit.NUM_PATCHES, vit.NUM_FRAMES = n_patches, config.history
        return vit.ViTPredictor(**sizes, mlp_dim=config.mlp, dim_head=config.head_dim, dropout=DROPOUT)
    finally:
        Tensor.to = to


def copy_weights(ours: FrameTransformer, theirs: nn.Module) -> None:
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


def paper_steps(path: Path) -> tuple[dict[str, Callable[[], None]], float]:
    """What is timed at the paper's size, and the largest difference of outputs."""
    config = draccus.decode(WorldModelConfig, yaml.safe_load(PAPER.read_text())["policy"]["world_model"])
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


def compact_steps(path: Path, n_episodes: int) -> dict[str, tuple[Callable[[], None], int, int]]:
    """What is timed at the compact size, how often a round, and the episodes that each call advances by a step."""
    config = DinoWMConfig()
    n_patches, token_dim = 36, 224
    model = DinoWM(config, CAMERAS, STATE_DIM, ACTION_DIM, n_patches, token_dim).eval()
    theirs = authors_predictor(path, n_patches, config, config.dim)
    window = torch.randn(1, config.history * n_patches, config.dim)
    clip = random_clip(n_episodes, config.history + 1, n_patches, token_dim)
    with torch.no_grad():
        latents = {name: value[:, -1] for name, value in model.encode(clip).items()}
        one = {name: value.clone() for name, value in select(latents, slice(1)).items()}
    action, seen = clip.action[:, -1], torch.arange(1, config.history + 1)[None]
    frames = [t[:1, : config.history] for t in (clip.percepts["tokens"], clip.state, clip.action)]
    return {
        "batch": (torch.no_grad()(lambda: model.step(latents, action)), 4, n_episodes),
        "one": (torch.no_grad()(lambda: model.step(one, action[:1])), n_episodes, 1),
        "one_window": (torch.no_grad()(lambda: model._advance(*frames, seen)), n_episodes, 1),
        "authors_compact": (lambda: theirs.train()(window), n_episodes, 1),
    }


def random_clip(batch: int, length: int, n_patches: int, token_dim: int) -> Clip:
    is_first = torch.zeros(batch, length, dtype=torch.bool)
    is_first[:, 0] = True
    unknown = torch.full((batch, length), -1)
    return Clip(
        percepts={"tokens": torch.randn(batch, length, n_patches, token_dim)},
        state=torch.randn(batch, length, STATE_DIM),
        action=2 * torch.rand(batch, length, ACTION_DIM) - 1,
        is_first=is_first, valid=torch.ones_like(is_first), failure=unknown, terminal=unknown,
    )  # fmt: skip


def trained_step(config: DinoWMConfig, batch: int, n_patches: int, token_dim: int) -> Callable[[], None]:
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


def in_turn(functions: dict[str, tuple[Callable[[], None], int, int]], rounds: int) -> dict[str, list[float]]:
    """CPU milliseconds of each function, called so often a round, for each of the episodes that a call advances."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds + 1):
        for name, (function, calls, episodes) in functions.items():
            times[name].append(cpu_ms(function, calls) / episodes)
    return {name: values[1:] for name, values in times.items()}


def cpu_ms(function: Callable[[], None], calls: int) -> float:
    started = time.process_time()
    for _ in range(calls):
        function()
    return 1e3 * (time.process_time() - started) / calls


def spread(values: list[float]) -> dict[str, float]:
    return {"median": statistics.median(values), "low": min(values), "high": max(values)}


def ratio(slow: list[float], fast: list[float]) -> dict[str, float]:
    """Of runs next to each other."""
    return spread([a / b for a, b in zip(slow, fast)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--authors", type=Path, required=True, help="your clone of gaoyuezhou/dino_wm")
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)
    paper, difference = paper_steps(args.authors)
    if difference > TOLERANCE:
        raise SystemExit(f"outputs differ by {difference:.1e}, more than {TOLERANCE:.0e}: not the same computation")
    times = in_turn({name: (function, 1, 1) for name, function in paper.items()}, args.rounds)
    keep_freed_memory()
    again = {f"{name}_kept_memory": (function, 1, 1) for name, function in paper.items()}
    times |= in_turn(again, args.rounds)
    times |= in_turn(compact_steps(args.authors, args.episodes), args.rounds)
    paper_config = draccus.decode(WorldModelConfig, yaml.safe_load(PAPER.read_text())["policy"]["world_model"])
    training = {"compact, 16 clips": trained_step(DinoWMConfig(), 16, 36, 224)}
    training["paper, 1 clip"] = trained_step(paper_config, 1, 256, 768)
    row = {
        "what": "CPU milliseconds (user and system): a step of the predictor; at compact size per episode and step",
        "rounds": args.rounds,
        "episodes": args.episodes,
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
    for name, value in row.items():
        if "_over_" in name:
            print(f"{name:34s} {value['median']:6.2f} ({value['low']:.2f} to {value['high']:.2f})")
    if args.json:
        write_json(args.json, row)


if __name__ == "__main__":
    main()
