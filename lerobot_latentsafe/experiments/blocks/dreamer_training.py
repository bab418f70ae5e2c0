"""Training the task policy online: demonstrations, then episodes of its own, and imagination in between.

Everything a step draws depends on the seed and its number, and everything an episode draws on the seed and its number,
so a run that was killed goes on from its last checkpoint as if nothing had happened.
"""

import json
import shutil
import time
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import draccus
import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.optim.optimizers import load_optimizer_state, save_optimizer_state
from torch import Tensor

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.datasets.adoption import adopt_dataset
from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.experiments.blocks.cuda_graph import Replayed
from lerobot_latentsafe.experiments.blocks.recorders import Recorders, number
from lerobot_latentsafe.experiments.blocks.replay import CAMERA_KEYS, Replay, export
from lerobot_latentsafe.franka.actions import ACTION_NAMES, STATE_NAMES
from lerobot_latentsafe.policies.dreamer.configuration_dreamer import LatentSafeDreamerConfig
from lerobot_latentsafe.policies.dreamer.modeling_dreamer import LatentSafeDreamerPolicy
from lerobot_latentsafe.runtime.files import claim, discard, locked_folder, replacing, replacing_folder
from lerobot_latentsafe.runtime.hub import save_policy
from lerobot_latentsafe.runtime.malloc import keep_freed_memory
from lerobot_latentsafe.runtime.options import require_at_least
from lerobot_latentsafe.safety_model import SafetyModel

OPTIONS, LOG = "options.json", "log.jsonl"
LEAST = dict.fromkeys(
    ("demonstrations", "steps", "collect_every", "n_envs", "batch_size", "save_every", "log_every"), 1
) | dict.fromkeys(("pretraining", "workers", "seed"), 0)
"""Option -> its least value."""


