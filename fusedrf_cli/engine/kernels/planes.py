"""Planes times lines, compiled once for all that have them: one mode of a vector-matrix decomposition
(TensoRF, Chen et al., ECCV 2022, eq. 5), P_r(a, b) L_r(c) for r < rank.

`plane` and `line` are where the rows of rank numbers of a plane (n_a, n_b) and of a line (n_c) begin in
params, `n` their texels (n_a, n_b, n_c), corners on the faces of the box, and `at` unit coordinates
(a, b, c) of the numbers' type. The rank is a constant, and a multiple of 8.
"""

import numpy as np
from numba import literally

from fusedrf_cli.engine.kernels.parts import bilinear, body, linear, scatter, store_8, texel


@body
def mode_corners(rank, params, plane, line, n, at):
    """Where the rows of the four texels around a point of the plane begin, and their weights; where those of
    the two of the line begin, and the share of the upper."""
    ia, ta = texel(params, at[0], n[0])
    ib, tb = texel(params, at[1], n[1])
    ic, tc = texel(params, at[2], n[2])
    w11 = ta * tb
    w10, w01 = ta - w11, tb - w11
    w00 = params.dtype.type(1) - ta - w01
    o00 = np.uint64(plane + (ia * n[1] + ib) * rank)
    o10 = o00 + np.uint64(n[1] * rank)
    l0 = np.uint64(line + ic * rank)
    corners = o00, o00 + np.uint64(rank), o10, o10 + np.uint64(rank)
    return corners, (w00, w01, w10, w11), (l0, l0 + np.uint64(rank)), tc


@body
def on_plane(params, o, w, r):
    """P_r between four corners."""
    return bilinear(params, o[0], o[1], o[2], o[3], w[0], w[1], w[2], w[3], r)


@body
def mode_sum(rank, params, plane, line, n, at):
    """Σ_r P_r(a, b) L_r(c)."""
    literally(rank)
    o, w, ends, t = mode_corners(rank, params, plane, line, n, at)
    total = params.dtype.type(0)
    for r in range(np.uint64(rank)):
        total += on_plane(params, o, w, r) * linear(params, ends[0], ends[1], t, r)
    return total


@body
def mode_forward(rank, params, plane, line, n, at, out, base):
    """P_r(a, b) L_r(c) for every r into out[base:]."""
    literally(rank)
    o, w, ends, t = mode_corners(rank, params, plane, line, n, at)
    start = np.uint64(base)
    for r in range(np.uint64(rank)):
        out[start + r] = on_plane(params, o, w, r) * linear(params, ends[0], ends[1], t, r)


@body
def mode_backward(rank, params, plane, line, n, at, d, base, stride, scratch, room, grad):
    """Adjoint of `mode_forward` for d[base + r stride]: adds to grad. scratch[room:] has room for 2 rank
    numbers, the gradients of P_r and L_r."""
    literally(rank)
    literally(stride)
    o, w, ends, t = mode_corners(rank, params, plane, line, n, at)
    on_line, jump = np.uint64(room + rank), np.uint64(stride)
    for tile in range(np.uint64(rank // 8)):
        r = tile * np.uint64(8)
        sent = sent_8(d, np.uint64(base) + r * jump, jump)
        mode_backward_8(params, o, w, ends, t, sent, r, scratch, np.uint64(room) + r, on_line + r)
    scatter(rank, grad, o[0], w[0], scratch, np.uint64(room))
    scatter(rank, grad, o[1], w[1], scratch, np.uint64(room))
    scatter(rank, grad, o[2], w[2], scratch, np.uint64(room))
    scatter(rank, grad, o[3], w[3], scratch, np.uint64(room))
    scatter(rank, grad, ends[0], params.dtype.type(1) - t, scratch, on_line)
    scatter(rank, grad, ends[1], t, scratch, on_line)


@body
def sent_8(d, at, jump):
    """d[at + i jump] for i < 8."""
    two = jump + jump
    four = two + two
    return (
        d[at], d[at + jump], d[at + two], d[at + two + jump], d[at + four], d[at + four + jump],
        d[at + four + two], d[at + four + two + jump],
    )  # fmt: skip


@body
def mode_backward_8(p, o, w, ends, t, d, r, scratch, plane, line):
    """Eight components from r on of what is sent to a plane and to a line. All loads stand before all stores,
    so that they become vectors."""
    r1, r2, r3, r4 = r + np.uint64(1), r + np.uint64(2), r + np.uint64(3), r + np.uint64(4)
    r5, r6, r7 = r + np.uint64(5), r + np.uint64(6), r + np.uint64(7)
    l0, l1 = ends
    store_8(
        scratch, plane,
        d[0] * linear(p, l0, l1, t, r), d[1] * linear(p, l0, l1, t, r1), d[2] * linear(p, l0, l1, t, r2),
        d[3] * linear(p, l0, l1, t, r3), d[4] * linear(p, l0, l1, t, r4), d[5] * linear(p, l0, l1, t, r5),
        d[6] * linear(p, l0, l1, t, r6), d[7] * linear(p, l0, l1, t, r7),
    )  # fmt: skip
    store_8(
        scratch, line,
        d[0] * on_plane(p, o, w, r), d[1] * on_plane(p, o, w, r1), d[2] * on_plane(p, o, w, r2),
        d[3] * on_plane(p, o, w, r3), d[4] * on_plane(p, o, w, r4), d[5] * on_plane(p, o, w, r5),
        d[6] * on_plane(p, o, w, r6), d[7] * on_plane(p, o, w, r7),
    )  # fmt: skip
