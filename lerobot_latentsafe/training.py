"""Training on top of a frozen world model: the failure margin by itself, and reachability in imagination."""

import hashlib
import json
import logging
import time
from contextlib import nullcontext, suppress
from dataclasses import asdict, replace
from itertools import count
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import trange

from lerobot_latentsafe.constraint_training import (
    learn_likeness,
    numbered,
    numbers_named,
    with_random_sets,
)
from lerobot_latentsafe.constraints import ConstraintError, LikenessConfig
from lerobot_latentsafe.critic import BACKUPS
from lerobot_latentsafe.datasets.adoption import adopt_dataset
from lerobot_latentsafe.datasets.clips import ClipReader, FilterData
from lerobot_latentsafe.datasets.fingerprints import episode_marks, with_episodes
from lerobot_latentsafe.datasets.labels import read_frames
from lerobot_latentsafe.latent import FRAME, Latent, map_latent, select
from lerobot_latentsafe.margin import FailureMargin, MarginConfig, hinge_loss, slope_between
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.reachability import LatentReachability, Starts
from lerobot_latentsafe.runtime.checkpoint import read_config, weights_digest
from lerobot_latentsafe.runtime.distributed import gathered, rank, share
from lerobot_latentsafe.runtime.files import claim, differing, refuse_existing, replacing_folder
from lerobot_latentsafe.runtime.hub import save_policy
from lerobot_latentsafe.runtime.locations import CONFIG, CheckpointError
from lerobot_latentsafe.runtime.malloc import keep_freed_memory
from lerobot_latentsafe.runtime.options import require_at_least
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.units import TrainedOn

logger = logging.getLogger(__name__)

RUN = "run.json"
"""Of what training a checkpoint is."""
STARTS_BYTES = 2**30
"""Memory for the latents that imagination starts from; those of a transformer hold keys and values and are large."""


