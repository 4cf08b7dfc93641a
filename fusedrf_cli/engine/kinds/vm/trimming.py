"""VM fields with other numbers of components, and leaving out of them what pictures do not need: texels and
rows of a hash grid that nothing reads, and components of little energy."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from fusedrf_cli.engine.encodings.hash_runs import EMPTY_FROM, HashGrid, hashed_row
from fusedrf_cli.engine.encodings.plane_line import MODES
from fusedrf_cli.engine.kinds.asked_rows import Lattice, asked_rows
from fusedrf_cli.engine.kinds.vm.field import DETAIL, VMField, VMShape
from fusedrf_cli.engine.settings import current

COMPONENTS = "density_rank", "colour_rank", "sh_degree"


@dataclass(frozen=True)
class TrimmingConfig:
    """How a field is made smaller."""

    regular: float = 1e-9
    """Of the largest entry of a Gram matrix, added to its diagonal."""
    rounded: float = 1e-3
    """Of a density before activation: more than rounding makes of it."""


def read_texels(field: VMField, mode: int) -> np.ndarray:
    """(na, nb) bool: the plane texels of a mode that some point of an occupied cell reads."""
    a, b, c = MODES[mode]
    held = field.occupancy.occupied.any(axis=c)
    sums = np.zeros(np.array(held.shape) + 1, np.int64)
    sums[1:, 1:] = held.cumsum(0).cumsum(1)
    (a0, a1), (b0, b1) = (
        reading_cells(n, cells)
        for n, cells in zip((field.resolution[a], field.resolution[b]), held.shape, strict=True)
    )
    return (sums[a1[:, None], b1] - sums[a0[:, None], b1] - sums[a1[:, None], b0] + sums[a0[:, None], b0]) > 0


def reading_cells(texels: int, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Two (texels,) int64: the first of the cells along an axis whose points read a texel, and the one after
    the last. A texel is read from less than one spacing on either side of it.
    """
    at, spacing = np.arange(texels) * cells / (texels - 1), cells / (texels - 1)
    first = np.floor(at - spacing + 1e-9)
    after = np.ceil(at + spacing - 1e-9)
    return first.clip(0, cells).astype(np.int64), after.clip(0, cells).astype(np.int64)


def without_unread(field: VMField) -> VMField:
    """The same field with 0 in all plane texels that no occupied cell reads: it answers the same, and such
    texels cost next to nothing where blocks of numbers share a scale.
    """
    trimmed = field.with_params(field.params.clone())
    sections = trimmed.sections()
    for mode in range(3):
        unread = torch.from_numpy(~read_texels(trimmed, mode)).to(field.params.device)
        for what in ("density", "colour"):
            sections[f"{what}_plane_{mode}"][unread] = 0
    return trimmed


def without_unqueried(field: VMField) -> VMField:
    """The same field with 0 in all rows of its hash grid that no occupied cell asks, and in all unread
    texels: it answers the same there, and a file has the other rows alone."""
    if field.params.device.type != "cpu":
        return without_unqueried(field.to("cpu")).to(field.params.device)
    trimmed = without_unread(field)
    if field.shape.hashed:
        trimmed.sections()[DETAIL][torch.from_numpy(~queried_rows(field, field.shape.hashed))] = 0
    return trimmed


def queried_rows(field: VMField, hashed: HashGrid) -> np.ndarray:
    """(R,) bool: the rows of a field's hash grid that some point of an occupied cell asks, where planes and
    lines say that there may be density."""
    levels = [Lattice(field.box, h, hashed.rows, partial(hashed_row, hashed)) for h in hashed.spacings]
    return asked_rows(levels, (occupied_texels(field), field.occupancy.occupied))


def occupied_texels(field: VMField) -> np.ndarray:
    """(nx - 1, ny - 1, nz - 1) bool: the cells between texels in which planes and lines may say that there is
    density. A product of bilinear and linear is trilinear, so it is largest at a corner."""
    sections = field.sections()
    planes, lines = (
        [sections[f"density_{what}_{m}"].double() for m in range(3)] for what in ("plane", "line")
    )
    cells = []
    for i in range(field.resolution[0]):  # a layer of texels at a time
        layer = planes[0][i] @ lines[0].T + lines[1] @ planes[1][i].T + (planes[2] @ lines[2][i])
        high = (layer + field.shift > EMPTY_FROM - current(TrimmingConfig).rounded).numpy()
        square = high[:-1, :-1] | high[1:, :-1] | high[:-1, 1:] | high[1:, 1:]
        cells.append(square)
    return np.stack([one | other for one, other in zip(cells[:-1], cells[1:], strict=True)])


def components(shape: VMShape) -> tuple[int, ...]:
    """Ranks and SH degree of a shape."""
    return tuple(getattr(shape, name) for name in COMPONENTS)


def smaller_shape(a: VMShape, b: VMShape) -> VMShape:
    """The first shape with no more components and bands than the second has."""
    return replace(a, **{name: min(getattr(a, name), getattr(b, name)) for name in COMPONENTS})


def common_shape(shapes: list[VMShape]) -> VMShape:
    """The first shape with as many components and bands as any of them has."""
    most = {name: max(getattr(shape, name) for shape in shapes) for name in COMPONENTS}
    return replace(shapes[0], **most)


def reshaped(field: VMField, shape: VMShape) -> VMField:
    """The same field with the components and coefficients of a shape, as many at least, the new ones zero."""
    wide = replace(field.shape, **{name: getattr(shape, name) for name in COMPONENTS})
    if wide == field.shape:
        return field
    new, old_rank = in_shape(field, wide), field.shape.colour_rank
    target = new.sections()
    for name, old in field.sections().items():
        if name == "colour_basis":
            for mode in range(3):
                source, at = old[..., mode * old_rank : (mode + 1) * old_rank], mode * wide.colour_rank
                target[name][:, : source.shape[1], at : at + source.shape[2]] = source
        else:
            target[name][..., : old.shape[-1]] = old
    return new


