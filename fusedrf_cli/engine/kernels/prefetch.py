"""Asking for memory before it is needed. On the CPU only: a GPU hides its misses by other threads' work."""

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from fusedrf_cli.engine.kernels.primitives import LINE, device


@intrinsic(prefer_literal=False)
def prefetch(typing, array, index):
    """Ask for the cache line of array[index], a flat array, before it is needed."""

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        byte = ir.IntType(8).as_pointer()  # one hint serves arrays of every kind
        line, whole = builder.bitcast(builder.gep(data, [arguments[1]]), byte), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [line.type, whole, whole, whole])
        known = builder.module.globals.get("llvm.prefetch.p0")
        hint = known or ir.Function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(hint, [line, whole(0), whole(3), whole(1)])  # for reading, to the nearest cache, data
        return context.get_dummy_value()

    return types.void(array, index), generate


@device
def prefetch_plane(rank, array, plane, na, nb, a, b):
    """Ask for the four texels, of `rank` numbers each, of a plane around unit coordinates (a, b), which may
    lie outside."""
    real = array.dtype.type
    ia = min(max(int(a * real(na - 1)), 0), na - 2)
    ib = min(max(int(b * real(nb - 1)), 0), nb - 2)
    lower = np.uint64(plane + (ia * nb + ib) * rank)
    upper = lower + np.uint64(nb * rank)
    for i in range(np.uint64(2 * rank // LINE)):
        prefetch(array, lower + i * np.uint64(LINE))
        prefetch(array, upper + i * np.uint64(LINE))
    if rank % LINE != 0:
        last = np.uint64(2 * rank - 1)
        prefetch(array, lower + last)
        prefetch(array, upper + last)
