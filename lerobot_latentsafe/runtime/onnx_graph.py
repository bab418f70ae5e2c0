"""Functions of tensors as graphs of ONNX Runtime, in which small operations cost a fraction of what they cost in torch.

A graph is made when it is asked for, in seconds, and lives in memory alone: nothing is written, and none is loaded.
Numbers that are none go through it as through torch: ONNX Runtime's own maximum and minimum along an axis forget them.
"""

import contextlib
import io
import logging
import warnings
from collections.abc import Callable, Iterator
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.onnx import register_custom_op_symbolic, symbolic_helper, unregister_custom_op_symbolic

OPSET = 17
TOLERANCE = 1e-4
"""What a graph says may differ from what torch says by so much, of large numbers by this share."""


class GraphError(RuntimeError):
    """No graph can be made of a function, or a graph does not say what its function says."""


class _Function(nn.Module):
    """A function of named tensors as torch's exporter takes it: of a tuple of tensors."""

    def __init__(self, weights: nn.Module, function: Callable[..., dict[str, Tensor]], names: list[str]):
        super().__init__()
        self.weights, self.function, self.names = weights, function, names
        self.said: list[str] = []

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        answer = self.function(self.weights, **dict(zip(self.names, given)))
        self.said = list(answer)
        return tuple(answer.values())


class Graph:
    """A function of named tensors, for those shapes alone that it was made with, on one core of the CPU.

    Args:
        weights: the module that the function asks; its weights are copied, as they are now.
        function: of that module and of tensors by name -> tensors by name.
        example: such tensors.

    Raises:
        GraphError: a package is missing, or the function holds what no graph can.
    """

    def __init__(self, weights: nn.Module, function: Callable[..., dict[str, Tensor]], example: dict[str, Tensor]):
        try:
            import onnx  # noqa: F401  the exporter asks for it
            from onnxruntime import InferenceSession
        except ImportError as e:
            raise GraphError(f"{e.name} is missing: pip install 'lerobot_policy_latentsafe[onnx]'") from e
        whole = _Function(weights, function, list(example)).eval()
        file = io.BytesIO()
        try:
            with torch.no_grad(), _quietly(), _symbolics():
                torch.onnx.export(
                    whole, tuple(example.values()), cast(Any, file), dynamo=False, opset_version=OPSET,
                    input_names=list(example),
                )  # fmt: skip
            self._session = InferenceSession(file.getvalue(), _options(), providers=["CPUExecutionProvider"])
        except Exception as e:  # whatever the exporter and the runtime raise
            raise GraphError(f"no graph can be made of it ({type(e).__name__}: {_first_line(e)})") from e
        self._said, self._asked = whole.said, [given.name for given in self._session.get_inputs()]
        self._kinds = {name: (tensor.shape, tensor.dtype) for name, tensor in example.items()}

    def fits(self, given: dict[str, Tensor]) -> bool:
        """Whether these tensors are of the names, shapes and types that it was made for, on the CPU."""
        return given.keys() == self._kinds.keys() and all(
            (tensor.shape, tensor.dtype) == self._kinds[name] and tensor.device.type == "cpu"
            for name, tensor in given.items()
        )

    def __call__(self, given: dict[str, Tensor]) -> dict[str, Tensor]:
        """What the function says of tensors that fit."""
        answer = self._session.run(None, {name: given[name].numpy(force=True) for name in self._asked})
        return dict(zip(self._said, map(torch.from_numpy, answer)))


def _options() -> Any:
    """One thread, the caller's: a pool of threads that spin would take the cores of whoever else controls."""
    from onnxruntime import SessionOptions

    options = SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    return options


def _first_line(error: Exception) -> str:
    return str(error).strip().split("\n")[0][:200]


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Without what the exporter says of each Python number that it takes for a constant: here they are."""
    exporter = logging.getLogger("torch.onnx")
    level = exporter.level
    exporter.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        exporter.setLevel(level)


# -- operations that torch's exporter lacks, or that ONNX Runtime takes otherwise ---


@contextlib.contextmanager
def _symbolics() -> Iterator[None]:
    for name, symbolic in _SYMBOLICS.items():
        register_custom_op_symbolic(name, symbolic, OPSET)
    try:
        yield
    finally:
        for name in _SYMBOLICS:
            unregister_custom_op_symbolic(name, OPSET)


def _with_nan(g: Any, x: Any, reduced: Any, axes: list[int], keep: int) -> Any:
    """A maximum or minimum along axes, which is no number where any of these numbers is none."""
    total = g.op("ReduceSum", x, g.op("Constant", value_t=torch.tensor(axes)), keepdims_i=keep)
    return g.op("Where", g.op("IsNaN", total), total, reduced)


def _extreme(kind: str) -> Callable:
    @symbolic_helper.parse_args("v", "is", "i")
    def along(g: Any, x: Any, axes: list[int], keep: int) -> Any:
        return _with_nan(g, x, g.op(kind, x, axes_i=axes, keepdims_i=keep), axes, keep)

    return along


def _max(g: Any, x: Any, other: Any = None, keep: Any = None) -> Any:
    """Of two tensors, or along an axis with the places; torch's `max` of all numbers is not used here."""
    if keep is None:
        return g.op("Max", x, other)
    axis, keep = (symbolic_helper._get_const(value, "i", name) for value, name in ((other, "dim"), (keep, "keepdim")))
    largest = _with_nan(g, x, g.op("ReduceMax", x, axes_i=[axis], keepdims_i=keep), [axis], keep)
    return largest, g.op("ArgMax", x, axis_i=axis, keepdims_i=keep)


@symbolic_helper.parse_args("v", "i", "i", "i")
def _chunk(g: Any, x: Any, chunks: int, axis: int, _outputs: int | None = None) -> Any:
    """Equal parts, also of sizes that the exporter does not know: where torch takes a GRUCell apart."""
    return g.op("Split", x, axis_i=axis, outputs=chunks)


_SYMBOLICS: dict[str, Callable] = {
    "aten::amax": _extreme("ReduceMax"),
    "aten::amin": _extreme("ReduceMin"),
    "aten::max": _max,
    "aten::unsafe_chunk": _chunk,
}
