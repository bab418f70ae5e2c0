"""Replaying a step of learning as one CUDA graph: launching its thousands of small kernels is most of its time."""

from collections.abc import Callable

import torch
from torch import Tensor


class Replayed:
    """A function of tensors of fixed shapes, recorded at its first call and replayed from then on.

    It must not look at its tensors' values. What it returns, and the gradients that it leaves, are overwritten by the
    next call.

    Args:
        function: tensors -> tensors by name.
        changed: what the function changes in place; its rehearsals before the recording leave no trace there.
    """

    def __init__(self, function: Callable[..., dict[str, Tensor]], changed: list[Tensor]):
        self.function, self.changed = function, changed
        self.graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, *inputs: Tensor) -> dict[str, Tensor]:
        if self.graph is None:
            self._record(inputs)
        for kept, new in zip(self.inputs, inputs):
            kept.copy_(new)
        self.graph.replay()
        return self.outputs

    def _record(self, inputs: tuple[Tensor, ...]) -> None:
        self.inputs = [t.clone() for t in inputs]
        before = [t.clone() for t in self.changed]
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):
                self.function(*self.inputs)
        torch.cuda.current_stream().wait_stream(stream)
        for now, old in zip(self.changed, before):
            now.copy_(old)
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graph):
            self.outputs = self.function(*self.inputs)
