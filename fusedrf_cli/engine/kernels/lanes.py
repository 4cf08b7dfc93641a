"""Networks at several samples at once, on the CPU: its vectors hold a number of LANES samples, so that
weights are read once for all of them. The numbers of a sample are the same whatever lies in the other lanes.

A number r of a sample in `lane` lies at [r LANES + lane].
"""

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from fusedrf_cli.engine.kernels.primitives import device

LANES = 16
TILE = 8  # outputs whose sums are in registers


@intrinsic(prefer_literal=False)
def add_tile(typing, inputs, params, weights, stride, values, v, out, o):
    """out[o + r LANES + l] += Σ_i params[weights + i stride + r] values[v + i LANES + l] for the TILE outputs
    r and all lanes l, i < inputs, all of them uint64. Numba alone would keep the sums in memory."""

    def generate(context, builder, signature, arguments):
        data = {
            at: context.make_array(signature.args[at])(context, builder, arguments[at]).data
            for at in (1, 4, 6)
        }
        count, _, first_weight, stride, _, first_value, _, first_out = arguments
        real, whole, short = context.get_value_type(signature.args[6].dtype), ir.IntType(64), ir.IntType(32)
        vector, size = ir.VectorType(real, LANES), context.get_abi_sizeof(real)
        nothing, spread = ir.Constant(vector, ir.Undefined), ir.VectorType(short, LANES)
        once = {"flags": ("contract",)}

        def lanes_at(array, index):
            return builder.bitcast(builder.gep(data[array], [index]), vector.as_pointer())

        outs = [lanes_at(6, builder.add(first_out, whole(r * LANES))) for r in range(TILE)]
        begun = [builder.load(place, align=size) for place in outs]
        before = builder.block
        loop, behind = builder.append_basic_block("tile"), builder.append_basic_block("tiled")
        builder.branch(loop)
        builder.position_at_end(loop)
        i, sums = builder.phi(whole), [builder.phi(vector) for _ in range(TILE)]
        value = builder.load(lanes_at(4, builder.add(first_value, builder.mul(i, whole(LANES)))), align=size)
        row, grown = builder.add(first_weight, builder.mul(i, stride)), []
        for r, total in enumerate(sums):
            weight = builder.load(builder.gep(data[1], [builder.add(row, whole(r))]))
            one = builder.insert_element(nothing, weight, short(0))
            weight = builder.shuffle_vector(one, nothing, ir.Constant(spread, [0] * LANES))
            grown.append(builder.fadd(builder.fmul(weight, value, **once), total, **once))
        following = builder.add(i, whole(1))
        for phi, first, later in zip([i, *sums], [whole(0), *begun], [following, *grown], strict=True):
            phi.add_incoming(first, before)
            phi.add_incoming(later, loop)
        builder.cbranch(builder.icmp_unsigned("<", following, count), loop, behind)
        builder.position_at_end(behind)
        for place, total in zip(outs, grown, strict=True):
            builder.store(total, place, align=size)
        return context.get_dummy_value()

    number = types.uint64
    kinds = number, params, number, number, values, number, out, number
    return types.void(*kinds), generate


@device
def add_dense_lanes(inputs, outputs, params, weights, values, v, out, o):
    """out[o:] += Wᵀ x in each lane, for x = values[v:] and W (inputs, outputs) from `weights` on; the outputs
    are a multiple of TILE."""
    for tile in range(np.uint64(outputs // TILE)):
        r = tile * np.uint64(TILE)
        add_tile(
            np.uint64(inputs), params, weights + r, np.uint64(outputs), values, v, out,
            o + r * np.uint64(LANES),
        )  # fmt: skip


@device
def dense_lanes(inputs, outputs, params, weights, values, v, out, o):
    """`dense` of primitives.py in each lane."""
    for r in range(np.uint64(outputs)):
        bias = params[weights + np.uint64(inputs * outputs) + r]
        for lane in range(np.uint64(LANES)):
            out[o + r * np.uint64(LANES) + lane] = bias
    add_dense_lanes(inputs, outputs, params, weights, values, v, out, o)


@device
def rectify_lanes(count, values, v):
    """`rectify` of primitives.py in each lane."""
    for r in range(np.uint64(count * LANES)):
        values[v + r] = max(values[v + r], values.dtype.type(0))


@device
def network_lanes(inputs, hidden, layers, skip, outputs, params, starts, values, x, h, out):
    """`network` of networks.py in each lane; there is room for two layers from h on."""
    other = h + np.uint64(hidden * LANES)
    dense_lanes(inputs, hidden, params, np.uint64(starts[0]), values, x, values, h)
    rectify_lanes(hidden, values, h)
    for layer in range(1, layers):
        dense_lanes(hidden, hidden, params, np.uint64(starts[layer]), values, h, values, other)
        if skip > 0 and layer == skip:
            add_dense_lanes(inputs, hidden, params, np.uint64(starts[layers + 1]), values, x, values, other)
        rectify_lanes(hidden, values, other)
        h, other = other, h
    dense_lanes(hidden, outputs, params, np.uint64(starts[layers]), values, h, values, out)
