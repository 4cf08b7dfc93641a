"""How finely a fused field holds what was placed in it, object by object: Nyquist's question, and what
anisotropy costs."""

from dataclasses import dataclass

from fusedrf_cli.engine.composition.affine import Placed


@dataclass(frozen=True)
class ResolutionConfig:
    """What is said about an object's detail."""

    enough_voxels: int = 8
    """Across an object, under which there is no shape left."""
    noted: float = 1.05
    """Times an object's own voxel from which it is held more coarsely."""


@dataclass(frozen=True)
class ResolutionReport:
    """One placed object in a fused field; lengths are in the field's units."""

    name: str
    stretch: float
    """Condition number of the placement's linear part."""
    opacity_off: float
    """By how much the opacity may be off where the object is translucent."""
    own_voxel: float
    """The finest that the source tells apart."""
    held_voxel: float
    """The finest that the fused field tells apart there."""
    voxels_across: float
    """Of the fused field, along the object's longest side."""


def resolution_at_voxel(placed: list[Placed], voxel: float) -> list[ResolutionReport]:
    """What a field of isotropic density with that voxel holds of placed objects."""
    return [
        ResolutionReport(
            p.name, p.condition, opacity_off(p.condition), p.voxel_size, voxel, extent(p) / voxel
        )
        for p in placed
    ]


def extent(placed: Placed) -> float:
    """The longest side of a placed object's box."""
    return float((placed.aabb[3:] - placed.aabb[:3]).max())


def opacity_off(condition: float) -> float:
    """The most by which an isotropic density misses the opacity of one stretched by a condition number κ:
    κ^(-1/(κ-1)) - κ^(-κ/(κ-1)), the largest gap between exp(-τ) and exp(-κτ).

    What is distilled lies somewhere between the densities along the longest and the shortest axis, wherever
    the rays it saw have drawn it; the geometric mean would halve the exponent, if it were known to be met.
    """
    k = condition
    return float(k ** (-1 / (k - 1)) - k ** (-k / (k - 1))) if k > 1 + 1e-9 else 0.0
