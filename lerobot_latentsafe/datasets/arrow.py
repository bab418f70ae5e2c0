"""Columns of Arrow as NumPy arrays, whatever LeRobot's and Arrow's types wrap around the values."""

import numpy as np
import pyarrow as pa


def to_numpy(column: pa.Array | pa.ChunkedArray) -> np.ndarray:
    """(N,) or (N, D): lists of one length become rows, anything ragged or with holes an array of objects."""
    if isinstance(column, pa.ChunkedArray):
        column = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], column.type)
    values, n = _plain(column), len(column)
    while _is_list(values.type):
        lengths = set(values.value_lengths().to_pylist()) if not pa.types.is_fixed_size_list(values.type) else {0}
        if len(lengths) > 1 or values.null_count:
            return column.to_numpy(zero_copy_only=False)
        values = _plain(values.flatten())
    numbers = values.to_numpy(zero_copy_only=False)
    return numbers.reshape(n, -1) if _is_list(_plain(column).type) and n else numbers


def _plain(column: pa.Array) -> pa.Array:
    if isinstance(column.type, pa.ExtensionType):
        column = column.storage
    return column.dictionary_decode() if pa.types.is_dictionary(column.type) else column


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
