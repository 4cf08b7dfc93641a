"""The `vm-mlp` kind's scalar functions: density is the `vm` kind's, colour a small network's.

With the matrix B (FEATURES, 3 rank), which the tensor's colour basis is, and the products P ∘ L of a point:
f = B (P ∘ L), x = [f, d] with d the direction in the object's frame, and the network's input is
[x, sin x, sin 2x, cos x, cos 2x] (INPUTS numbers); two layers of LAYER rectified outputs and one of three,
behind a sigmoid, follow. Each layer lies in params from `network` on as W (inputs, outputs) and then its
bias, where outputs are filled up to multiples of 8 with zeros, which stay so.

A ray's `scratch` holds the object's direction (WAY), gradients of the outputs of the layers (D_LAST,
D_SECOND, D_FIRST), of the input (D_INPUT) and of x (D_X), and what the `vm` kind needs. Of a shaded sample
are kept its products, and behind them its input, and the outputs of the layers (INPUT, FIRST, SECOND, LAST).
"""

import math
from typing import NamedTuple

import numpy as np

from fusedrf_cli.engine.kernels.parts import add_scaled, dense, dense_backward, dot, rectify, scatter, sigmoid
from fusedrf_cli.engine.kinds.vm import bodies as vm
from fusedrf_cli.engine.kinds.vm.bodies import (
    colour_features,
    density_backward,
    object_direction,
    scatter_colour,
    unit_point,
)  # fmt: skip

OUTPUTS = 8  # of the last layer: three colours, filled up

Arrays = NamedTuple("Arrays", [*vm.Arrays.__annotations__.items(), ("network", object)])
"""The `vm` kind's, and where in params the network begins."""


def sizes(field) -> dict[str, int]:
    """The constants that the functions of this file are compiled with."""
    rank, features, width = field.shape.colour_rank, 3 * field.shape.coefficients, field.wide
    inputs = 5 * (features + 3)
    held = {
        "WAY": 8, "D_LAST": OUTPUTS, "D_SECOND": width, "D_FIRST": width, "D_INPUT": inputs,
        "D_X": features + 3, "D_FEATURES": 3 * rank, "TILE": 2 * max(field.shape.density_rank, rank),
        "ONE": 1,
    }  # fmt: skip
    starts = np.cumsum([0, *held.values()]).tolist()
    kept = np.cumsum([3 * rank, inputs, width, width, OUTPUTS]).tolist()
    return {
        "DENSITY_RANK": field.shape.density_rank, "COLOUR_RANK": rank, "PRODUCTS": 3 * rank,
        "FEATURES": features, "LAYER": width,
        "INPUTS": inputs, **dict(zip(held, starts, strict=False)), "SCRATCH": starts[-1],
        "INPUT": kept[0], "FIRST": kept[1], "SECOND": kept[2], "LAST": kept[3], "KEPT": kept[4],
        "LEARN_FROM": 1 / 64, "SHADING_COST": 8, "CROSSING": int(any(field.factors.crossings)), "DETAIL": 0,
    }  # fmt: skip


def frame_of(place):
    """There is one block."""
    return 0


def begin(field, frame, d, scratch):
    """The direction in the object's frame."""
    x, y, z, _ = object_direction(field, 0, d)
    scratch[WAY], scratch[WAY + 1], scratch[WAY + 2] = x, y, z


def end(field, frame, d, scratch, grad):
    """Nothing is gathered for a ray."""


def colour(field, place, p, d, scratch, memory, at):
    """rgb by the network; all on the way to it is kept."""
    u, v, w, _ = unit_point(field, 0, p)
    colour_features(field, 0, u, v, w, memory, at)
    base, x = np.uint64(at), np.uint64(at + INPUT)
    basis, width = np.uint64(field.layout[0, 12]), np.uint64(PRODUCTS)
    for j in range(np.uint64(FEATURES)):
        memory[x + j] = dot(PRODUCTS, field.params, basis + j * width, memory, base)
    for j in range(np.uint64(3)):
        memory[x + np.uint64(FEATURES) + j] = scratch[np.uint64(WAY) + j]
    encode(memory, x)
    second, last = layers(field)
    first_at, second_at = base + np.uint64(FIRST), base + np.uint64(SECOND)
    last_at = base + np.uint64(LAST)
    dense(INPUTS, LAYER, field.params, np.uint64(field.network), memory, x, memory, first_at)
    rectify(LAYER, memory, first_at)
    dense(LAYER, LAYER, field.params, second, memory, first_at, memory, second_at)
    rectify(LAYER, memory, second_at)
    dense(LAYER, OUTPUTS, field.params, last, memory, second_at, memory, last_at)
    return (
        float(sigmoid(memory[last_at])),
        float(sigmoid(memory[last_at + np.uint64(1)])),
        float(sigmoid(memory[last_at + np.uint64(2)])),
    )


