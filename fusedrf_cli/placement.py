"""An object's placement: from the options of the command line to the keywords of a scene's node."""

import math
from collections.abc import Sequence

from fusedrf_cli.errors import UsageProblem

Vector = tuple[float, float, float]
STANDS = 0.9
"""The cosine of how far what stands upright leans at most."""
AXES = {
    (1, 0, 0): "+x", (-1, 0, 0): "-x", (0, 1, 0): "+y", (0, -1, 0): "-y", (0, 0, 1): "+z", (0, 0, -1): "-z",
}  # fmt: skip


def node_words(
    translate: Vector | None, rotate: Vector | None, scale: Vector | None, matrix: tuple | None
) -> dict[str, tuple]:
    """Keywords of `formats.scene.make_node`: scaled, then turned, then moved; or placed by `matrix` alone.

    Raises UsageProblem where `matrix` comes with another option.
    """
    words = {
        "translation": translate,
        "rotation": rotate and quaternion(rotate),
        "scale": scale,
        "matrix": matrix,
    }
    options = {word: value for word, value in words.items() if value is not None}
    if matrix is not None and len(options) > 1:
        raise UsageProblem("--matrix replaces -t, -r and -s; leave out these, or leave out --matrix")
    return options


def quaternion(degrees: Vector) -> tuple[float, float, float, float]:
    """Unit quaternion (x, y, z, w) of a turn about the world's x axis, then its y axis, then its z axis.

    >>> [round(part, 3) for part in quaternion((0, 0, 90))]
    [0.0, 0.0, 0.707, 0.707]
    """
    halves = [math.radians(math.remainder(angle, 720)) / 2 for angle in degrees]
    (cx, cy, cz), (sx, sy, sz) = map(math.cos, halves), map(math.sin, halves)
    return (
        sx * cy * cz - cx * sy * sz,
        cx * sy * cz + sx * cy * sz,
        cx * cy * sz - sx * sy * cz,
        cx * cy * cz + sx * sy * sz,
    )


def placed_up(up: Sequence[float] | None, placed: Sequence[Sequence[float]]) -> Vector:
    """Which way what is up in a source's world, None: +z, points in a scene that places it by a (4, 4); of
    length 1."""
    there = [sum(a * b for a, b in zip(row[:3], up or (0, 0, 1), strict=True)) for row in placed[:3]]
    return tuple(part / math.hypot(*there) for part in there)


def common_up(ups: Sequence[Sequence[float] | None], placed: Sequence) -> Vector | None:
    """The up of a scene that places sources, as `placed_up` takes them, which all stand upright by another
    up than +z; None where they do not."""
    if not any(ups):
        return None
    first, *others = (placed_up(*source) for source in zip(ups, placed, strict=True))
    alike = all(sum(a * b for a, b in zip(first, up, strict=True)) >= STANDS for up in others)
    return first if alike and first[2] < STANDS else None


def lying_note(path: str, up: Sequence[float] | None, placed: Sequence[Sequence[float]]) -> str | None:
    """What is to be said of a source that is placed in a scene with +z up, as `placed_up` takes it, and does
    not stand upright in it; None where it does."""
    if up is None or placed_up(up, placed)[2] >= STANDS:
        return None
    turn = ",".join(f"{angle:.6g}" for angle in turn_upright(up))
    axis = AXES.get(tuple(up), ",".join(f"{part:.3g}" for part in up))
    return f"{path}: {axis} is up in it, and +z in the scene; -r {turn} makes it stand upright"


def turn_upright(up: Sequence[float]) -> Vector:
    """Degrees about the x, then the y, then the z axis that turn a direction to +z.

    >>> turn_upright((0, -1, 0))
    (-90.0, 0.0, 0.0)
    """
    x, y, z = up
    about_x, about_y = math.atan2(y, z), math.atan2(-x, math.hypot(y, z))
    return math.degrees(about_x) + 0.0, math.degrees(about_y) + 0.0, 0.0  # + 0.0: no "-0"
