"""What every reader of splats gives: Gaussians in the world of their file, with finite numbers."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from formats.errors import BadSplats, LimitExceeded, counted, listed, printable

MAX_FILE = 2**32
MAX_SPLATS = 40_000_000
FREE_SPLATS = 200_000
SPLATS_PER_BYTE = 1
"""A compressed file may hold FREE_SPLATS, or so many for each of its bytes; real ones take eight for one."""
FARTHEST = 1e12
"""Positions, sizes and SH coefficients beyond it are damage; their squares are finite in float32."""
THINNEST = 1e-6
"""Least share of a splat's longest axis that its others have. A disc has an axis of length 0, and nothing
could be divided by it."""
DOWN_Y, UP_Y, UP_Z = (0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
ANTIALIASED = "was trained with antialiasing (Mip-Splatting's 2D filter), which is not imitated"
SH_0 = 0.28209479177387814
"""The constant harmonic: a colour is 0.5 + SH_0 times its first coefficient."""
_ADMIT: ContextVar[Callable[[int], None] | None] = ContextVar("admit", default=None)
DISCS = "its splats are discs of 2D Gaussian splatting; they are shown as very thin ellipsoids"


@dataclass(frozen=True, eq=False)
class Splats:
    """N Gaussians. Splat i has the covariance R diag(scales²) Rᵀ, and hides `opacities` of what lies behind
    its centre; its colour, seen along the unit direction d from the camera to the centre, is
    max(0, 0.5 + Σ Y_k(d) harmonics[i, k]), sRGB as captured, with the basis Y of `harmonics.py`.

    The frame is that of a .ply of 3DGS of the same content, with the axes right, down, front: what other
    formats store with axes of their own (SPZ, glTF) is turned.
    """

    centres: np.ndarray
    """(N, 3) float32."""
    scales: np.ndarray
    """(N, 3) float32 > 0, standard deviations along the splat's own axes, in units of the file's world."""
    rotations: np.ndarray
    """(N, 4) float32 unit quaternions w, x, y, z, from the splat's axes to the world."""
    opacities: np.ndarray
    """(N,) float32 in [0, 1]."""
    harmonics: np.ndarray
    """(N, K, 3) float32 SH coefficients of red, green and blue, K = 1, 4, 9 or 16, in the world's axes."""
    kind: str
    """The format, in words."""
    up: tuple[float, float, float]
    """The direction that is up by what the file says, or else by the habit of its format."""
    notes: tuple[str, ...] = ()
    """What the file holds that is not honoured, and what was left out: sentences led by the file's name."""

    def __len__(self) -> int:
        return len(self.centres)


def gathered(
    path: Path | str,
    kind: str,
    *,
    centres: np.ndarray,
    scales: np.ndarray,
    rotations: np.ndarray,
    opacities: np.ndarray,
    harmonics: np.ndarray,
    up: tuple[float, float, float] = DOWN_Y,
    notes: Sequence[str] = (),
) -> Splats:
    """Splats of arrays as a file holds them, shapes as in `Splats`, of which those with NaN, infinite or
    absurd numbers are left out; quaternions of any length, that of no length is no rotation, which a note
    says. Raises BadSplats where none is left."""
    notes, count = list(notes), len(centres)
    sizes = scales.max(1) if count else scales[:, 0]
    sound = _within(centres) & _within(scales) & (scales.min(1, initial=0) >= 0) & (sizes > 0)
    sound &= _within(rotations) & (opacities >= 0) & (opacities <= 1) & _within(harmonics)
    if not sound.any():
        raise BadSplats(f"{path}: holds no splat with finite numbers; export it again")
    if not sound.all():
        left = counted(count - int(sound.sum()), "splat has", "splats have")
        notes.append(f"{left} NaN, infinite or absurd numbers, or no size, and are left out")
        centres, scales, rotations, opacities, harmonics = (
            each[sound] for each in (centres, scales, rotations, opacities, harmonics)
        )
    if still := len(rotations) - int(np.count_nonzero(np.any(rotations, axis=1))):
        left = counted(still, "splat has", "splats have")
        notes.append(f"{left} a quaternion of no length, and lie along the axes")
    return Splats(
        np.ascontiguousarray(centres, np.float32),
        thickened(scales),
        _unit(rotations),
        np.ascontiguousarray(opacities, np.float32),
        np.ascontiguousarray(harmonics, np.float32),
        kind,
        up,
        tuple(printable(f"{path}: {note}") for note in notes),
    )