@torch.no_grad()
def seen_and_imagined(
    model: SafetyModel, reader: ClipReader, n_clips: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Features (N, D) and labels (N,) of random windows: a few frames are seen, the rest imagined as they were acted.

    A margin that has seen real latents alone is a stranger to imagined ones, and those are what a filter asks about. A
    quarter of the windows begin where episodes do, as whatever a filter sees does.
    """
    world_model, rows = model.world_model, []
    _, begins = np.unique(reader.labels.episode, return_index=True)
    for _ in range(-(-n_clips // 64)):
        first = torch.randint(len(reader.labels.failure), (64,), generator=generator).numpy()
        first[:16] = begins[torch.randint(len(begins), (16,), generator=generator).numpy()]
        clip = reader.cut(first, world_model)
        observed = int(torch.randint(1, clip.state.shape[1] + 1, (), generator=generator))
        latent = None
        for t in range(clip.state.shape[1]):
            if t < observed:
                percepts = {key: value[:, t] for key, value in clip.percepts.items()}
                latent = world_model.observe(latent, clip.action[:, t], percepts, clip.state[:, t])
            else:
                latent = world_model.step(latent, clip.action[:, t])
            kept = clip.valid[:, t] & (clip.failure[:, t] >= 0)
            rows.append((world_model.features(latent)[kept], clip.failure[kept, t]))
    features, failure = (torch.cat(column) for column in zip(*rows))
    return features, failure


def fit_margin(
    margin: FailureMargin, features: Tensor, failure: Tensor, config: MarginConfig, generator: torch.Generator,
    steps: int = 1500,
) -> None:  # fmt: skip
    """Fit a margin (Eq. 3) to fixed features, regularised: trained along with a world model it overfits.

    The hinge loss says little about how far beyond delta a margin goes. It is scaled to a median size of 1, where tanh,
    which bounds it for the backup, still tells a sure margin from a surer one.

    Args:
        config: delta of Eq. 3, and what the fit is regularised by: noise on the features, which are scaled to unit
            deviation meanwhile, and a gradient penalty.
    """
    mean, std = features.mean(0), features.std(0).clamp(min=1e-3)
    layers = [layer for layer in margin.net if isinstance(layer, nn.Linear)]
    first, last = layers[0], layers[-1]
    optimizer = torch.optim.AdamW(margin.parameters(), 1e-3, weight_decay=0.3)
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = 1e-3 * min(1.0, 2 - 2 * step / steps)
        picked = torch.randint(len(features), (512,), generator=generator, device="cpu").to(features.device)
        x = (features[picked] - mean) / std
        x = x + config.noise * torch.randn(x.shape, generator=generator).to(x.device)
        loss = hinge_loss(margin(x), failure[picked], config.delta)
        if config.gradient_penalty:
            loss = loss + config.gradient_penalty * slope_between(margin, x, failure[picked], generator)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
    with torch.no_grad():  # the margin reads features as they are
        first.weight.div_(std)
        first.bias.sub_(first.weight @ mean)
        size = margin(features).abs().median().clamp(min=1e-3)
        last.weight.div_(size)
        last.bias.div_(size)


def fit_new_margin(model: SafetyModel, reader: ClipReader, generator: torch.Generator) -> None:
    """Give a model a fresh margin, fitted to what its frozen world model sees and imagines of recordings."""
    features, failure = seen_and_imagined(model, reader, model.config.margin.clips, generator)
    model.margin = model.new_margin()
    fit_margin(model.margin, features, failure, model.config.margin, generator)


def train_margin(path: str | Path, dataset_meta, output_dir: Path, seed: int = 0) -> LatentSafePolicy:
    """Load a world model, fit a fresh failure margin to its frozen features, save both.

    The critic of another margin says nothing about this one: the stage goes back to `world_model`.

    Returns:
        What was saved; if the same was trained before, what lies there.

    Raises:
        UntrainedFilterError: the world model was never trained.
        FileExistsError: output_dir holds something else.
        FolderInUseError: another process trains there.
        FloatingPointError: the training diverged; nothing is saved.
    """
    require_at_least("--seed", seed, 0)
    policy, reader = load_with_cache(path, dataset_meta, seed)
    run = _run(policy, reader, "margin", seed=seed)
    before = _trained_before(Path(output_dir), run)
    if before is not None:
        return before
    with replacing_folder(output_dir) as folder:
        generator = torch.Generator().manual_seed(seed)
        model, config, started = policy.model, policy.config, time.process_time()
        fit_new_margin(model, reader, generator)
        config.change(trained_on=replace(trained_on_too(policy, reader), stage="world_model"), frame_cache=None)
        _save(policy, model.margin, folder, run)
    print(f"margin: {time.process_time() - started:.0f} CPU-s")
    return policy


def load_with_cache(path: str | Path, dataset_meta, seed: int = 0) -> tuple[LatentSafePolicy, ClipReader]:
    """A filter with a trained world model, and the reader of a cached dataset that fits it.

    Raises:
        UntrainedFilterError: the world model was never trained.
        ValueError: the dataset is another robot's, or not cached.
    """
    torch.manual_seed(seed)
    policy = load_filter(path)
    return policy, cached_reader(policy, dataset_meta)


def cached_reader(policy: LatentSafePolicy, dataset_meta) -> ClipReader:
    """The reader of a cached dataset that fits a filter; errors as of `load_with_cache`."""
    config, trained_on = policy.config, policy.config.trained_on
    policy.model.require_stage("world_model")
    # The cache of the first stage may be gone; the dataset brings its own.
    specification, size = config.margin.failure_specification, config.world_model.image_size
    data = FilterData.open(dataset_meta, specification, None, size, trained_on.cameras)
    adopt_dataset(trained_on, data.contract)
    data.check_cameras({key: config.input_features[key].shape for key in data.cameras})
    reader = data.reader(config.world_model, policy.model.units)
    reader.require_cache()
    config.world_model.of_cache(data.cache.manifest)
    return reader


def trained_on_too(policy: LatentSafePolicy, reader: ClipReader) -> TrainedOn:
    """What a filter was trained on, with the episodes of this dataset among it."""
    return with_episodes(policy.config.trained_on, episode_marks(reader.labels.episode, reader.state, reader.action))


@torch.no_grad()
def encoded_starts(
    model: SafetyModel, reader: ClipReader, generator: torch.Generator, max_frames: int = 100_000, told: bool = False
) -> Starts:
    """Where imagination starts: encodings of random dataset windows, half of a single frame, half of a history.

    Args:
        generator: draws both the windows and the starts.
        max_frames: frames encoded at most; fewer where their latents would not fit in `STARTS_BYTES`.
        told: latents hold which `FRAME` each is.

    Returns:
        A sampler of latents. Several ranks encode a share each and gather all.
    """
    world_model, units = model.world_model, model.units
    latent_bytes = sum(t.nbytes for t in world_model.initial(1).values())
    max_frames = min(max_frames, STARTS_BYTES // (2 * latent_bytes))  # two latents of each
    n, length = len(reader.labels.failure), world_model.config.clip_length
    offset = int(torch.randint(length, (1,), generator=generator))
    first = np.arange(offset, n, length)
    first = first[torch.randperm(len(first), generator=generator)[: max(1, max_frames // length)].numpy()]
    single, filtered = [], []
    first = share(torch.from_numpy(first)).numpy()
    reads = numbered(reader) if told else reader
    for chunk in np.array_split(first, max(1, len(first) // 64)):
        clip = reads.cut(chunk, world_model)
        kept = clip.valid.flatten()
        z = world_model.encode(clip)
        filtered.append(select({k: v.flatten(0, 1) for k, v in z.items()}, kept))
        percepts = {k: v.flatten(0, 1)[kept] for k, v in clip.percepts.items()}
        before = units.first_action(clip.action.flatten(0, 1)[kept])
        single.append(world_model.observe(None, before, percepts, clip.state.flatten(0, 1)[kept]))
        if told:
            frame = {FRAME: clip.failure.flatten()[kept]}
            filtered[-1], single[-1] = {**filtered[-1], **frame}, {**single[-1], **frame}
    pool: Latent = {
        k: torch.cat([gathered(torch.cat([z[k] for z in part])) for part in (single, filtered)]) for k in single[0]
    }
    size = len(next(iter(pool.values())))

    def draw(count: int) -> Latent:
        picked = share(torch.randint(size, (count,), generator=generator)).to(model.device)
        return map_latent(pool, lambda t: t[picked])

    return draw


def covered_actions(model: SafetyModel, reader: ClipReader, coverage: float) -> tuple[list[float], list[float]]:
    """Range of each motion, in [-1, 1], that holds all but a share `coverage` of the data at either end, and zero."""
    columns = (reader.cache.action, reader.cache.state)
    action = model.units.normalise_action(*(torch.from_numpy(np.array(c)).to(model.device) for c in columns))
    ends = torch.tensor([coverage, 1 - coverage], device=action.device)
    low, high = torch.quantile(
        action[torch.linspace(0, len(action) - 1, min(len(action), 100_000)).long()], ends, dim=0
    )
    return low.clamp(-1, 0).tolist(), high.clamp(0, 1).tolist()


def train_reachability(
    path: str | Path, dataset_meta, output_dir: Path, seed: int = 0, steps: int | None = None,
    target: str = "reachability", alike: dict[str, float] | None = None,
) -> LatentSafePolicy:  # fmt: skip
    """Load a stage-1 checkpoint, learn its safety critic, save the filter.

    Args:
        target: what the critic learns: the safety value of Eq. 5, or the `risk` of SQRL.
        alike: number of the recording -> how far apart alike frames may be in it: the critic then takes constraints
            (see `constraints.py`). The failure of the margin becomes the first of them.

    Several ranks share the work (see `LatentReachability`); the first one saves.

    Returns:
        What was saved; if the same was trained before, what lies there.

    Raises:
        UntrainedFilterError: the world model was never trained.
        FileExistsError: output_dir holds something else.
        FolderInUseError: another process trains there.
        FloatingPointError: the training diverged; nothing is saved.
        ValueError: there is no such target, or nothing to be trained.
        ConstraintError: frames cannot be told apart by these numbers.
    """
    if target not in BACKUPS:
        raise ValueError(f"--target is {target!r}; expected one of {', '.join(BACKUPS)}")
    require_at_least("--steps", steps, 1)
    require_at_least("--seeds", seed, 0)
    if alike and target == "risk":
        raise ConstraintError("--alike and --target=risk: a risk is that of one failure; give one of them")
    policy, reader = load_with_cache(path, dataset_meta, seed)
    hinge = policy.config.reachability.hinge
    if hinge and (alike or target == "risk"):
        raise ValueError(
            f"--policy.reachability.hinge is {hinge:g}, which speaks of the safety value of one failure; leave out "
            "--alike and --target=risk, or set it to 0"
        )
    options = {"alike": alike} if alike else {}
    run = _run(policy, reader, "reachability", seed=seed, steps=steps, target=target, **options)
    before = _trained_before(Path(output_dir), run)
    if before is not None:
        return before
    with replacing_folder(output_dir) if rank() == 0 else nullcontext() as folder:
        started = time.process_time()
        numbers = numbers_named(dataset_meta, [*alike]) if alike else None
        likeness = LikenessConfig(alike or {}, own=policy.config.margin.failure_specification)
        succeeds = frames_of_success(dataset_meta.root, reader) if hinge else None
        learn_critic(policy, reader, seed, steps, target, likeness, numbers, succeeds)
        if rank() == 0:
            _save(policy, policy.model.critic, folder, run)
            print(f"reachability: {time.process_time() - started:.0f} CPU-s")
    return policy


def learn_critic(
    policy: LatentSafePolicy, reader: ClipReader, seed: int, steps: int | None, target: str = "reachability",
    likeness: LikenessConfig | None = None, numbers: np.ndarray | None = None, succeeds: np.ndarray | None = None,
) -> None:  # fmt: skip
    """Give a filter a trained critic.

    Args:
        succeeds: bool (N,), the frames of episodes that succeed, for the hinge.
        likeness, numbers: of a critic that takes constraints, and (N, m - 1) of all frames; see `learn_likeness`.
    """
    model = policy.model
    if model.device.type == "cpu":
        keep_freed_memory()
    generator = torch.Generator(device="cpu").manual_seed(seed)
    likeness = likeness or LikenessConfig()
    _aim_at(model, reader, target, steps, likeness)
    require_at_least("--policy.reachability.steps", model.config.reachability.steps, 1)
    model.world_model.requires_grad_(False)
    model.margin.requires_grad_(False)
    goes_on = model.config.reachability.recorded > 0
    starts, known = encoded_starts(model, reader, generator, told=goes_on), {}
    if numbers is not None:
        features, frame = seen_and_imagined(model, numbered(reader), model.config.margin.clips, generator)
        likeness, places = learn_likeness(model.likeness, likeness, numbers, features, frame, generator)
        known = likeness.own_failure
        starts = with_random_sets(starts, places, generator)
    succeeding = None
    if succeeds is not None:
        features, frame = seen_and_imagined(model, numbered(reader), model.config.margin.clips, generator)
        succeeding = features[torch.from_numpy(succeeds)[frame]]
    learner = LatentReachability(
        model.imagination, model.critic, starts, model.config.reachability, succeeding=succeeding,
        recorded=reader.recorded() if goes_on else None,
    )  # fmt: skip
    progress = trange(model.config.reachability.steps, desc="reachability", unit="step", disable=rank() > 0)
    for step in progress:
        metrics = learner.update()
        if step % 200 == 0:
            progress.set_postfix(loss=f"{metrics['critic_loss']:.1e}", gamma=f"{metrics['gamma']:.4f}")
    policy.config.change(
        trained_on=replace(trained_on_too(policy, reader), stage="critic"),
        likeness=replace(likeness, known=known),
        constraints=[*known],
    )
    model.critic.eval()


def frames_of_success(root: Path, reader: ClipReader) -> np.ndarray:
    """The frames of episodes that end in success, by next.success, and never fail: bool (N,).

    Raises:
        ValueError: the dataset does not tell, or no episode does.
    """
    column, labels = read_frames(root, ["next.success"]).get("next.success"), reader.labels
    remedy = "record with an environment or a page that tells, or set --policy.reachability.hinge=0"
    if column is None:
        raise ValueError(f"{root} has no column next.success, which the hinge needs; {remedy}")
    _, of, counts = np.unique(labels.episode, return_inverse=True, return_counts=True)
    success = np.asarray(column).reshape(-1).astype(bool)[np.cumsum(counts) - 1]
    clean = np.bincount(of, labels.failure != 0) == 0
    if not (success & clean).any():
        raise ValueError(f"no episode of {root} ends in success without a failure, which the hinge needs; {remedy}")
    return (success & clean)[of]


def _aim_at(model: SafetyModel, reader: ClipReader, target: str, steps: int | None, likeness: LikenessConfig) -> None:
    """Give a model a fresh critic for this target, and a configuration that says so."""
    config = model.config
    law = replace(config.law, name=target, lookahead=0 if target == "risk" else config.law.lookahead)
    reachability, fallback = config.reachability, config.fallback
    if steps is not None:
        reachability = replace(reachability, steps=steps)
    if not model.critic.discrete:
        low, high = covered_actions(model, reader, reachability.coverage)
        fallback = replace(fallback, low=low, high=high)
    trained_on = replace(config.trained_on, stage="world_model", target=target)
    config.change(
        trained_on=trained_on, law=law, reachability=reachability, fallback=fallback, frame_cache=None,
        likeness=likeness, constraints=[],
    )  # fmt: skip
    model.likeness = model.new_likeness()
    model.critic = model.new_critic()


# -- files ---


def _run(policy: LatentSafePolicy, reader: ClipReader, stage: str, **options: object) -> dict:
    """All that a training depends on, JSON-able."""
    config = policy.config
    groups = {name: asdict(getattr(config, name)) for name in ("margin", "reachability", "fallback")}
    return {
        "stage": stage,
        "weights": weights_digest(policy.state_dict()),
        "dataset": reader.cache.manifest["fingerprint"],
        "labels": hashlib.sha256(reader.labels.failure.astype(np.int8)).hexdigest(),
        **json.loads(json.dumps(groups, default=str)),
        **options,
    }


def _save(policy: LatentSafePolicy, trained: nn.Module, folder: Path, run: dict) -> None:
    """Save a filter and what its training was of, if what was trained is finite.

    Raises:
        FloatingPointError: it is not.
    """
    if not all(tensor.isfinite().all() for tensor in trained.state_dict().values()):
        raise FloatingPointError(
            f"the training diverged: {type(trained).__name__} holds numbers that are not finite, so nothing is saved; "
            "train with another seed, or with smaller steps"
        )
    save_policy(policy, folder)
    claim(folder / RUN, run)


def _trained_before(output_dir: Path, run: dict) -> LatentSafePolicy | None:
    """What the same run has saved already; a checkpoint of a filter that is torn is moved aside.

    Raises:
        FileExistsError: something else is there.
    """
    if not (output_dir / CONFIG).exists():
        return None  # whoever fills the folder refuses what else is in it
    if _is_torn(output_dir):
        aside = next(p for n in count(1) if not (p := output_dir.with_name(f"{output_dir.name}.torn{n}")).exists())
        if rank() == 0:
            output_dir.rename(aside)
            logger.warning("%s held a checkpoint that is not whole; it is now %s", output_dir, aside)
        return None
    if not (output_dir / RUN).exists() or differing(output_dir / RUN, run):
        refuse_existing(output_dir)
    print(f"{output_dir} holds the same already")
    return load_filter(output_dir)


def _is_torn(folder: Path) -> bool:
    """Whether a folder holds a filter that cannot be loaded; other policies are none of ours."""
    try:
        load_filter(folder)
    except CheckpointError:
        with suppress(CheckpointError):
            return read_config(folder).type == LatentSafePolicy.name
        return True
    return False
