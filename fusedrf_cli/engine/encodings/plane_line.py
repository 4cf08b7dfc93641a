"""Planes times lines: 3 RANK features P_r(a, b) L_r(c), mode after mode: plane xy and line z, plane xz and
line y, plane yz and line x (vector-matrix decomposition; TensoRF, Chen et al., ECCV 2022, eq. 5)."""

from typing import NamedTuple

import msgspec
import numpy as np
import torch

from fusedrf_cli.engine.fields.box import ParameterBlock, largest
from fusedrf_cli.engine.fields.part_options import Rank
from fusedrf_cli.engine.kernels import reference as torch_reference
from fusedrf_cli.engine.kernels.prefetch import prefetch_plane
from fusedrf_cli.engine.kernels.primitives import bilinear, linear, scatter, store_8, texel

MODES = ((0, 1, 2), (0, 2, 1), (1, 2, 0))  # plane axes a, b and line axis c of each mode


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See encodings."""

    rank: Rank


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    starts: object  # (6,) int64, where the three planes and the three lines begin, as rows of RANK
    texels: object  # (3,) int64, per axis, corners on the faces of the box


def sizes(rank: int) -> dict[str, int]:
    """See encodings; scratch holds the gradients of a plane's and of a line's components."""
    return {"RANK": rank, "WIDTH": 3 * rank, "ROOM": 2 * rank}


def sections(resolution: tuple[int, int, int], rank: int) -> list[ParameterBlock]:
    """See encodings."""
    n, drawn = resolution, {"spread": 0.1}  # TensoRF's
    planes = [
        ParameterBlock(f"plane_{m}", (n[a], n[b], rank), (a, b), **drawn) for m, (a, b, _) in enumerate(MODES)
    ]
    return [
        *planes,
        *(ParameterBlock(f"line_{m}", (n[c], rank), (c,), **drawn) for m, (_, _, c) in enumerate(MODES)),
    ]


def arrays(field, starts: np.ndarray, rank: int) -> Arrays:
    """See encodings."""
    return Arrays(starts, field.corners[0])


def reference(
    field, sections: dict[str, torch.Tensor], unit: torch.Tensor, read: None, rank: int
) -> torch.Tensor:
    """See encodings."""
    products = []
    for m, (a, b, c) in enumerate(MODES):
        plane = torch_reference.bilinear(sections[f"plane_{m}"], unit[:, a], unit[:, b])
        products.append(plane * torch_reference.linear(sections[f"line_{m}"], unit[:, c]))
    return torch.cat(products, 1)


def bound(sections: dict[str, torch.Tensor], read: None, rank: int) -> torch.Tensor:
    """See encodings."""
    peak = {name: largest(view, kept=1) for name, view in sections.items()}
    return torch.cat([peak[f"plane_{m}"] * peak[f"line_{m}"] for m in range(3)])


# -- compiled: one mode --------------------------------------------------------------------------------------


def corners(field, mode, na, nb, nc, a, b, c):
    """Where the rows of the four texels of a mode's plane begin, their weights, where the lower row of its
    line begins, and the share of the upper."""
    real = field.params.dtype.type
    ia, ta = texel(field.params, real(a), na)
    ib, tb = texel(field.params, real(b), nb)
    ic, tc = texel(field.params, real(c), nc)
    w11 = ta * tb
    w10, w01 = ta - w11, tb - w11
    w00 = real(1) - ta - w01
    o00 = np.uint64(field.starts[mode] + (ia * nb + ib) * RANK)
    o10 = o00 + np.uint64(nb * RANK)
    l0 = np.uint64(field.starts[mode + 3] + ic * RANK)
    return (o00, o00 + np.uint64(RANK), o10, o10 + np.uint64(RANK)), (w00, w01, w10, w11), l0, tc


def mode_sum(field, mode, na, nb, nc, a, b, c):
    """Σ_r P_r(a, b) L_r(c)."""
    o, w, l0, tc = corners(field, mode, na, nb, nc, a, b, c)
    p, l1 = field.params, l0 + np.uint64(RANK)
    total = p.dtype.type(0)
    for r in range(np.uint64(RANK)):
        total += bilinear(p, o[0], o[1], o[2], o[3], w[0], w[1], w[2], w[3], r) * linear(p, l0, l1, tc, r)
    return total


def mode_forward(field, mode, na, nb, nc, a, b, c, out, base):
    """P_r(a, b) L_r(c) for every r into out[base:]."""
    o, w, l0, tc = corners(field, mode, na, nb, nc, a, b, c)
    p, l1, at = field.params, l0 + np.uint64(RANK), np.uint64(base)
    for r in range(np.uint64(RANK)):
        out[at + r] = bilinear(p, o[0], o[1], o[2], o[3], w[0], w[1], w[2], w[3], r) * linear(
            p, l0, l1, tc, r
        )


def mode_backward(field, mode, na, nb, nc, a, b, c, d, base, stride, scratch, grad):
    """Adjoint of `mode_forward` for d[base + r stride]."""
    o, w, l0, tc = corners(field, mode, na, nb, nc, a, b, c)
    l1, one = l0 + np.uint64(RANK), field.params.dtype.type(1)
    start, jump = np.uint64(base), np.uint64(stride)
    plane, line = np.uint64(AT), np.uint64(AT + RANK)
    for tile in range(np.uint64(RANK // 8)):
        r = tile * np.uint64(8)
        components_8(field, o, w, l0, l1, tc, d, start + r * jump, jump, r, scratch, plane + r, line + r)
    scatter(RANK, grad, o[0], w[0], scratch, plane)
    scatter(RANK, grad, o[1], w[1], scratch, plane)
    scatter(RANK, grad, o[2], w[2], scratch, plane)
    scatter(RANK, grad, o[3], w[3], scratch, plane)
    scatter(RANK, grad, l0, one - tc, scratch, line)
    scatter(RANK, grad, l1, tc, scratch, line)


def components_8(field, o, w, l0, l1, tc, d, at, jump, r, scratch, plane, line):
    """Components r to r + 7 of what is sent to a plane and to a line. All loads stand before all stores, so
    that they become vectors."""
    p, o00, o01, o10, o11 = field.params, o[0], o[1], o[2], o[3]
    w00, w01, w10, w11 = w[0], w[1], w[2], w[3]
    r1, r2, r3, r4 = r + np.uint64(1), r + np.uint64(2), r + np.uint64(3), r + np.uint64(4)
    r5, r6, r7 = r + np.uint64(5), r + np.uint64(6), r + np.uint64(7)
    two = jump + jump
    four = two + two
    d0, d1, d2, d3 = d[at], d[at + jump], d[at + two], d[at + two + jump]
    d4, d5, d6, d7 = d[at + four], d[at + four + jump], d[at + four + two], d[at + four + two + jump]
    store_8(
        scratch, plane,
        d0 * linear(p, l0, l1, tc, r), d1 * linear(p, l0, l1, tc, r1),
        d2 * linear(p, l0, l1, tc, r2), d3 * linear(p, l0, l1, tc, r3),
        d4 * linear(p, l0, l1, tc, r4), d5 * linear(p, l0, l1, tc, r5),
        d6 * linear(p, l0, l1, tc, r6), d7 * linear(p, l0, l1, tc, r7),
    )  # fmt: skip
    store_8(
        scratch, line,
        d0 * bilinear(p, o00, o01, o10, o11, w00, w01, w10, w11, r),
        d1 * bilinear(p, o00, o01, o10, o11, w00, w01, w10, w11, r1),
        d2 * bilinear(p, o00, o01, o10, o11, w00, w01, w10, w11, r2),
        d3 * bilinear(p, o00, o01, o10, o11, w00, w01, w10, w11, r3),
        d4 * bilinear(p, o00, o01, o10, o11, w00, w01, w10, w11, r4),
        d5 * bilinear(p, o00, o01, o10, o11, w00, w01, w10, w11, r5),
        d6 * bilinear(p, o00, o01, o10, o11, w00, w01, w10, w11, r6),
        d7 * bilinear(p, o00, o01, o10, o11, w00, w01, w10, w11, r7),
    )  # fmt: skip


# -- compiled: all three -------------------------------------------------------------------------------------


def summed(field, unit, scratch):
    """See encodings."""
    u, v, w = unit
    nx, ny, nz = field.texels[0], field.texels[1], field.texels[2]
    return (
        mode_sum(field, 0, nx, ny, nz, u, v, w)
        + mode_sum(field, 1, nx, nz, ny, u, w, v)
        + mode_sum(field, 2, ny, nz, nx, v, w, u)
    )


def forward(field, unit, scratch, out, base):
    """See encodings."""
    u, v, w = unit
    nx, ny, nz = field.texels[0], field.texels[1], field.texels[2]
    mode_forward(field, 0, nx, ny, nz, u, v, w, out, base)
    mode_forward(field, 1, nx, nz, ny, u, w, v, out, base + RANK)
    mode_forward(field, 2, ny, nz, nx, v, w, u, out, base + 2 * RANK)


def backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    u, v, w = unit
    nx, ny, nz = field.texels[0], field.texels[1], field.texels[2]
    mode_backward(field, 0, nx, ny, nz, u, v, w, d, base, 1, scratch, grad)
    mode_backward(field, 1, nx, nz, ny, u, w, v, d, base + RANK, 1, scratch, grad)
    mode_backward(field, 2, ny, nz, nx, v, w, u, d, base + 2 * RANK, 1, scratch, grad)


def summed_backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    u, v, w = unit
    nx, ny, nz = field.texels[0], field.texels[1], field.texels[2]
    mode_backward(field, 0, nx, ny, nz, u, v, w, d, base, 0, scratch, grad)
    mode_backward(field, 1, nx, nz, ny, u, w, v, d, base, 0, scratch, grad)
    mode_backward(field, 2, ny, nz, nx, v, w, u, d, base, 0, scratch, grad)


def prefetch_at(field, array, unit):
    """See encodings: the texels of the planes. A random point misses the cache a dozen times; asked for
    early, the misses overlap."""
    u, v, w = unit
    nx, ny, nz = field.texels[0], field.texels[1], field.texels[2]
    prefetch_plane(RANK, array, field.starts[0], nx, ny, u, v)
    prefetch_plane(RANK, array, field.starts[1], nx, nz, u, w)
    prefetch_plane(RANK, array, field.starts[2], ny, nz, v, w)