def joined(path: Path | str, kind: str, pieces: list[Splats], notes: Sequence[str] = ()) -> Splats:
    """Splats of several, with as many coefficients as any has, in the first one's world. Raises BadSplats."""
    count = max(piece.harmonics.shape[1] for piece in pieces)
    more = [[(0, 0), (0, count - piece.harmonics.shape[1]), (0, 0)] for piece in pieces]
    return gathered(
        path,
        kind,
        centres=np.concatenate([piece.centres for piece in pieces]),
        scales=np.concatenate([piece.scales for piece in pieces]),
        rotations=np.concatenate([piece.rotations for piece in pieces]),
        opacities=np.concatenate([piece.opacities for piece in pieces]),
        harmonics=np.concatenate([np.pad(p.harmonics, w) for p, w in zip(pieces, more, strict=True)]),
        up=pieces[0].up,
        notes=notes,
    )


def thickened(scales: np.ndarray) -> np.ndarray:
    """(N, 3) float32 scales of which none is 0."""
    scales = np.maximum(scales, THINNEST * scales.max(1, keepdims=True))
    return np.maximum(scales.astype(np.float32), np.finfo(np.float32).tiny)


def _within(rows: np.ndarray) -> np.ndarray:
    """(N,) whether all numbers of a row are finite and not absurd."""
    axes = tuple(range(1, rows.ndim))
    return (rows.max(axes, initial=0) <= FARTHEST) & (rows.min(axes, initial=0) >= -FARTHEST)


def _unit(quaternions: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(quaternions.astype(np.float64), axis=1, keepdims=True)
    units = np.where(lengths > 0, quaternions / np.where(lengths > 0, lengths, 1), [1.0, 0, 0, 0])
    return units.astype(np.float32)


def check_count(path: Path | str, count: int, n_bytes: int | None = None) -> None:
    """Raises BadSplats for none, LimitExceeded for more than are read, or than so many compressed bytes can
    hold, and what `admitted` raises. Every reader asks this before it makes an array of so many splats."""
    if not count:
        raise BadSplats(f"{path}: holds no splats; export it again")
    most = MAX_SPLATS
    if n_bytes is not None:
        most = min(most, max(FREE_SPLATS, SPLATS_PER_BYTE * n_bytes))
    if count > most:
        raise LimitExceeded(f"{path}: counts {count:,} splats, but at most {most:,} are read of such a file")
    if (admit := _ADMIT.get()) is not None:
        admit(count)


@contextlib.contextmanager
def admitted(admit: Callable[[int], None]) -> Iterator[None]:
    """While splats are read in it, `admit` is given how many there are before they are; it raises to refuse
    them."""
    token = _ADMIT.set(admit)
    try:
        yield
    finally:
        _ADMIT.reset(token)


def of_colours(colours: np.ndarray) -> np.ndarray:
    """(N, 1, 3) coefficients of the degree 0 that give (N, 3) colours in [0, 1]."""
    return ((colours - 0.5) / SH_0).astype(np.float32)[:, None]


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-x)) in float64, without overflow; 0 and 1 of infinite numbers."""
    logits = logits.astype(np.float64)
    small = np.exp(-np.abs(logits))
    return np.where(logits >= 0, 1, small) / (1 + small)


def sizes_of(logarithms: np.ndarray, notes: list[str]) -> np.ndarray:
    """(N, 3) float64 standard deviations of (N, 1 to 3) logarithms: one is that of a ball, and the third of a
    disc is 0."""
    sizes = np.exp(logarithms.astype(np.float64))
    if sizes.shape[1] == 2:
        notes.append(DISCS)
        return np.pad(sizes, [(0, 0), (0, 1)])
    return np.broadcast_to(sizes, (len(sizes), 3))


def coefficients_of(path: Path | str, numbers: int, notes: list[str]) -> tuple[int, int]:
    """How many coefficients beyond the first a colour has of a file that stores so many numbers for three
    colours, and how many of them are read: those of the degrees 1 to 3."""
    stored, rest = divmod(numbers, 3)
    if rest or stored not in (0, 3, 8, 15, 24):
        raise BadSplats(
            f"{path}: stores {numbers} numbers of spherical harmonics for a splat, expected 0, 9, 24 or 45; "
            "export it again"
        )
    if stored > 15:
        notes.append("its spherical harmonics of degree 4 are left out; those of degrees 0 to 3 are read")
    return stored, min(stored, 15)


def not_honoured(names, notes: list[str], what: str) -> None:
    """A note about things that a file holds beside splats, where there are any."""
    if names:
        notes.append(f"holds {what} that are not honoured: {listed(names)}")
