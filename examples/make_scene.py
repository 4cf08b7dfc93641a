"""Make the example scene from nothing: python examples/make_scene.py OUT_FOLDER

Writes ground.glb, tower.glb, arch.glb and ball.glb: upright (along +y, which is up in glTF, and +z after
`fusedrf train`), centred on the vertical axis, foot at height 0, about one unit tall (the ground is a disc
four units wide). Colours are baked into the vertices, light included, and no object is its own mirror
image, so that a flipped axis shows. The same bytes come out every time.
"""

import itertools
import sys
from pathlib import Path

import numpy as np
import trimesh

SUN = np.array([0.48, -0.36, 0.8])
STONE = np.array([0.70, 0.66, 0.58])
GOLD, WOOD = np.array([[0.93, 0.74, 0.25], [0.38, 0.22, 0.13]])
RED, WHITE = np.array([[0.80, 0.16, 0.14], [0.95, 0.95, 0.95]])


def lit(mesh: trimesh.Trimesh, colours: np.ndarray) -> trimesh.Trimesh:
    """The mesh with (n, 3) sRGB `colours` at its vertices, darker away from the sun; glTF has them linear."""
    shade = 0.78 + 0.22 * (mesh.vertex_normals @ SUN)
    srgb = np.clip(colours * shade[:, None], 0, 1)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=np.rint(255 * linear).astype(np.uint8))
    return mesh