def in_shape(field: VMField, shape: VMShape) -> VMField:
    """A field of zeros of a shape, which lies as another does."""
    new = type(field)(shape, field.box, field.resolution, field.scale, field.shift, occupancy=field.occupancy)
    new.params, new.name = new.params.to(field.params.dtype), field.name
    return new


def without_detail(field: VMField) -> VMField:
    """A field without what is finer than its texels."""
    return with_detail(field, None)


def with_detail(field: VMField, hashed: HashGrid | None) -> VMField:
    """A field with another detail, which begins as 0, or with none."""
    if field.shape.hashed is None and hashed is None:
        return field
    new = in_shape(field, replace(field.shape, hashed=hashed))
    old = field.sections()
    for name, view in new.sections().items():
        if name != DETAIL:
            view.copy_(old[name])
    return new


def truncated(field: VMField, shape: VMShape) -> VMField:
    """The field with at most a shape's ranks and SH bands, what it drops chosen by energy over the box.

    Density: a mode's Σ P_r ⊗ L_r is a matrix of plane by line texels, and its first singular vectors are the
    nearest of lower rank (Eckart and Young 1936). Colour: L_r comes with a row B_r of the basis, so that a
    truncated SVD could not be told as line times basis; components are kept one by one, each time the one
    that leaves least, and the planes fitted anew to those kept by least squares.
    """
    least = smaller_shape(field.shape, shape)
    if least == field.shape:
        return field
    if field.params.device.type != "cpu":
        return truncated(field.to("cpu"), shape).to(field.params.device)
    small, sections = in_shape(field, least), field.sections()
    old = {name: view.double().numpy() for name, view in sections.items() if name != DETAIL}
    old["colour_basis"] = old["colour_basis"][:, : least.coefficients]
    target = small.sections()
    for name, values in truncated_sections(old, least).items():
        target[name].copy_(torch.from_numpy(values))
    if DETAIL in target:
        target[DETAIL].copy_(sections[DETAIL])
    return small


def truncated_sections(old: dict[str, np.ndarray], shape: VMShape) -> dict[str, np.ndarray]:
    """The 13 sections of a field at lower ranks, from those it has (float64)."""
    new, rank = {}, old["colour_line_0"].shape[1]
    basis = old["colour_basis"]
    kept_basis = np.zeros((*basis.shape[:2], 3 * shape.colour_rank))
    for m in range(3):
        plane, line = old[f"density_plane_{m}"], old[f"density_line_{m}"]
        new[f"density_plane_{m}"], new[f"density_line_{m}"] = leading(plane, line, shape.density_rank)
        plane, line = old[f"colour_plane_{m}"], old[f"colour_line_{m}"]
        rows = basis[..., m * rank : (m + 1) * rank]
        kept, mixed = fewer_components(plane, line, rows.reshape(-1, rank), shape.colour_rank)
        new[f"colour_plane_{m}"], new[f"colour_line_{m}"] = mixed, line[:, kept]
        kept_basis[..., m * shape.colour_rank : (m + 1) * shape.colour_rank] = rows[..., kept]
    return new | {"colour_basis": kept_basis}


def leading(plane: np.ndarray, line: np.ndarray, rank: int) -> tuple[np.ndarray, np.ndarray]:
    """Plane (na, nb, rank) and line (nc, rank) of the nearest product sum of that rank to (na, nb, R) and
    (nc, R).
    """
    if plane.shape[-1] <= rank:
        return plane, line
    q, r = np.linalg.qr(plane.reshape(-1, plane.shape[-1]))
    left, values, right = np.linalg.svd(r @ line.T, full_matrices=False)
    count = min(rank, len(values))
    root = np.sqrt(values[:count])
    lines, planes = np.zeros((len(line), rank)), np.zeros((*plane.shape[:2], rank))
    lines[:, :count] = right[:count].T * root
    planes[..., :count] = (q @ (left[:, :count] * root)).reshape(*plane.shape[:2], count)
    return planes, lines


def fewer_components(
    plane: np.ndarray, line: np.ndarray, basis: np.ndarray, count: int
) -> tuple[list[int], np.ndarray]:
    """Which `count` of R colour components to keep, in order of choice, and the planes (na, nb, count) that
    with them come nearest to plane (na, nb, R) ⊗ line (nc, R) ⊗ basis (K, R).
    """
    rank = plane.shape[-1]
    if rank <= count:
        return list(range(rank)), plane
    flat = plane.reshape(-1, rank)
    of_planes, of_rest = flat.T @ flat, (line.T @ line) * (basis.T @ basis)
    of_rest = of_rest + current(TrimmingConfig).regular * of_rest.max() * np.eye(rank)
    kept: list[int] = []
    for _ in range(count):
        others = [r for r in range(rank) if r not in kept]
        kept.append(max(others, key=lambda r: energy_of([*kept, r], of_planes, of_rest)))
    mix = np.linalg.solve(of_rest[np.ix_(kept, kept)], of_rest[kept])
    return kept, plane @ mix.T


def energy_of(kept: list[int], of_planes: np.ndarray, of_rest: np.ndarray) -> float:
    """Squared norm of what the kept components can say of all of them, from their Gram matrices (R, R)."""
    mix = np.linalg.solve(of_rest[np.ix_(kept, kept)], of_rest[kept])
    return float(np.einsum("rs,kr,ks->", of_planes, of_rest[kept], mix))
