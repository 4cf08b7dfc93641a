"""An object's placement: from the options of the command line to the keywords of a scene's node."""

import math

from fusedrf_cli.errors import UsageProblem

Vector = tuple[float, float, float]


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