def lathe(radii, heights, step: float, segments: int, paint) -> trimesh.Trimesh:
    """The polyline of (radius, height) in small steps, turned about z; `paint(angle, radius, z)` colours it.

    Every edge has its own vertices, so that colours and light change sharply at a corner.
    """
    parts = []
    for (r0, z0), (r1, z1) in itertools.pairwise(zip(radii, heights, strict=True)):
        t = np.linspace(0, 1, 1 + max(1, round(np.hypot(r1 - r0, z1 - z0) / step)))[:, None]
        angle = 2 * np.pi * np.arange(segments + 1) / segments
        radius, z, angle = np.broadcast_arrays(r0 + (r1 - r0) * t, z0 + (z1 - z0) * t, angle)
        points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1).reshape(-1, 3)
        i = np.arange(len(points)).reshape(z.shape)
        a, b, c, d = (x.ravel() for x in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        colours = paint(angle.ravel(), radius.ravel(), z.ravel())
        parts.append(lit(trimesh.Trimesh(points, faces, process=False), colours))
    return trimesh.util.concatenate(parts)


def where(*cases) -> np.ndarray:
    """(n, 3) colours from (mask, colour) pairs: the first true mask counts, else the last colour."""
    *pairs, rest = cases
    chosen = np.broadcast_to(rest, (len(pairs[0][0]), 3))
    for mask, colour in reversed(pairs):
        chosen = np.where(mask[:, None], colour, chosen)
    return chosen


# --- ground -------------------------------------------------------------------------------------------------


def paint_ground(angle: np.ndarray, radius: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Flagstones around a five-armed whirl of tiles, with a blue brook across one side."""
    random = np.random.default_rng(7)
    stones = random.uniform(-2.1, 2.1, (130, 2))
    hues = STONE * random.uniform(0.75, 1.15, (130, 1)) + random.uniform(-0.06, 0.06, (130, 3))
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    distance = np.hypot(x[:, None] - stones[:, 0], y[:, None] - stones[:, 1])
    nearest = np.argsort(distance, 1)[:, :2]
    gap = np.diff(np.take_along_axis(distance, nearest, 1), axis=1)[:, 0]
    brook = np.abs(y - 1.25 - 0.18 * np.sin(2.5 * x))
    return where(
        (brook < 0.13, [0.20, 0.50, 0.74]),
        (brook < 0.20, [0.86, 0.79, 0.58]),
        (radius < 0.16, GOLD),
        ((radius < 0.80) & (np.sin(5 * angle + 5 * radius) > 0), [0.16, 0.42, 0.45]),
        (radius < 0.80, [0.90, 0.84, 0.70]),
        (radius < 0.86, RED),
        (radius > 1.93, [0.45, 0.40, 0.36]),
        (gap < 0.035, [0.34, 0.44, 0.26]),
        hues[nearest[:, 0]],
    )


def ground() -> trimesh.Trimesh:
    return lathe([0, 2, 2, 0], [0, 0, 0.06, 0.06], 0.02, 420, paint_ground)


# --- tower --------------------------------------------------------------------------------------------------


def paint_tower(angle: np.ndarray, radius: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A lighthouse in barber's stripes; its door looks along -y, windows climb around it."""
    from_door = np.abs((angle + np.pi / 2 + np.pi) % (2 * np.pi) - np.pi) * radius
    step = np.floor((z - 0.30) / 0.13)
    from_window = np.abs((angle - 1.9 * step) % (2 * np.pi) - np.pi) * radius
    in_window = (z > 0.30) & (z < 0.66) & (np.abs((z - 0.30) % 0.13 - 0.065) < 0.03) & (from_window < 0.022)
    stripe = np.sin(2 * angle - 22 * z) > 0
    return where(
        (z > 0.86, RED),
        ((z > 0.755) & (radius < 0.115) & (np.sin(8 * angle) > 0.85), WOOD),
        ((z > 0.755) & (radius < 0.115), [1.0, 0.88, 0.40]),
        (z > 0.70, [0.22, 0.24, 0.28]),
        (z < 0.081, STONE * (0.9 + 0.1 * np.sign(np.sin(9 * angle)))[:, None]),
        ((z < 0.22) & (from_door < 0.045), WOOD),
        ((z < 0.24) & (from_door < 0.06), GOLD),
        (in_window, [0.15, 0.30, 0.50]),
        (stripe, RED),
        WHITE,
    )


def tower() -> trimesh.Trimesh:
    radii = [0, 0.27, 0.27, 0.20, 0.125, 0.18, 0.18, 0.10, 0.10, 0.135, 0.02, 0.012, 0]
    heights = [0, 0, 0.08, 0.08, 0.71, 0.72, 0.755, 0.755, 0.86, 0.865, 0.97, 1.0, 1.0]
    return lathe(radii, heights, 0.008, 160, paint_tower)


# --- arch ---------------------------------------------------------------------------------------------------


def block(low, high, colour, bend=lambda points: points) -> trimesh.Trimesh:
    """A bevelled-looking box: its faces are darker towards their rims; `bend` moves its points."""
    box = trimesh.creation.box(bounds=[low, high]).subdivide().subdivide().subdivide()
    rim = np.sort(np.abs((box.vertices - low) / np.subtract(high, low) - 0.5), 1)[:, 1]
    box.vertices = bend(box.vertices)
    faces = np.arange(3 * len(box.faces)).reshape(-1, 3)
    split = trimesh.Trimesh(box.vertices[box.faces].reshape(-1, 3), faces, process=False)
    return lit(split, np.asarray(colour) * np.where(rim > 0.45, 0.62, 1.0)[box.faces.ravel(), None])


def around(points: np.ndarray) -> np.ndarray:
    """(angle, y, radius) bent to a half circle in xz above the piers."""
    angle, y, radius = points.T
    return np.stack([-radius * np.cos(angle), y, 0.5 + radius * np.sin(angle)], 1)


def arch() -> trimesh.Trimesh:
    """Two piers and eleven wedges; gold keystone, a red banner in front at +x, ivy at -x."""
    random = np.random.default_rng(3)
    ivy = np.array([0.24, 0.46, 0.20])
    parts = []
    for low, high in ((-0.48, -0.24), (0.24, 0.48)):
        for row in range(5):
            tint = STONE * random.uniform(0.8, 1.15)
            colour = ivy * random.uniform(0.8, 1.3) if low < 0 and row in (0, 1, 3) else tint
            parts.append(block([low, -0.14, 0.1 * row], [high, 0.14, 0.1 * row + 0.1], colour))
    for wedge in range(11):
        colour = GOLD if wedge == 5 else STONE * random.uniform(0.8, 1.15) * [1.05, 0.97, 0.9]
        angles = np.pi * np.array([wedge, wedge + 1]) / 11
        parts.append(
            block([angles[0], -0.14, 0.26], [angles[1], 0.14, 0.48 + 0.02 * (wedge == 5)], colour, around)
        )
    parts.append(block([0.29, -0.17, 0.14], [0.43, -0.14, 0.46], RED))
    parts.append(block([0.33, -0.18, 0.24], [0.39, -0.17, 0.40], WHITE))
    return trimesh.util.concatenate(parts)


# --- ball ---------------------------------------------------------------------------------------------------


def paint_ball(angle: np.ndarray, radius: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Six spiral bands in rainbow order, white poles and an eye near -y; the stand is wood and gold."""
    warm = [[0.86, 0.22, 0.20], [0.95, 0.58, 0.15], [0.95, 0.85, 0.25]]
    bands = np.array([*warm, [0.25, 0.62, 0.32], [0.16, 0.45, 0.76], [0.50, 0.28, 0.62]])
    height = (z - 0.64) / 0.36
    band = np.floor(6 * ((angle / (2 * np.pi) + 0.35 * height) % 1)).astype(int) % 6
    dot = np.hypot(radius * np.cos(angle) - 0.08, z - 0.72) + (np.sin(angle) > 0)
    return where(
        (z < 0.05, WOOD),
        ((z > 0.20) & (z < 0.25), GOLD),
        (z < 0.281, WOOD * 1.25),
        (np.abs(height) > 0.93, WHITE),
        (dot < 0.07, [0.12, 0.12, 0.16]),
        (dot < 0.10, WHITE),
        bands[band],
    )


def ball() -> trimesh.Trimesh:
    stand = [0, 0.26, 0.26, 0.08, 0.08, 0.12, 0.12, 0.16], [0, 0, 0.05, 0.08, 0.20, 0.20, 0.25, 0.32]
    turn = np.linspace(-np.pi / 2, np.pi / 2, 73)
    sphere = 0.36 * np.cos(turn), 0.64 + 0.36 * np.sin(turn)
    return trimesh.util.concatenate([lathe(*part, 0.012, 180, paint_ball) for part in (stand, sphere)])


def write_gltf(mesh: trimesh.Trimesh, path: Path) -> None:
    """A mesh whose +z is up as a .glb, in which +y is."""
    turned = mesh.copy()
    turned.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    turned.export(path)


def main(arguments: list[str]) -> None:
    if arguments in (["-h"], ["--help"]):
        return print(__doc__)
    if len(arguments) != 1:
        sys.exit("usage: python examples/make_scene.py OUT_FOLDER")
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    for make in (ground, tower, arch, ball):
        write_gltf(make(), folder / f"{make.__name__}.glb")
        print(folder / f"{make.__name__}.glb")


if __name__ == "__main__":
    main(sys.argv[1:])