def layers(field):
    """Where the second and the third layer begin in params."""
    second = np.uint64(field.network) + np.uint64((INPUTS + 1) * LAYER)
    return second, second + np.uint64((LAYER + 1) * LAYER)


def encode(memory, x):
    """Behind the numbers x their sines and cosines, of once and twice."""
    count = np.uint64(FEATURES + 3)
    for j in range(count):
        sin, cos = math.sin(memory[x + j]), math.cos(memory[x + j])
        memory[x + count + j] = sin
        memory[x + np.uint64(2) * count + j] = 2 * sin * cos
        memory[x + np.uint64(3) * count + j] = cos
        memory[x + np.uint64(4) * count + j] = 1 - 2 * sin * sin


def backward(field, place, p, d, pre, d_sigma, shaded, rgb, d_rgb, scratch, memory, at, grad):
    """Adjoint of `density` and, where shaded, of `colour`."""
    if shaded:
        colour_backward(field, p, rgb, d_rgb, scratch, memory, at, grad)
    density_backward(field, 0, p, d, pre, d_sigma, scratch, grad)


def colour_backward(field, p, rgb, d_rgb, scratch, memory, at, grad):
    """Adjoint of `colour`."""
    base, x = np.uint64(at), np.uint64(at + INPUT)
    first_at, second_at = base + np.uint64(FIRST), base + np.uint64(SECOND)
    second, last = layers(field)
    d_last, d_second, d_first = np.uint64(D_LAST), np.uint64(D_SECOND), np.uint64(D_FIRST)
    for r in range(np.uint64(OUTPUTS)):
        scratch[d_last + r] = 0
    scratch[d_last] = d_rgb[0] * rgb[0] * (1 - rgb[0])
    scratch[d_last + np.uint64(1)] = d_rgb[1] * rgb[1] * (1 - rgb[1])
    scratch[d_last + np.uint64(2)] = d_rgb[2] * rgb[2] * (1 - rgb[2])
    dense_backward(
        LAYER, OUTPUTS, field.params, last, memory, second_at, True, scratch, d_last, scratch, d_second, grad
    )
    dense_backward(
        LAYER, LAYER, field.params, second, memory, first_at, True, scratch, d_second, scratch, d_first, grad
    )
    network, d_input = np.uint64(field.network), np.uint64(D_INPUT)
    dense_backward(
        INPUTS, LAYER, field.params, network, memory, x, False, scratch, d_first, scratch, d_input, grad
    )
    encode_backward(memory, x, scratch)
    basis, width = np.uint64(field.layout[0, 12]), np.uint64(PRODUCTS)
    d_features = np.uint64(D_FEATURES)
    for r in range(width):
        scratch[d_features + r] = 0
    for j in range(np.uint64(FEATURES)):
        d_x = scratch[np.uint64(D_X) + j]
        add_scaled(PRODUCTS, scratch, d_features, d_x, field.params, basis + j * width)
        scatter(PRODUCTS, grad, basis + j * width, d_x, memory, base)
    u, v, w, _ = unit_point(field, 0, p)
    scatter_colour(field, grad, 0, u, v, w, scratch)


def encode_backward(memory, x, scratch):
    """Adjoint of `encode`: from scratch[D_INPUT:] to scratch[D_X:]."""
    count = np.uint64(FEATURES + 3)
    d_sin = np.uint64(D_INPUT) + count
    d_sin2, d_cos, d_cos2 = d_sin + count, d_sin + np.uint64(2) * count, d_sin + np.uint64(3) * count
    for j in range(count):
        sin, sin2 = memory[x + count + j], memory[x + np.uint64(2) * count + j]
        cos, cos2 = memory[x + np.uint64(3) * count + j], memory[x + np.uint64(4) * count + j]
        scratch[np.uint64(D_X) + j] = (
            scratch[np.uint64(D_INPUT) + j]
            + scratch[d_sin + j] * cos
            - scratch[d_cos + j] * sin
            + 2 * (scratch[d_sin2 + j] * cos2 - scratch[d_cos2 + j] * sin2)
        )
