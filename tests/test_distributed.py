"""Two ranks of gloo compute what one process does with the doubled batch."""

import os
import subprocess
import sys

import pytest
import tiny
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from safetensors.torch import load_file
from test_train import lerobot_train
from torch.nn.parallel import DistributedDataParallel

from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reachability import LatentReachability
from lerobot_latentsafe.runtime import distributed
from lerobot_latentsafe.training import encoded_starts, train_reachability

WORLD_MODELS = {"rssm": tiny.rssm_config, "gru": tiny.gru_config, "dino_wm": tiny.dino_wm_config}
ACTIONS = {"discrete": tiny.CANDIDATES, "continuous": None}


def train_world_model(root, name, local_updates=1):
    """Losses and weights of four steps on windows of which the last half, the second rank's, run past their ends."""
    torch.manual_seed(distributed.rank())  # weights that differ, until the first rank's are taken over
    meta = tiny.metadata(root)
    policy = tiny.new_policy(meta, world_model=WORLD_MODELS[name](), local_updates=local_updates).train()
    model = policy
    if distributed.world_size() > 1:  # as accelerate does for lerobot-train
        model = DistributedDataParallel(policy, find_unused_parameters=True)
    optimizer = torch.optim.SGD(policy.get_optim_params(), 1e-2)
    torch.manual_seed(1)
    whole = torch.arange(0, 24, 3)
    ends = torch.as_tensor(meta.episodes["dataset_to_index"])[:8] - 3
    losses = []
    for step in range(4):
        loss, metrics = model({"index": distributed.share(torch.cat([whole + step, ends + step]))})
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.get_optim_params(), 1.0)
        optimizer.step()
        policy.update()
        losses.append(distributed.mean_over_ranks(torch.tensor([loss.item(), metrics["loss_margin"]])))
    assert policy.config.trained_on.stage == "world_model"
    weights = {name: w for name, w in policy.state_dict().items() if not name.startswith("model.critic")}
    return {"losses": torch.stack(losses), **weights}


def learn_reachability(root, actions, **changes):
    """Losses, weights and starts of a few updates, with batches and chunks of imagination that two do not divide."""
    torch.manual_seed(0)
    sizes = tiny.reachability_config(batch_size=33, pool=516, refresh=5, **changes)
    policy = tiny.new_policy(
        tiny.metadata(root), fallback_action_candidates=ACTIONS[actions], reachability=sizes
    ).eval()
    policy.model.world_model.ends_seen.fill_(1)  # imagination that ends is started anew, on either rank
    generator = torch.Generator().manual_seed(0)
    starts = encoded_starts(policy.model, policy.reader, generator)
    learner = LatentReachability(policy.model.imagination, policy.model.critic, starts, sizes, generator)
    assert learner.chunk == 129 and learner.pool["ended"].any()
    losses = torch.tensor([list(learner.update().values()) for _ in range(12)])
    return {"losses": losses, **{f"pool {k}": v for k, v in learner.pool.items()}, **policy.model.critic.state_dict()}


def everything(car_cache, car_tokens):
    roots = {"rssm": car_cache, "gru": car_tokens, "dino_wm": car_tokens}
    found = {name: train_world_model(roots[name], name) for name in WORLD_MODELS}
    for name in WORLD_MODELS:
        found[f"{name}, apart"] = train_world_model(roots[name], name, local_updates=2)
    for actions in ACTIONS:
        found[actions] = learn_reachability(car_cache, actions)
        found[f"{actions}, apart"] = learn_reachability(car_cache, actions, local_updates=4)
    return found


def _rank(rank, folder, roots):
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder / 'meeting'}", rank=rank, world_size=2)
    torch.save(everything(*roots), folder / f"{rank}.pt")
    dist.destroy_process_group()


@pytest.fixture(scope="module")
def one(cache_root, token_root):
    return everything(cache_root, token_root)


@pytest.fixture(scope="module")
def two(cache_root, token_root, tmp_path_factory):
    folder = tmp_path_factory.mktemp("ranks")
    mp.spawn(_rank, (folder, (cache_root, token_root)), nprocs=2)
    return [torch.load(folder / f"{rank}.pt") for rank in range(2)]


@pytest.mark.parametrize("name", [*WORLD_MODELS, *ACTIONS])
def test_two_ranks_train_what_one_does(one, two, name):
    for rank in two:
        assert rank[name].keys() == one[name].keys()
        for key, value in one[name].items():
            torch.testing.assert_close(rank[name][key], value, rtol=1e-3, atol=2e-5, msg=lambda m, k=key: f"{k}: {m}")


