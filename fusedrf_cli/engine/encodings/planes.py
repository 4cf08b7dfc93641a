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
from fusedrf_cli.engine.kernels.prefetch import prefetch
from fusedrf_cli.engine.kernels.primitives import add_scaled, scatter

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


def sizes(
    features: int, scales: list, summed: bool = False, lines: bool = False, margin: float = 0.0
) -> dict[str, int | float]:
    """See encodings; scratch holds the factors at a point, and the gradient of one."""
    factors = 6 if lines else 3
    return {
        "FEATURES": features, "SCALES": len(scales), "FACTORS": factors, "SUMMED": int(summed),
        "WIDTH": features * (1 if summed else len(scales)), "ROOM": (factors + 1) * features,
        "MARGIN": float(margin),
    }  # fmt: skip


def sections(
    resolution: tuple, features: int, scales: list, lines: bool = False, **options
) -> list[ParameterBlock]:
    """See encodings."""
    blocks = []
    for s, counts in enumerate(scales):
        for m, (a, b) in enumerate(AXES[: 6 if lines else 3]):
            name = f"plane_{s}_{m}" if m < 3 else f"line_{s}_{m - 3}"
            texels = (counts[a], counts[b]) if m < 3 else (counts[a],)
            blocks.append(ParameterBlock(name, (*texels, features), spread=0.3))
    return blocks


def arrays(field, starts: np.ndarray, features: int, scales: list, **options) -> Arrays:
    """See encodings."""
    return Arrays(starts, np.array(scales, np.int64).reshape(-1))


def reference(
    field, sections: dict, unit: torch.Tensor, read: None, features: int, scales: list, summed: bool = False,
    lines: bool = False, margin: float = 0.0,
) -> torch.Tensor:  # fmt: skip
    """See encodings."""
    unit, made = ((unit - margin) / (1 - 2 * margin)).clamp(0, 1), []
    for s in range(len(scales)):
        product = 1
        for m, (a, b) in enumerate(AXES[:3]):
            plane = sections[f"plane_{s}_{m}"]
            product = product * torch_reference.bilinear(plane, unit[:, a], unit[:, b])
        for axis in range(3 * lines):
            product = product * torch_reference.linear(sections[f"line_{s}_{axis}"], unit[:, axis])
        made.append(product)
    return sum(made) if summed else torch.cat(made, 1)


def bound(
    sections: dict, read: None, features: int, scales: list, summed: bool = False, **options
) -> torch.Tensor:
    """See encodings."""
    peaks = torch.stack([largest(view, kept=1) for view in sections.values()])
    products = peaks.view(len(scales), -1, features).prod(1)
    return products.sum(0) if summed else products.view(-1)


# -- compiled ------------------------------------------------------------------------------------------------


def below(field, scale, axis, unit):
    """The texel below a point on an axis of a grid, and the share of the one above."""
    last = field.counts[3 * scale + axis] - 1
    u = unit[0] if axis == 0 else (unit[1] if axis == 1 else unit[2])
    at = min(max((u - MARGIN) / (1.0 - 2.0 * MARGIN), 0.0), 1.0) * last
    i = min(int(at), last - 1)
    return i, at - i


def corner(field, scale, m, q, unit):
    """Where the row of corner q = 2 i + j of a plane, or of end q of a line, begins, and its weight."""
    real, start = field.params.dtype.type, field.starts[FACTORS * scale + m]
    if m >= 3:
        i, a = below(field, scale, m - 3, unit)
        return np.uint64(start + (i + q) * FEATURES), real(a if q else 1.0 - a)
    second = 1 if m == 0 else 2
    i, a = below(field, scale, 1 if m == 2 else 0, unit)
    j, b = below(field, scale, second, unit)
    weight = (a if q & 2 else 1.0 - a) * (b if q & 1 else 1.0 - b)
    row = (i + (q >> 1)) * field.counts[3 * scale + second] + j + (q & 1)
    return np.uint64(start + row * FEATURES), real(weight)


def factors(field, scale, unit, scratch):
    """The factors of a grid's features at a point into scratch[AT:], one after the other."""
    for m in range(FACTORS):
        at = np.uint64(AT + m * FEATURES)
        for r in range(np.uint64(FEATURES)):
            scratch[at + r] = 0
        for q in range(4 if m < 3 else 2):
            row, weight = corner(field, scale, m, q, unit)
            add_scaled(FEATURES, scratch, at, weight, field.params, row)


def product(scratch, r, left_out):
    """The product of all factors but one of feature r."""
    total = scratch.dtype.type(1)
    for m in range(FACTORS):
        if m != left_out:
            total *= scratch[np.uint64(AT + m * FEATURES) + r]
    return total


def forward(field, unit, scratch, out, base):
    """See encodings."""
    for scale in range(SCALES):
        factors(field, scale, unit, scratch)
        start = np.uint64(base + (0 if SUMMED else scale * FEATURES))
        for r in range(np.uint64(FEATURES)):
            made = product(scratch, r, -1)
            out[start + r] = out[start + r] + made if SUMMED and scale > 0 else made


def sent_back(field, unit, d, base, stride, scratch, grad):
    """Adjoint of `forward` for d[base + r stride], of all grids' features."""
    gathered = np.uint64(AT + FACTORS * FEATURES)
    for scale in range(SCALES):
        factors(field, scale, unit, scratch)
        start = np.uint64(base + (0 if SUMMED else scale * FEATURES * stride))
        for m in range(FACTORS):
            for r in range(np.uint64(FEATURES)):
                scratch[gathered + r] = d[start + r * np.uint64(stride)] * product(scratch, r, m)
            for q in range(4 if m < 3 else 2):
                row, weight = corner(field, scale, m, q, unit)
                scatter(FEATURES, grad, row, weight, scratch, gathered)


def backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    sent_back(field, unit, d, base, 1, scratch, grad)


def summed(field, unit, scratch):
    """See encodings."""
    total = scratch.dtype.type(0)
    for scale in range(SCALES):
        factors(field, scale, unit, scratch)
        for r in range(np.uint64(FEATURES)):
            total += product(scratch, r, -1)
    return total


def summed_backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    sent_back(field, unit, d, base, 0, scratch, grad)


def prefetch_at(field, array, unit):
    """See encodings: two neighbours share a line most often."""
    for scale in range(SCALES):
        for m in range(FACTORS):
            for q in range(0, 4 if m < 3 else 2, 2):
                prefetch(array, corner(field, scale, m, q, unit)[0])