@dataclass
class TrainDreamer:
    """Learn the blocks' task policy, with its world model and failure margin, from demonstrations and its own episodes.

    latentsafe train-dreamer --config_path=configs/blocks_dreamer.yaml --output_dir=outputs/dreamer

    A killed run goes on if it is started again. Afterwards <output_dir>/policy is the task policy, <output_dir>/policy/
    world_model what `latentsafe train-reachability` takes as --policy.path, and <output_dir>/episodes the dataset that
    goes with it.
    """

    output_dir: Path
    """The folder to write."""
    policy: PreTrainedConfig
    """A latentsafe_dreamer configuration: the actor-critic and its rewards."""
    model: PreTrainedConfig
    """A latentsafe configuration: world model and margin, and the filter to come."""
    repo_id: str = "local/blocks_dreamer"
    """Of the dataset that is written."""
    demonstrations: int = 200
    """Episodes of the scripted operators of the source blocks_demos, pushed aside now and then."""
    pretraining: int = 2000
    """Steps on demonstrations alone: world model, margin and cloning."""
    steps: int = 10_000
    """All steps; over the last fifth step sizes fall, so a longer run is another one."""
    collect_every: int = 100
    """Steps between rounds of episodes."""
    n_envs: int = 8
    """Episodes of a round; they join the batches when the next one begins."""
    workers: int = 0
    """Processes that record episodes while this one trains; 0: it does so itself."""
    cuda_graph: bool = True
    """On a GPU, replay a step as one graph; what is learned is the same."""
    batch_size: int = 20
    """Clips of a step."""
    demonstration_share: float = 0.1
    """Of a batch, at least; more while they are a larger share of all episodes."""
    save_every: int = 1000
    """Steps between checkpoints, from which a killed run goes on."""
    log_every: int = 100
    """Steps between lines of the log."""
    seed: int = 0
    """Of all that is drawn."""

    def __post_init__(self) -> None:
        for name, expected in (("policy", LatentSafeDreamerConfig), ("model", LatentSafeConfig)):
            if not isinstance(getattr(self, name), expected):
                found = getattr(self, name).type
                wanted = "latentsafe_dreamer" if name == "policy" else "latentsafe"
                raise ValueError(f"--{name}.type is {found!r}; expected {wanted}")
        if self.model.world_model.type != "rssm":
            raise ValueError(f"--model.world_model.type is {self.model.world_model.type!r}; expected 'rssm'")
        if self.model.world_model.frame_skip != 1:
            raise ValueError(
                f"--model.world_model.frame_skip is {self.model.world_model.frame_skip}; a policy that learns in "
                "imagination acts at every step of it: expected 1"
            )
        for name, least in LEAST.items():
            require_at_least(f"--{name}", getattr(self, name), least)
        if self.pretraining > self.steps:
            raise ValueError(f"--pretraining is {self.pretraining}; expected 0 to --steps, {self.steps}")
        if not 0 <= self.demonstration_share <= 1:
            raise ValueError(f"--demonstration_share is {self.demonstration_share}; expected 0 to 1")

    @property
    def n_rounds(self) -> int:
        """Rounds of the policy's own episodes."""
        return -(-(self.steps - self.pretraining) // self.collect_every)

    def run(self) -> None:
        """Train, or go on training, and say where the results are."""
        with locked_folder(self.output_dir):
            DreamerTraining(self).run()
        print(f"task policy in {self.output_dir / 'policy'}, its episodes in {self.output_dir / 'episodes'}")


class DreamerTraining:
    """The run that a `TrainDreamer` describes, from wherever it stopped."""

    def __init__(self, options: TrainDreamer):
        self.options, self.folder = options, Path(options.output_dir)
        self._claim()
        self.image_size = options.model.world_model.image_size
        self.recorders = Recorders(options.seed, self.image_size, options.workers)
        self.scene, length = self.recorders.env.scene, self.recorders.env._max_episode_steps
        n_episodes = options.demonstrations + options.n_rounds * options.n_envs
        device = options.model.device
        self.replay = Replay.open(self.folder / "replay", n_episodes, length, self.image_size, device)
        self.started = time.process_time()
        self.coming: Iterable[tuple[int, dict[str, np.ndarray]]] = []
        self._record_demonstrations()
        self._load() if self._checkpoints() else self._begin()
        self._forget_later_rows()
        if device == "cpu":
            keep_freed_memory()
        else:
            torch.set_float32_matmul_precision("high")

    def run(self) -> LatentSafeDreamerPolicy:
        """Train to the end, and write the policy and its episodes."""
        options = self.options
        while self.step < options.steps:
            since = self.step - options.pretraining
            if since >= 0 and since % options.collect_every == 0:
                self._begin_round(since // options.collect_every)
            metrics = self.update()
            self.step += 1
            if self.step % options.log_every == 0:
                self._note({name: torch.as_tensor(value).item() for name, value in metrics.items()})
            if self.step % options.save_every == 0 or self.step == options.steps:
                self._save()
        self.policy.eval()
        if not (self.folder / "policy").exists():
            with replacing_folder(self.folder / "policy") as folder:
                save_policy(self.policy, folder)
        if not (self.folder / "episodes").exists():
            export(self.replay, len(self.replay.written), self.folder / "episodes", options.repo_id, self.scene)
        self._note({"simulator_steps": len(self.replay.written) * self.replay.length})
        self.recorders.close()
        return self.policy

    # -- episodes ---

    @property
    def n_episodes(self) -> int:
        """Episodes that batches are drawn from at this step: demonstrations, then rounds of the policy's."""
        options = self.options
        rounds = (self.step - options.pretraining) // options.collect_every
        return options.demonstrations + min(max(rounds, 0), options.n_rounds) * options.n_envs

    def _record_demonstrations(self) -> None:
        """By the scripted operators; episodes that are there already stay."""
        missing = np.flatnonzero(~self.replay.written[: self.options.demonstrations]).tolist()
        for i, episode in zip(missing, self.recorders(missing, None)):
            self.replay.write(i, episode)

    def _begin_round(self, index: int) -> None:
        """Of the policy as it is, exploring; the round before is finished first."""
        self._finish_round()
        options, folder = self.options, self.folder / "acting"
        shutil.rmtree(folder, ignore_errors=True)
        self.policy.save_pretrained(folder / str(index))
        first = options.demonstrations + index * options.n_envs
        episodes = list(range(first, first + options.n_envs))
        self.coming = zip(episodes, self.recorders(episodes, folder / str(index)))

    def _finish_round(self) -> None:
        outcomes = []
        for i, episode in self.coming:
            self.replay.write(i, episode)
            violation = bool(episode["failure"].any())
            outcomes.append({"success": bool(episode["terms"][-1, 1]) and not violation, "violation": violation})
        self.coming = []
        if outcomes:
            counts = {name: sum(o[name] for o in outcomes) for name in outcomes[0]}
            self._note({"episodes": i + 1, **counts})

    # -- learning ---

    def update(self) -> dict[str, Tensor]:
        """One step on world model, margin, rewards, actor and critic."""
        torch.manual_seed(number(self.options.seed, 2, self.step))
        metrics = self.backpropagate(*self._batch())
        for name in self.optimizers:
            self._descend(name)
        self.policy.follow_slowly()
        return metrics

    def _backpropagate(
        self, reward: Tensor, meant: Tensor, demonstrated: Tensor, starts: Tensor, weights: Tensor, front: Tensor,
        wrist: Tensor, *rest: Tensor,
    ) -> dict[str, Tensor]:  # fmt: skip
        """Gradients of all losses, and metrics; for `Replayed`. The arguments are those of `_batch`."""
        for optimizer in self.optimizers.values():
            optimizer.zero_grad(set_to_none=True)
        policy, clip = self.policy, Clip(dict(zip(CAMERA_KEYS, (front, wrist))), *rest)
        loss, features, metrics = policy.model_loss(clip, reward)
        # Cloning shapes the latents, too: the few pixels that tell where to grasp weigh little in the images' error.
        cloning_loss = policy.cloning_loss(features, meant, clip.valid & demonstrated[:, None])
        features = features.detach()
        start = policy.model.world_model.latent_of(features.flatten(0, 1)[starts], clip.action.flatten(0, 1)[starts])
        actor_loss, critic_loss, imagined = policy.behavior_losses(start)
        (loss + critic_loss + weights[0] * actor_loss + weights[1] * cloning_loss).backward()
        metrics = {"loss": loss, "loss_cloning": cloning_loss, **metrics, **imagined}
        return {name: torch.as_tensor(value).detach() for name, value in metrics.items()}

    def _descend(self, name: str) -> None:
        """A gradient step; step sizes rise over the first 100 steps, and fall to nothing over the last fifth."""
        optimizer, steps = self.optimizers[name], self.options.steps
        scale = min(1.0, (self.step + 1) / 100, 5 * (steps - self.step) / steps)
        parameters = []
        for group, lr in zip(optimizer.param_groups, self.step_sizes[name]):
            group["lr"] = lr * scale
            parameters += group["params"]
        torch.nn.utils.clip_grad_norm_(parameters, self.policy.model.config.grad_clip_norm)
        optimizer.step()

    def _batch(self) -> tuple[Tensor, ...]:
        """What a step learns from.

        Returns:
            Rewards of a clip's windows (B, T); actions meant after each frame (B, T, A), in [-1, 1]; which rows are
            demonstrations, bool (B,); the frames of the flat clip from which imagination starts (N,); weights of actor
            and cloning (2,); and what a `Clip` is made of.
        """
        options, policy = self.options, self.policy
        config, device = policy.config.behavior, policy.model.device
        rng = np.random.default_rng([options.seed, self.step])
        model = policy.model
        reader = self.replay.reader(self.n_episodes, model.config.world_model.clip_length, model.units)
        n_frames, n_demonstrated = len(reader.labels.failure), options.demonstrations * self.replay.length
        # A few episodes of the policy would be learned by heart if they made up most of a batch.
        share = max(options.demonstration_share, n_demonstrated / n_frames)
        n = max(1, round(share * options.batch_size))
        demonstrated = np.arange(options.batch_size) < n
        first = np.where(
            demonstrated,
            rng.integers(n_demonstrated, size=options.batch_size),
            rng.integers(min(n_demonstrated, n_frames - 1), n_frames, size=options.batch_size),
        )
        clip = reader.cut(first, model.world_model)
        ahead = first[:, None] + np.arange(reader.length)
        window = np.minimum(ahead, n_frames - 1)
        reward = config.rewards.reward(torch.from_numpy(self.replay.arrays["terms"][window]))
        meant = torch.from_numpy(self.replay.arrays["meant"][window]).to(device)
        meant = model.units.normalise_action(meant).clamp(-1, 1)
        same = reader.labels.episode[window] == reader.labels.episode[first][:, None]
        valid = np.flatnonzero(same & (ahead == window))
        # At first the critic only learns what imitation is worth.
        weights = [1.0, config.cloning] if self.step >= options.pretraining else [0.0, 1.0]
        drawn = (reward, meant, torch.from_numpy(demonstrated), torch.from_numpy(rng.choice(valid, config.starts)))
        percepts, *rest = (getattr(clip, field.name) for field in fields(Clip))
        return (
            *(t.to(device) for t in (*drawn, torch.tensor(weights))),
            *(percepts[key] for key in CAMERA_KEYS),
            *rest,
        )

    # -- files ---

    def _begin(self) -> None:
        """Fresh weights, for what the demonstrations hold."""
        options = self.options
        torch.manual_seed(number(options.seed, 0, 0))
        config, shape = options.model, (3, self.scene.image_size, self.scene.image_size)
        other = {"gripper.pos": "other"}  # the actor commands a width, not by how much the fingers move
        known = replace(config.trained_on, cameras=list(CAMERA_KEYS), task=self.scene.task, meanings=other)
        config.change(
            input_features={
                **{key: PolicyFeature(FeatureType.VISUAL, shape) for key in CAMERA_KEYS},
                "observation.state": PolicyFeature(FeatureType.STATE, (len(STATE_NAMES),)),
            },
            output_features={"action": PolicyFeature(FeatureType.ACTION, (len(ACTION_NAMES),))},
            trained_on=adopt_dataset(known, self.replay.contract(options.demonstrations, self.scene.fps)),
        )
        self._train(LatentSafeDreamerPolicy(options.policy, SafetyModel(config).to(config.device)), 0)

    def _train(self, policy: LatentSafeDreamerPolicy, step: int) -> None:
        self.policy, self.step = policy.train(), step
        self.backpropagate = self._backpropagate
        if self.options.cuda_graph and policy.model.device.type == "cuda":
            changed = [*policy.buffers(), *policy.model.buffers()]
            self.backpropagate = Replayed(self._backpropagate, changed)
        config, model = policy.config.behavior, policy.model
        learned = [*model.world_model.parameters(), *model.margin.parameters(), *policy.reward.parameters()]
        actor, critic = list(policy.actor.parameters()), list(policy.critic.parameters())
        parts = {
            "model": [(learned, config.model_lr)],
            "behavior": [(actor, config.actor_lr), (critic, config.critic_lr)],
        }
        self.step_sizes = {name: [lr for _, lr in groups] for name, groups in parts.items()}
        self.optimizers = {
            name: torch.optim.Adam([{"params": p} for p, _ in groups], fused=True) for name, groups in parts.items()
        }

    def _checkpoints(self) -> list[Path]:
        return sorted(p for p in (self.folder / "checkpoints").glob("*") if p.name.isdigit())

    def _save(self) -> None:
        """Write a checkpoint whole, then drop the one before; a round that is being recorded is kept, too."""
        self._finish_round()
        before = self._checkpoints()
        with replacing_folder(self.folder / "checkpoints" / f"{self.step:07d}") as folder:
            save_policy(self.policy, folder / "policy")
            save_optimizer_state(self.optimizers, folder / "optimizers")
        for folder in before:
            discard(folder)

    def _load(self) -> None:
        folder = self._checkpoints()[-1]
        self._train(LatentSafeDreamerPolicy.from_pretrained(folder / "policy"), int(folder.name))
        load_optimizer_state(self.optimizers, folder / "optimizers")

    def _claim(self) -> None:
        """Note what this folder's run is, and refuse to go on with another.

        Raises:
            OtherRunError: the folder holds a run with other options.
        """
        wanted = json.loads(json.dumps(draccus.encode(self.options)))
        for name in ("output_dir", "log_every", "workers", "cuda_graph"):
            del wanted[name]
        claim(self.folder / OPTIONS, wanted)

    def _forget_later_rows(self) -> None:
        """Take from the log what will be done again, and a line that was torn."""
        log = self.folder / LOG
        lines = log.read_text().splitlines() if log.exists() else []
        with replacing(log) as partial:
            partial.write_text("".join(f"{line}\n" for line in lines if self._is_past(line)))

    def _is_past(self, line: str) -> bool:
        try:
            row = json.loads(line)
        except ValueError:
            return False
        return row["step"] <= self.step and "simulator_steps" not in row

    def _note(self, row: dict) -> None:
        row = {"step": self.step, "cpu_s": round(time.process_time() - self.started), **row}
        with (self.folder / LOG).open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(" ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), flush=True)
