"""Choosing by masks: every ray of a masked picture votes for the cells that it shows (FlashSplat, Shen et al.
2024: with the weights of volume rendering the best labels are a majority of such votes, in closed form)."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import distance_transform_edt, maximum_filter, uniform_filter

from fusedrf_cli.engine.rendering.cameras import Camera, projected
from fusedrf_cli.engine.rendering.volume import render_rays
from fusedrf_cli.engine.selection.cells import CellGrid, Selection
from fusedrf_cli.engine.selection.weights import cell_weights
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class VotingConfig:
    """How masks vote for cells."""

    enough: float = 0.02
    """Votes from which a cell is decided by them."""
    behind: float = 2.0
    """Cells behind what a pixel shows, from which its mask says nothing."""
    pointed: float = 50.0
    """How many votes one of a pixel that was pointed at counts for."""
    well_seen: int = 90
    """Percentile of an object's cells, by the weight that cameras give them, from which one is well seen."""
    seed: int = 6_000_011


@dataclass(frozen=True, eq=False)
class MaskedView:
    """A masked picture."""

    camera: Camera
    """In the field's frame."""
    inside: np.ndarray
    """(H, W) bool: which pixels show the object."""
    counted: np.ndarray | None = None
    """(H, W) bool: which pixels say so; None: all, and the object is nowhere outside of them."""
    surfaces: list[tuple[object, np.ndarray]] = field(default_factory=list, repr=False)
    """Fields and their `depths`, which both looks at one ask for."""

    def depths(self, of) -> np.ndarray:
        """(H, W) see `depths`."""
        if not any(field is of for field, _ in self.surfaces):
            self.surfaces.append((of, depths(of, self.camera)))
        return next(depth for field, depth in self.surfaces if field is of)


def chosen_by_masks(lattice: CellGrid, looks: Sequence[MaskedView]) -> Selection:
    """The object that masks show: cells by the majority of votes; those that got none by whether the masks
    leave room for them there and the nearest decided cell is its; smoothed, and in one piece."""
    against, votes = tallied(lattice, looks)
    total, share = smoothed(lattice, against, votes)
    decided = total > current(VotingConfig).enough
    room, shut = hull(lattice, looks)
    known = decided | shut
    object_cells = np.where(decided, share > 0.5, False)
    object_cells |= ~known & room & nearest(lattice, known, object_cells)
    chosen = lattice.pieces(object_cells, votes)
    return Selection(lattice, chosen, agreement(votes, against))


def shown_by(field, lattice: CellGrid, cameras: Sequence[Camera]) -> np.ndarray:
    """(M,) how much cameras in the frame see of each cell in a field, which may be the lattice's own without
    something: the largest sum of weights (NeRF, eq. 3) in the cell or one beside it."""
    weights = np.zeros(len(lattice.index))
    for camera in cameras:
        rays_o, rays_d = camera.rays()
        met = reaching(lattice, rays_o, rays_d)
        rays_o, rays_d = rays_o[met], rays_d[met]
        half, every = np.full(len(rays_o), 0.5), np.ones(len(rays_o), bool)
        sums = cell_weights(field, rays_o, rays_d, half, every, lattice.grid)
        weights += sums[1][lattice.grid.occupied]
    return maximum_filter(lattice.spread(weights), 3)[lattice.grid.occupied]


def reaching(lattice: CellGrid, rays_o: np.ndarray, rays_d: np.ndarray) -> np.ndarray:
    """(N,) bool: which rays (N, 3) meet the box around the cells of a lattice."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(corner - rays_o) / rays_d for corner in lattice.bounds])
    return np.nanmax(ends.min(0), 1).clip(0) <= np.nanmin(ends.max(0), 1)


def well_shown(selection: Selection, shown: np.ndarray) -> float:
    """How much (`shown_by`, (M,)) cameras see of a cell of a selected object that they see well."""
    object_shown = shown[selection.chosen & selection.lattice.dense]
    return float(np.percentile(object_shown, current(VotingConfig).well_seen)) if len(object_shown) else 0.0


def agreement(votes: np.ndarray, against: np.ndarray) -> float:
    """How far the votes (M,) for and against cells agree: 1 where every cell has one sort alone, 0 where each
    has as many of both."""
    total = float((votes + against).sum())
    return float(np.abs(votes - against).sum() / total) if total else 0.0


def tallied(lattice: CellGrid, looks: Sequence[MaskedView]) -> np.ndarray:
    """(2, M) what the pixels outside and inside of the masks show of each cell: sums of weights (NeRF,
    eq. 3)."""
    config = current(VotingConfig)
    generator, tally = np.random.default_rng(config.seed), 0.0
    for view in looks:
        rays_o, rays_d = view.camera.rays()
        jitter, weight = generator.random(len(rays_o)), 1.0
        hits = reaching(lattice, rays_o, rays_d)
        if view.counted is not None:
            hits &= view.counted.ravel()
            weight = config.pointed
        rays = rays_o[hits], rays_d[hits], jitter[hits], view.inside.ravel()[hits]
        sums = cell_weights(lattice.field, *rays, lattice.grid)
        tally = tally + weight * sums[:, lattice.grid.occupied]
    return tally


def smoothed(lattice: CellGrid, against: np.ndarray, votes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(M,) all votes of each cell, and the share of those for it, with those of the cells around it."""
    for_it, not_it = (
        uniform_filter(lattice.spread(sums.astype(np.float32)), 3)[lattice.grid.occupied]
        for sums in (votes, against)
    )
    total = votes + against
    share = (votes + for_it) / np.maximum(total + for_it + not_it, 1e-9)
    return total + for_it + not_it, share


def hull(lattice: CellGrid, looks: Sequence[MaskedView]) -> tuple[np.ndarray, np.ndarray]:
    """(M,) bool: cells that some mask leaves room for and none shuts out; and those that one does, of whose
    picture they lie outside the mask and not hidden behind what it shows."""
    room, shut = np.zeros((2, len(lattice.points)), bool)
    for view in looks:
        if view.counted is not None:
            continue
        pixels, away, shown = projected(view.camera, lattice.points)
        row, column = pixels[shown].astype(int).T[::-1]
        inside = view.inside[row, column]
        room[np.flatnonzero(shown)[inside]] = True
        outside = np.flatnonzero(shown)[~inside]
        surface = view.depths(lattice.field)[row[~inside], column[~inside]]
        distance = np.linalg.norm(lattice.points[outside] - view.camera.camera_to_world[:3, 3], axis=1)
        shut[outside[distance < surface + current(VotingConfig).behind * lattice.widths[outside]]] = True
    return room & ~shut, shut


def depths(field, camera: Camera) -> np.ndarray:
    """(H, W) how far away what a camera shows is, in the field's frame; inf where it shows nothing."""
    rays = camera.rays()
    rendered = render_rays(field, *rays)
    opacity, depth = rendered[:, 3], rendered[:, 4]
    away = np.where(opacity > 0.5, depth / np.maximum(opacity, 1e-6), np.inf)
    return away.reshape(camera.height, camera.width)


def nearest(lattice: CellGrid, known: np.ndarray, is_object: np.ndarray) -> np.ndarray:
    """(M,) bool: what the nearest known cell is, for each cell."""
    if not known.any():
        return np.zeros_like(is_object)
    at = distance_transform_edt(~lattice.spread(known), return_distances=False, return_indices=True)
    return lattice.spread(is_object)[tuple(at)][lattice.grid.occupied]
