"""What every reader of meshes gives: surfaces with the paint that colours them, and notes."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from formats.errors import BadMesh, LimitExceeded, listed, printable

MAX_TRIANGLES = 30_000_000
"""Of all surfaces together, as placed."""
FREE_TRIANGLES = 500_000
TRIANGLES_PER_BYTE = 2
"""Small files may place at most FREE_TRIANGLES, larger ones so many per byte: instances cost no bytes."""
MAX_NOTES = 50


class Notes:
    """Sentences about what a file names and what is not honoured, each once."""

    def __init__(self, path: Path | str):
        self.path = path
        self._subjects: dict[str, list[str]] = {}

    def add(self, sentence: str, subject: str | None = None) -> None:
        """A sentence, of which the subject, such as a material, is told with all others of which it holds."""
        if sentence in self._subjects or len(self._subjects) < MAX_NOTES:
            self._subjects.setdefault(sentence, []).extend([] if subject is None else [subject])

    def sentences(self) -> tuple[str, ...]:
        """Led by the file's name."""
        sentences = []
        for sentence, subjects in self._subjects.items():
            about = f"{listed(subjects)}: " if subjects else ""
            sentences.append(printable(f"{self.path}: {about}{sentence}"))
        return tuple(sentences)


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture and how it goes on beyond its borders."""

    pixels: np.ndarray
    """(H, W, 4) uint8 sRGB, straight alpha."""
    wrap: tuple[str, str] = ("repeat", "repeat")
    """Along u and v: "repeat", "clamp" or "mirror"."""
    nearest: bool = False
    """Texels are shown as squares, not mixed."""


@dataclass(frozen=True, eq=False)
class Paint:
    """A factor times a texture."""

    factor: np.ndarray
    """(4,) float32 rgb and alpha."""
    texture: Texture | None = None
    uv: np.ndarray | None = None
    """(V, 2) float32 per vertex, (0, 0) at the texture's upper left corner, v down."""
    reach: np.ndarray | None = None
    """(2, 2) the least and the largest of `uv`. Texels beyond it are not mixed in: where a whole picture is
    laid on a surface, its borders do not take colour from the opposite side."""
    coverage: Texture | None = None
    """A second picture at the same coordinates whose alpha replaces the texture's (`map_d` of .mtl)."""


WHITE = Paint(np.ones(4, np.float32))


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles that share a material, in the world of their file."""

    positions: np.ndarray | None
    """(V, 3) float64; None in a mesh, which holds those of all its surfaces."""
    faces: np.ndarray
    """(F, 3) int32 indices of vertices."""
    paint: Paint = WHITE
    glow: Paint | None = None
    """Added to the colour."""
    colours: np.ndarray | None = None
    """(V, 4) float32 rgb and alpha of vertices, which multiply the paint."""
    face_colours: np.ndarray | None = None
    """(F, 4) float32."""
    linear: bool = False
    """Factors and colours are linear, as in glTF, and textures are decoded before anything is mixed."""
    cutoff: float | None = None
    """Alpha below which there is no surface."""
    blend: bool = False
    """Alpha is how much of a ray is stopped. Without cutoff and blend, alpha is ignored."""
    single_sided: bool = False
    """The file wants it seen from its front alone."""


def check_budget(path: Path | str, triangles: int, n_bytes: int) -> None:
    """Raises LimitExceeded where so many triangles of a file of so many bytes are too many to be placed."""
    most = min(MAX_TRIANGLES, max(FREE_TRIANGLES, TRIANGLES_PER_BYTE * n_bytes))
    if triangles > most:
        raise LimitExceeded(
            f"{path}: the mesh has {triangles:,} triangles with all its instances, at most {most:,} are read "
            f"of its {n_bytes:,} bytes; simplify it"
        )


def check_indices(path: Path | str, indices: np.ndarray, count: int) -> None:
    """Raises BadMesh where an index lies outside [0, count)."""
    if len(indices) and (indices.min() < 0 or indices.max() >= count):
        raise BadMesh(
            f"{path}: a face refers to a vertex that does not exist (there are {count:,}); "
            "export the mesh again"
        )


def laid(paint: Paint, uv: np.ndarray) -> Paint:
    """Paint whose pictures lie at (V, 2) coordinates, v down; those are made finite, and of a size that whole
    texels can be counted in."""
    uv = np.clip(np.nan_to_num(uv, nan=0.0, posinf=0.0, neginf=0.0), -1e6, 1e6).astype(np.float32)
    return replace(paint, uv=uv, reach=np.stack([uv.min(0), uv.max(0)]).astype(np.float64))


def opaque(pixels: np.ndarray) -> np.ndarray:
    """(H, W, 4) with alpha 255."""
    pixels = pixels.copy()
    pixels[..., 3] = 255
    return pixels


def sound_colours(colours: np.ndarray) -> np.ndarray:
    """(V, 4) float32 of (V, 3) or (V, 4) colours, alpha 1 where there is none."""
    rgba = np.ones((len(colours), 4), np.float32)
    rgba[:, : colours.shape[1]] = np.clip(np.nan_to_num(colours, nan=0.0), 0, 1000)
    return rgba