@pytest.mark.parametrize("name", [*WORLD_MODELS, *ACTIONS])
def test_two_ranks_that_update_apart_agree_in_the_end_on_about_what_one_learns(one, two, name):
    apart, (first, second) = f"{name}, apart", (rank[f"{name}, apart"] for rank in two)
    weights = [key for key in one[apart] if not key.startswith("pool") and key != "losses"]
    for key in weights:
        torch.testing.assert_close(one[apart][key], one[name][key], rtol=0, atol=0)  # a single process has no other
        assert torch.equal(first[key], second[key])
    assert any(not torch.equal(first[key], one[name][key]) for key in weights)
    assert distance({k: first[k] for k in weights}, one[name]) < 0.3 * distance(
        {k: one[name][k] for k in weights}, {k: torch.zeros(()) for k in weights}
    )


def test_a_single_process_is_left_alone():
    x = torch.randn(3, 2)
    assert distributed.world_size() == 1 and distributed.rank() == 0
    assert distributed.mean_over_ranks(x) is x and distributed.gathered(x) is x
    with distributed.joined():
        assert not dist.is_initialized()


def torchrun(*command):
    """Run a module in two processes that find each other; what the first printed."""
    here = ["--standalone", "--local_addr=127.0.0.1", "--nproc_per_node=2"]
    line = [sys.executable, "-m", "torch.distributed.run", *here, "-m", *command]
    environment = {**os.environ, "ACCELERATE_USE_CPU": "true", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(line, env=environment, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def distance(a, b):
    return sum((a[key].float() - b[key].float()).square().sum() for key in a).sqrt()


def test_lerobot_train_on_two_ranks_takes_the_steps_of_one(token_root, tmp_path):
    def options(name, batch_size):
        return (
            "--policy.type=latentsafe", "--policy.device=cpu", "--policy.push_to_hub=false",
            "--policy.world_model.type=gru", f"--policy.world_model.image_size={tiny.TOKEN_SIZE}",
            f"--policy.world_model.perception.components={tiny.COMPONENTS}", "--policy.world_model.clip_length=8",
            "--policy.world_model.hidden=16", "--policy.world_model.units=16",
            f"--dataset.repo_id={tiny.REPO_ID}", f"--dataset.root={token_root}", f"--output_dir={tmp_path / name}",
            f"--batch_size={batch_size}", "--steps=3", "--save_freq=1", "--num_workers=0", "--seed=1",
            # Adam divides gradients by their size: where they are next to nothing, it sees rounding errors.
            "--use_policy_training_preset=false", "--optimizer.type=sgd", "--optimizer.lr=0.01",
            "--scheduler.type=constant_with_warmup", "--scheduler.num_warmup_steps=0",
        )  # fmt: skip

    torchrun("lerobot.scripts.lerobot_train", *options("two", 4))
    lerobot_train(*options("one", 8))

    def weights(name, step):
        return load_file(tmp_path / name / "checkpoints" / f"{step:06d}" / "pretrained_model" / "model.safetensors")

    assert distance(weights("one", 3), weights("two", 3)) < 1e-3 * distance(weights("one", 3), weights("one", 1))
    last = LatentSafePolicy.from_pretrained(tmp_path / "two" / "checkpoints" / "last" / "pretrained_model")
    assert last.config.trained_on.stage == "world_model"


def test_train_reachability_on_two_ranks_saves_once_what_one_learns(tiny_world_model, cache_meta, tmp_path):
    said = torchrun(
        "lerobot_latentsafe.cli", "train-reachability", f"--policy.path={tiny_world_model}",
        f"--dataset.repo_id={tiny.REPO_ID}", f"--dataset.root={cache_meta.root}", f"--output_dir={tmp_path / 'two'}",
    )  # fmt: skip
    assert said.count("filter with a trained critic") == 1
    one = train_reachability(tiny_world_model, cache_meta, tmp_path / "one").model.critic.state_dict()
    two = LatentSafePolicy.from_pretrained(tmp_path / "two").model.critic.state_dict()
    for key, value in one.items():
        torch.testing.assert_close(two[key], value, rtol=1e-3, atol=1e-4, msg=lambda m, k=key: f"{k}: {m}")
