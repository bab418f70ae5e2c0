"""Several processes that train one model, each on its share of a batch: together they compute what one would.

LeRobot's training (accelerate, torchrun) averages gradients over processes, "ranks", of which each has a batch of its
own. A loss that divides by something counted in the batch is then right only if that is counted over all ranks: with
its denominator averaged over ranks, the average of the ranks' losses is the loss of the whole batch.

In a single process all of this does nothing.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
import torch.distributed as dist
from torch import Tensor, nn

from lerobot_latentsafe._compat import send_no_gradients

_alone = False
"""Within `on_its_own`."""


@contextmanager
def joined() -> Iterator[None]:
    """Be one of the processes that torchrun has started, if it has; on GPUs each takes its own."""
    if int(os.environ.get("WORLD_SIZE", 1)) == 1 or dist.is_initialized():
        yield
        return
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    dist.init_process_group()
    try:
        yield
    finally:
        dist.destroy_process_group()


def world_size() -> int:
    """How many processes train together."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def rank() -> int:
    """Which of them this is; the first one, 0, writes and prints."""
    return dist.get_rank() if world_size() > 1 else 0


# -- of a loss: every rank has a batch of its own ---


def mean_over_ranks(x: Tensor) -> Tensor:
    """Average over ranks of a tensor of any shape, without gradient; a rank's own value within `on_its_own`."""
    if _alone or world_size() == 1:
        return x
    mean = x.detach().to(torch.float32, copy=True) / world_size()
    dist.all_reduce(mean)
    return mean


def from_first_rank(x: Tensor) -> Tensor:
    """What the first rank has: a draw that must be the same for the whole batch. Changes x in place."""
    if world_size() > 1 and not _alone:
        dist.broadcast(x, 0)
    return x


def randn_like(x: Tensor) -> Tensor:
    """This rank's share of standard normal noise for the batches (B, ...) of all ranks, which share a seed."""
    return torch.randn_like(x) if world_size() == 1 else _share_of_all(torch.randn, x)


def rand_like(x: Tensor) -> Tensor:
    """The same, uniform in [0, 1)."""
    return torch.rand_like(x) if world_size() == 1 else _share_of_all(torch.rand, x)


def _share_of_all(draw: Callable[..., Tensor], x: Tensor) -> Tensor:
    n = len(x)
    noise = draw(world_size() * n, *x.shape[1:], dtype=x.dtype, device=x.device)
    return noise[rank() * n : (rank() + 1) * n]


# -- of ranks that take some steps by themselves ---


@contextmanager
def on_its_own() -> Iterator[None]:
    """A forward pass of which other ranks hear nothing: means are of this rank's batch, and gradients stay here."""
    global _alone
    send_no_gradients()
    _alone = True
    try:
        yield
    finally:
        _alone = False


@torch.no_grad()
def agree(module: nn.Module) -> None:
    """Average the numbers of a module over ranks; of flags and counts the largest is taken."""
    if world_size() == 1:
        return
    tensors = [*module.parameters(), *module.buffers()]
    average_over_ranks([t for t in tensors if t.is_floating_point()])
    for tensor in tensors:
        if not tensor.is_floating_point():
            dist.all_reduce(tensor, dist.ReduceOp.MAX)


# -- of one batch that is split: every rank makes the same draws and takes its share ---


def share(x: Tensor) -> Tensor:
    """This rank's rows of a batch (N, ...) that all ranks have."""
    return x.tensor_split(world_size())[rank()]


def gathered(rows: Tensor) -> Tensor:
    """All ranks' rows (n, ...), however many each has, in the order of ranks: (N, ...) on every rank."""
    if world_size() == 1:
        return rows
    if rows.dtype == torch.bool:
        return gathered(rows.byte()).bool()
    counts = torch.zeros(world_size(), dtype=torch.long, device=rows.device)
    counts[rank()] = len(rows)
    dist.all_reduce(counts)
    whole = rows.new_zeros(int(counts.sum()), *rows.shape[1:])
    whole.split(counts.tolist())[rank()].copy_(rows)
    dist.all_reduce(whole)  # all others hold zeros there
    return whole


def any_rank(flag: Tensor) -> bool:
    """Whether a flag () is set on any rank."""
    return bool(mean_over_ranks(flag) > 0)


def sum_over_ranks(tensors: list[Tensor]) -> None:
    """Replace tensors of one type by their sums over ranks, in one message, as each has a price."""
    if world_size() == 1:
        return
    flat = torch.cat([t.flatten() for t in tensors])
    dist.all_reduce(flat)
    for tensor, total in zip(tensors, flat.split([t.numel() for t in tensors])):
        tensor.copy_(total.view_as(tensor))


@torch.no_grad()
def average_over_ranks(tensors: list[Tensor]) -> None:
    """Replace tensors of one type by their means over ranks, in one message."""
    sum_over_ranks(tensors)
    for tensor in tensors:
        tensor.div_(world_size())
