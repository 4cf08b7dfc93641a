"""Scalar bodies of the `dense-mlp` kind: density is the `dense` kind's, colour a small decoder's of features
that lie at the vertices (DVGO, Sun et al., CVPR 2022; for sharing it Control-NeRF, Lazova et al., 2023).

With v the features of a point, trilinear between vertices, and the decoder's input x = [v, SH(d)] (INPUTS
numbers): h = max(0, W x + b) of HIDDEN numbers, rgb = sigmoid(V h + c). Both layers lie in params from
`decoder` and `output` on, each as (inputs, outputs) and then its bias; the outputs are filled up to OUTPUTS.

Scratch holds the gradients of the outputs (D_OUT), of h (D_HIDDEN) and of x (D_INPUT), and the harmonics
(SH); of a shaded sample are kept x, h (HIDDEN_AT) and the outputs (OUT_AT).
"""

from typing import NamedTuple

import numpy as np

from fusedrf_cli.engine.kernels.parts import (
    add_scaled,
    dense,
    dense_backward,
    rectify,
    scatter,
    sh_basis,
    sigmoid,
)
from fusedrf_cli.engine.kinds.dense import bodies as grid_kind
from fusedrf_cli.engine.kinds.dense.bodies import (  # noqa: F401  (of the namespace)
    again,
    ahead_colour,
    ahead_density,
    corner,
    density,
    density_backward,
    place_of,
    row_of,
    vertex_on,
)

OUTPUTS = 8
HARMONICS = 16

Arrays = NamedTuple(
    "Arrays", [*grid_kind.Arrays.__annotations__.items(), ("decoder", object), ("output", object)]
)
"""The `dense` kind's, and where in params the decoder and its second layer begin."""


def sizes(field):
    """Constants of the namespace."""
    width, hidden = field.shape.width, field.shape.hidden
    inputs = width + HARMONICS
    return {
        "WIDTH": width, "INPUTS": inputs, "HIDDEN": hidden, "HIDDEN_AT": inputs, "OUT_AT": inputs + hidden,
        "KEPT": inputs + hidden + OUTPUTS, "D_OUT": 0, "D_HIDDEN": OUTPUTS, "D_INPUT": OUTPUTS + hidden,
        "SH": OUTPUTS + hidden + inputs, "SCRATCH": OUTPUTS + hidden + inputs + HARMONICS,
    }  # fmt: skip


def begin(field, frame, d, scratch):
    """Spherical harmonics of the direction."""
    sh_basis(HARMONICS, d, scratch, SH)


def colour(field, place, p, d, scratch, memory, at):
    """See loops.py; keeps all that the decoder computes."""
    real, base = field.params.dtype.type, np.uint64(at)
    for r in range(WIDTH):
        memory[base + np.uint64(r)] = 0
    for q in range(8):
        vertex, weight = corner(field, place, q)
        add_scaled(WIDTH, memory, base, real(weight), field.params, row_of(field, vertex))
    for r in range(HARMONICS):
        memory[base + np.uint64(WIDTH + r)] = scratch[SH + r]
    hidden, out = base + np.uint64(HIDDEN_AT), base + np.uint64(OUT_AT)
    dense(INPUTS, HIDDEN, field.params, np.uint64(field.decoder), memory, base, memory, hidden)
    rectify(HIDDEN, memory, hidden)
    dense(HIDDEN, OUTPUTS, field.params, np.uint64(field.output), memory, hidden, memory, out)
    red, green, blue = memory[out], memory[out + np.uint64(1)], memory[out + np.uint64(2)]
    return float(sigmoid(red)), float(sigmoid(green)), float(sigmoid(blue))


def backward(field, place, p, d, pre, d_sigma, shaded, rgb, d_rgb, scratch, memory, at, grad):
    """See loops.py."""
    if shaded:
        real, base = field.params.dtype.type, np.uint64(at)
        hidden, d_out, d_hidden = base + np.uint64(HIDDEN_AT), np.uint64(D_OUT), np.uint64(D_HIDDEN)
        for r in range(OUTPUTS):
            scratch[D_OUT + r] = 0
        for c in range(3):
            scratch[D_OUT + c] = real(d_rgb[c] * rgb[c] * (1 - rgb[c]))
        dense_backward(
            HIDDEN, OUTPUTS, field.params, np.uint64(field.output), memory, hidden, True, scratch, d_out,
            scratch, d_hidden, grad,
        )  # fmt: skip
        dense_backward(
            INPUTS, HIDDEN, field.params, np.uint64(field.decoder), memory, base, False, scratch, d_hidden,
            scratch, np.uint64(D_INPUT), grad,
        )  # fmt: skip
        for q in range(8):
            vertex, weight = corner(field, place, q)
            scatter(WIDTH, grad, row_of(field, vertex), real(weight), scratch, np.uint64(D_INPUT))
    density_backward(field, place, pre, d_sigma, grad)
