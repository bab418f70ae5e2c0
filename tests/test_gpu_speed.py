"""The benchmark for GPUs, at toy size on the CPU, so that it works the first time; and what it finds where one is."""

import pytest
import torch

from lerobot_latentsafe.experiments.gpu_speed import PARTS, TOY, measure

EXPECTED = {
    "train_rssm": {"batch", "clip", "frames_a_second, float32", "frames_a_second, bfloat16", "waits_of_a_step"},
    "train_dino_wm": {"frames_a_second, float32", "frames_a_second, tf32", "frames_a_second, bfloat16"},
    "reachability": {"transitions_a_second", "updates_a_second", "batch"},
    "encode": {"frames_a_second, float32", "frames_a_second, bfloat16"},
    "tick": {"shield_ms", "tensors_ms"},
}


@pytest.mark.parametrize("part", PARTS)
def test_every_part_runs_at_toy_size_on_the_cpu(part):
    found = measure("cpu", TOY, [part])[part]
    assert EXPECTED[part] <= found.keys(), found


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("part", ["train_rssm", "train_dino_wm"])
def test_a_training_step_does_not_wait_for_the_gpu(part):
    assert measure("cuda", TOY, [part])[part]["waits_of_a_step"] == []
