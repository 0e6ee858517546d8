"""Sums over modes in SIMD lanes: padded arrays, and products of a row in a fixed order."""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from workbench.arrays import Floats

LANES = 8  # modes per SIMD operation; the number of modes is padded to a multiple, with modes at rest


@intrinsic
def _row_times(typing: Any, matrix: Any, i: Any, x: Any) -> Any:
    """LLVM's vectors for `row_times`."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        rows, along = (context.make_array(signature.args[k])(context, builder, values[k]) for k in (0, 2))
        (n,) = cgutils.unpack_tuple(builder, along.shape)  # type: ignore[no-untyped-call]
        row = builder.gep(rows.data, [builder.mul(values[1], n)])
        lanes = ir.VectorType(ir.DoubleType(), LANES)
        total = cgutils.alloca_once_value(builder, ir.Constant(lanes, [0.0] * LANES))  # type: ignore[no-untyped-call]
        with cgutils.for_range_slice(builder, n.type(0), n, n.type(LANES)) as (r, _):
            one, other = (
                builder.load(builder.bitcast(builder.gep(data, [r]), lanes.as_pointer()), align=8)
                for data in (row, along.data)
            )
            builder.store(builder.fadd(builder.load(total), builder.fmul(one, other)), total)
        sums = builder.load(total)
        parts = [builder.extract_element(sums, ir.IntType(32)(lane)) for lane in range(LANES)]
        while len(parts) > 1:
            parts = [builder.fadd(a, b) for a, b in zip(parts[::2], parts[1::2], strict=True)]
        return parts[0]

    return types.float64(matrix, types.intp, x), generate


@njit(cache=True, nogil=True, forceinline=True, _nrt=False)  # type: ignore[call-overload, untyped-decorator]
def row_times(matrix: Floats, i: int, x: Floats) -> float:
    """Row i of a matrix (n_rows, n) times x (n,), n a multiple of LANES, both contiguous: one partial sum a lane.

    The order of the sum is fixed. With fastmath it would depend on what else is compiled, and when, so that the last
    digits of a simulation would differ from one installation to the next.
    """
    total: float = _row_times(matrix, i, x)  # type: ignore[call-arg]
    return total


def on_lanes(values: Floats, axes: int = 1) -> Floats:
    """An array (..., n_modes), or with several last axes, with zeros up to whole lanes: modes at rest."""
    kept, wide = values.shape[: values.ndim - axes], values.shape[values.ndim - axes :]
    padded = np.zeros((*kept, *(size + -size % LANES for size in wide)))
    padded[tuple(slice(size) for size in values.shape)] = values
    return padded
