"""Products of planes: features Π_m P_m,r(a, b) over the planes xy, xz and yz, of grids of several
resolutions, side by side or summed (K-Planes, Fridovich-Keil et al., CVPR 2023, eq. 1). With `lines` three
lines along the axes are factors as well: what its planes of an axis and time are at one time. In a `margin`
of the box, which is that share of its sides wide, features are those on the border of what is in it."""

from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import torch
from msgspec import Meta

from fusedrf_cli.engine.fields.box import MAX_TEXELS, ParameterBlock, largest
from fusedrf_cli.engine.fields.part_options import Rank
from fusedrf_cli.engine.kernels import reference as torch_reference
from fusedrf_cli.engine.kernels.prefetch import prefetch_plane
from fusedrf_cli.engine.kernels.primitives import bilinear, linear, scatter, store_8

AXES = ((0, 1), (0, 2), (1, 2), (0, 0), (1, 1), (2, 2))  # of each plane, and then of each line, twice
Texels = Annotated[int, Meta(ge=2, le=MAX_TEXELS)]


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See encodings."""

    features: Rank
    scales: Annotated[list[tuple[Texels, Texels, Texels]], Meta(min_length=1, max_length=16)]
    """Texels per axis of each grid, corners on the faces of the box, or on those inside of a margin."""
    summed: bool = False
    lines: bool = False
    margin: Annotated[float, Meta(ge=0, le=0.49)] = 0.0


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    starts: object  # (SCALES FACTORS,) int64, where the planes and lines of each grid begin
    counts: object  # (3 SCALES,) int64, texels per axis


def texels_of(resolution: tuple[int, int, int], scales: list | int) -> list[tuple[int, int, int]]:
    """Texels per axis of each grid: as listed, or of so many grids, of which the first has those of a field
    and the next half of them each."""
    if isinstance(scales, int):
        return [tuple(max(2, -(-n // 2**s)) for n in resolution) for s in range(scales)]
    return scales


def count_of(scales: list | int) -> int:
    """How many grids there are."""
    return scales if isinstance(scales, int) else len(scales)


def sizes(
    features: int, scales: list | int, summed: bool = False, lines: bool = False, margin: float = 0.0
) -> dict[str, int | float]:
    """See encodings; scratch holds what is sent back to the factors of a grid."""
    factors, count = 6 if lines else 3, count_of(scales)
    return {
        "FEATURES": features, "SCALES": count, "FACTORS": factors, "SUMMED": int(summed),
        "WIDTH": features * (1 if summed else count), "ROOM": factors * features,
        "MARGIN": float(margin),
    }  # fmt: skip


def sections(
    resolution: tuple, features: int, scales: list | int, lines: bool = False, **options
) -> list[ParameterBlock]:
    """See encodings."""
    blocks = []
    for s, counts in enumerate(texels_of(resolution, scales)):
        for m, axes in enumerate(AXES[: 6 if lines else 3]):
            name = f"plane_{s}_{m}" if m < 3 else f"line_{s}_{m - 3}"
            axes = axes if m < 3 else axes[:1]
            shape = (*(counts[axis] for axis in axes), features)
            blocks.append(ParameterBlock(name, shape, axes, spread=0.3))
    return blocks


def arrays(field, starts: np.ndarray, features: int, scales: list | int, **options) -> Arrays:
    """See encodings."""
    return Arrays(starts, np.array(texels_of(field.resolution, scales), np.int64).reshape(-1))


def reference(
    field, sections: dict, unit: torch.Tensor, read: None, features: int, scales: list | int,
    summed: bool = False, lines: bool = False, margin: float = 0.0,
) -> torch.Tensor:  # fmt: skip
    """See encodings."""
    unit, made = ((unit - margin) / (1 - 2 * margin)).clamp(0, 1), []
    for s in range(count_of(scales)):
        product = 1
        for m, (a, b) in enumerate(AXES[:3]):
            plane = sections[f"plane_{s}_{m}"]
            product = product * torch_reference.bilinear(plane, unit[:, a], unit[:, b])
        for axis in range(3 * lines):
            product = product * torch_reference.linear(sections[f"line_{s}_{axis}"], unit[:, axis])
        made.append(product)
    return sum(made) if summed else torch.cat(made, 1)


def bound(
    sections: dict, read: None, features: int, scales: list | int, summed: bool = False, **options
) -> torch.Tensor:
    """See encodings."""
    peaks = torch.stack([largest(view, kept=1) for view in sections.values()])
    products = peaks.view(count_of(scales), -1, features).prod(1)
    return products.sum(0) if summed else products.view(-1)


# -- compiled: one grid --------------------------------------------------------------------------------------


def below(field, scale, axis, u):
    """The texel below a point on an axis of a grid, and the share of the one above."""
    last = field.counts[3 * scale + axis] - 1
    at = min(max((u - MARGIN) / (1.0 - 2.0 * MARGIN), 0.0), 1.0) * last
    i = min(int(at), last - 1)
    return i, at - i


def plane_at(field, scale, m, i, a, j, b, n):
    """Where the rows of the four texels of a plane of n texels on its second axis begin, and their
    weights."""
    real = field.params.dtype.type
    o00 = np.uint64(field.starts[FACTORS * scale + m] + (i * n + j) * FEATURES)
    o10, one = o00 + np.uint64(n * FEATURES), np.uint64(FEATURES)
    weights = real((1.0 - a) * (1.0 - b)), real((1.0 - a) * b), real(a * (1.0 - b)), real(a * b)
    return (o00, o00 + one, o10, o10 + one), weights


def line_at(field, scale, axis, i, a):
    """Where the rows of the two texels of a line begin, and the share of the upper; of a grid without lines
    those of nothing."""
    start = field.starts[FACTORS * scale + 3 + axis] if FACTORS == 6 else 0
    lower = np.uint64(start + i * FEATURES)
    return lower, lower + np.uint64(FEATURES), field.params.dtype.type(a)


def factors_at(field, scale, unit):
    """`plane_at` of the three planes of a grid, and `line_at` of its lines."""
    i, a = below(field, scale, 0, unit[0])
    j, b = below(field, scale, 1, unit[1])
    k, c = below(field, scale, 2, unit[2])
    ny, nz = field.counts[3 * scale + 1], field.counts[3 * scale + 2]
    planes = (
        plane_at(field, scale, 0, i, a, j, b, ny),
        plane_at(field, scale, 1, i, a, k, c, nz),
        plane_at(field, scale, 2, j, b, k, c, nz),
    )
    lines = line_at(field, scale, 0, i, a), line_at(field, scale, 1, j, b), line_at(field, scale, 2, k, c)
    return planes, lines


def on_plane(field, plane, r):
    """Component r of a plane at a point."""
    o, w = plane
    return bilinear(field.params, o[0], o[1], o[2], o[3], w[0], w[1], w[2], w[3], r)


def product(field, planes, lines, r):
    """The product of all factors of feature r."""
    made = on_plane(field, planes[0], r) * on_plane(field, planes[1], r) * on_plane(field, planes[2], r)
    if FACTORS == 6:
        for line in lines:
            made *= linear(field.params, line[0], line[1], line[2], r)
    return made


def plane_8(field, plane, r):
    """Components r to r + 7 of a plane at a point."""
    one = np.uint64(1)
    r1, r2, r3 = r + one, r + np.uint64(2), r + np.uint64(3)
    r4, r5, r6, r7 = r + np.uint64(4), r + np.uint64(5), r + np.uint64(6), r + np.uint64(7)
    return (
        on_plane(field, plane, r), on_plane(field, plane, r1), on_plane(field, plane, r2),
        on_plane(field, plane, r3), on_plane(field, plane, r4), on_plane(field, plane, r5),
        on_plane(field, plane, r6), on_plane(field, plane, r7),
    )  # fmt: skip


def line_8(field, line, r):
    """Components r to r + 7 of a line at a point."""
    p, (lower, upper, t) = field.params, line
    one = np.uint64(1)
    r1, r2, r3 = r + one, r + np.uint64(2), r + np.uint64(3)
    r4, r5, r6, r7 = r + np.uint64(4), r + np.uint64(5), r + np.uint64(6), r + np.uint64(7)
    return (
        linear(p, lower, upper, t, r), linear(p, lower, upper, t, r1), linear(p, lower, upper, t, r2),
        linear(p, lower, upper, t, r3), linear(p, lower, upper, t, r4), linear(p, lower, upper, t, r5),
        linear(p, lower, upper, t, r6), linear(p, lower, upper, t, r7),
    )  # fmt: skip


def times_8(x, y):
    """Products of eight numbers by eight."""
    return (
        x[0] * y[0], x[1] * y[1], x[2] * y[2], x[3] * y[3],
        x[4] * y[4], x[5] * y[5], x[6] * y[6], x[7] * y[7],
    )  # fmt: skip


def read_8(d, at, jump):
    """d[at + r jump] of r from 0 to 7."""
    two = jump + jump
    four = two + two
    return (
        d[at], d[at + jump], d[at + two], d[at + two + jump],
        d[at + four], d[at + four + jump], d[at + four + two], d[at + four + two + jump],
    )  # fmt: skip


def put_8(scratch, at, x):
    """scratch[at : at + 8] = x."""
    store_8(scratch, at, x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7])


def sent_8(field, planes, lines, d, at, jump, r, scratch):
    """What d[at + r jump] sends to components r to r + 7 of all factors into scratch. All loads stand before
    all stores, so that they become vectors."""
    xy, xz, yz = plane_8(field, planes[0], r), plane_8(field, planes[1], r), plane_8(field, planes[2], r)
    sent, to, each = read_8(d, at, jump), np.uint64(AT) + r, np.uint64(FEATURES)
    if FACTORS == 6:
        x, y, z = line_8(field, lines[0], r), line_8(field, lines[1], r), line_8(field, lines[2], r)
        sent_on = times_8(sent, times_8(xy, times_8(xz, yz)))
        sent = times_8(sent, times_8(x, times_8(y, z)))
        first = to + np.uint64(3) * each
        put_8(scratch, first, times_8(sent_on, times_8(y, z)))
        put_8(scratch, first + each, times_8(sent_on, times_8(x, z)))
        put_8(scratch, first + each + each, times_8(sent_on, times_8(x, y)))
    put_8(scratch, to, times_8(sent, times_8(xz, yz)))
    put_8(scratch, to + each, times_8(sent, times_8(xy, yz)))
    put_8(scratch, to + each + each, times_8(sent, times_8(xy, xz)))


# -- compiled: all grids -------------------------------------------------------------------------------------


def forward(field, unit, scratch, out, base):
    """See encodings."""
    for scale in range(SCALES):
        planes, lines = factors_at(field, scale, unit)
        start = np.uint64(base + (0 if SUMMED else scale * FEATURES))
        for r in range(np.uint64(FEATURES)):
            made = product(field, planes, lines, r)
            out[start + r] = out[start + r] + made if SUMMED and scale > 0 else made


def sent_back(field, unit, d, base, stride, scratch, grad):
    """Adjoint of `forward` for d[base + r stride], of all grids' features."""
    real, jump = field.params.dtype.type, np.uint64(stride)
    for scale in range(SCALES):
        planes, lines = factors_at(field, scale, unit)
        start = np.uint64(base + (0 if SUMMED else scale * FEATURES * stride))
        for tile in range(np.uint64(FEATURES // 8)):
            r = tile * np.uint64(8)
            sent_8(field, planes, lines, d, start + r * jump, jump, r, scratch)
        for m in range(3):
            gathered = np.uint64(AT + m * FEATURES)
            for q in range(4):
                scatter(FEATURES, grad, planes[m][0][q], planes[m][1][q], scratch, gathered)
        if FACTORS == 6:
            for axis in range(3):
                gathered, (lower, upper, t) = np.uint64(AT + (3 + axis) * FEATURES), lines[axis]
                scatter(FEATURES, grad, lower, real(1) - t, scratch, gathered)
                scatter(FEATURES, grad, upper, t, scratch, gathered)


def backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    sent_back(field, unit, d, base, 1, scratch, grad)


def summed(field, unit, scratch):
    """See encodings."""
    total = scratch.dtype.type(0)
    for scale in range(SCALES):
        planes, lines = factors_at(field, scale, unit)
        for r in range(np.uint64(FEATURES)):
            total += product(field, planes, lines, r)
    return total


def summed_backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    sent_back(field, unit, d, base, 0, scratch, grad)


def prefetch_at(field, array, unit):
    """See encodings: the texels of the planes."""
    u, v, w = unit
    inner = 1.0 - 2.0 * MARGIN
    u, v, w = (u - MARGIN) / inner, (v - MARGIN) / inner, (w - MARGIN) / inner
    for scale in range(SCALES):
        nx, ny, nz = field.counts[3 * scale], field.counts[3 * scale + 1], field.counts[3 * scale + 2]
        first = FACTORS * scale
        prefetch_plane(FEATURES, array, field.starts[first], nx, ny, u, v)
        prefetch_plane(FEATURES, array, field.starts[first + 1], nx, nz, u, w)
        prefetch_plane(FEATURES, array, field.starts[first + 2], ny, nz, v, w)
