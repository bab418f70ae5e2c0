"""lerobot-train trains stage 1, and goes on where it stopped."""

import sys

import pytest
import tiny
import torch
from safetensors.torch import load_file

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

STEPS = 4


def lerobot_train(*options):
    """The command, in this process: importing LeRobot again takes longer than these four steps."""
    from lerobot.scripts import lerobot_train

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["lerobot-train", *options])
        patch.setattr(lerobot_train, "init_logging", lambda **_: None)  # sets the root logger to DEBUG
        # A new data loader draws from torch's generator, so a resumed run samples other latents: sample none.
        patch.setattr(torch, "randn_like", torch.zeros_like)
        lerobot_train.main()


def checkpoint(output_dir, step):
    return output_dir / "checkpoints" / f"{step:06d}" / "pretrained_model"


@pytest.fixture(scope="module")
def trained(cache_root, tmp_path_factory):
    """Output folder of four steps with a checkpoint at two."""
    output_dir = tmp_path_factory.mktemp("train") / "out"
    sizes = {"type": "rssm", "deterministic": 16, "hidden": 16, "units": 16, "clip_length": 8}
    lerobot_train(
        "--policy.type=latentsafe", "--policy.device=cpu", "--policy.push_to_hub=false",
        *(f"--policy.world_model.{name}={value}" for name, value in sizes.items()),
        f"--policy.fallback.action_candidates={tiny.CANDIDATES}",
        f"--dataset.repo_id={tiny.REPO_ID}", f"--dataset.root={cache_root}", f"--output_dir={output_dir}",
        f"--steps={STEPS}", "--save_freq=2", "--log_freq=1", "--batch_size=8", "--num_workers=0", "--seed=1",
    )  # fmt: skip
    return output_dir


def test_checkpoint_loads_as_a_world_model_without_a_critic(trained):
    policy = LatentSafePolicy.from_pretrained(checkpoint(trained, STEPS))
    assert policy.config.trained_on.stage == "world_model"
    assert policy.config.fallback.action_candidates == tiny.CANDIDATES
    assert policy.config.trained_on.action_names == ["turn_rate.vel", "speed.vel"]


def test_training_moved_the_weights(trained):
    before, after = (load_file(checkpoint(trained, step) / "model.safetensors") for step in (2, STEPS))
    moved = {name.split(".")[1] for name in before if not torch.equal(before[name], after[name])}
    assert {"world_model", "margin"} <= moved and "critic" not in moved


def test_resumed_run_ends_with_the_weights_of_an_uninterrupted_one(trained):
    final = checkpoint(trained, STEPS)
    uninterrupted = load_file(final / "model.safetensors")
    for file in final.iterdir():
        file.unlink()
    last = trained / "checkpoints" / "last"
    last.unlink()
    last.symlink_to("000002")
    lerobot_train(f"--config_path={checkpoint(trained, 2) / 'train_config.json'}", "--resume=true")
    resumed = load_file(final / "model.safetensors")
    assert resumed.keys() == uninterrupted.keys()
    for name, value in resumed.items():
        torch.testing.assert_close(value, uninterrupted[name], atol=1e-6, rtol=1e-5, msg=lambda m, n=name: f"{n}: {m}")
    LatentSafePolicy.from_pretrained(final)  # sealed again


def of_two_processes(root, output_dir, **options):
    return (
        "--policy.type=latentsafe", "--policy.device=cpu", "--policy.push_to_hub=false",
        "--policy.world_model.type=rssm", f"--dataset.repo_id={tiny.REPO_ID}", f"--dataset.root={root}",
        f"--output_dir={output_dir}", *(f"--{name}={value}" for name, value in options.items()),
    )  # fmt: skip


OWN_OPTIMIZER = {
    "use_policy_training_preset": "false", "optimizer.type": "sgd", "scheduler.type": "constant_with_warmup",
    "scheduler.num_warmup_steps": 0,
}  # fmt: skip


@pytest.mark.parametrize("optimizer", [{}, OWN_OPTIMIZER], ids=["preset", "own"])
@pytest.mark.parametrize(
    ("steps", "save_freq", "apart", "says"),
    [
        (10, 8, 4, "--steps is 10, and with --policy.local_updates=4 .* give --steps=8"),
        (8, 3, 4, "--save_freq is 3, and with --policy.local_updates=4 .* give --save_freq=4"),
    ],
)
def test_no_checkpoint_is_saved_between_two_averages(cache_root, tmp_path, steps, save_freq, apart, says, optimizer):
    options = {**optimizer, "steps": steps, "save_freq": save_freq, "policy.local_updates": apart}
    with pytest.raises(ValueError, match=says):
        lerobot_train(*of_two_processes(cache_root, tmp_path / "out", **options))
    assert not (tmp_path / "out" / "checkpoints").exists()


def test_local_updates_below_one_are_refused():
    with pytest.raises(ValueError, match="local_updates is 0; expected at least 1"):
        LatentSafeConfig(local_updates=0)
