"""Make things that are all different: python examples/make_things.py OUT_FOLDER COUNT

Writes thing_00.glb, thing_01.glb, ...: upright, foot at height 0, at most one unit tall and 0.8 wide. Shape
and colours follow from the number, so the same bytes come out every time, whatever COUNT is.
"""

import colorsys
import sys
from pathlib import Path

import numpy as np
import trimesh
from make_scene import block, lathe, where, write_gltf

MOST = 1000


def palette(random: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3) sRGB colours whose hues are far apart."""
    hues = (random.uniform() + 0.382 * np.arange(count)) % 1
    return np.array([colorsys.hsv_to_rgb(h, *random.uniform((0.35, 0.5), (0.85, 0.95))) for h in hues])


def pattern(random: np.random.Generator):
    """A paint of turned things: spirals, rings or checks in two colours, a band and a foot in others."""
    colours, arms, pitch = palette(random, 4), random.integers(2, 7), random.uniform(8, 30)
    style, band = random.integers(3), random.uniform(0.3, 0.8)

    def paint(angle: np.ndarray, radius: np.ndarray, z: np.ndarray) -> np.ndarray:
        around, up = np.sin(arms * angle), np.sin(pitch * z)
        mark = (np.sin(arms * angle + pitch * z), up, around * up)[style] > 0
        return where(
            (np.abs(z - band) < 0.03, colours[2]),
            (z < 0.05, colours[3]),
            (mark, colours[0]),
            colours[1],
        )

    return paint


def vase(random: np.random.Generator) -> trimesh.Trimesh:
    """A smooth profile turned about z."""
    height, t = random.uniform(0.6, 1), np.linspace(0, 1, 33)
    waves = sum(random.uniform(-0.3, 0.3) * np.sin((k + 1) * np.pi * t + k) for k in range(4))
    radii = 0.09 + 0.28 * (waves - waves.min()) / np.ptp(waves)
    return lathe([0, *radii, 0], [0, *(height * t), height], 0.012, 120, pattern(random))


def pagoda(random: np.random.Generator) -> trimesh.Trimesh:
    """Storeys with roofs that stand out."""
    radii, heights, z = [0.0], [0.0], 0.0
    storeys = random.integers(2, 6)
    for wide in np.linspace(random.uniform(0.25, 0.33), 0.08, storeys):
        rise = random.uniform(0.7, 0.95) / storeys
        radii += [wide, wide, wide + 0.06, wide]
        heights += [z, z + 0.6 * rise, z + 0.6 * rise, z + rise]
        z += rise
    return lathe([*radii, 0], [*heights, z], 0.012, 120, pattern(random))


def stack(random: np.random.Generator) -> trimesh.Trimesh:
    """Boxes upon each other, each turned by itself."""
    parts, z = [], 0.0
    for colour in palette(random, random.integers(3, 8)):
        x, back, front = random.uniform(0.1, 0.27) * np.array([1, *random.uniform(0.5, 1, 2)])
        rise, turn = random.uniform(0.1, 0.2), random.uniform(0, np.pi)
        low, high, cos, sin = [-x, -back, z], [x, front, z + rise], np.cos(turn), np.sin(turn)
        spin = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        parts.append(block(low, high, colour, lambda points, spin=spin: points @ spin))
        z += rise
        if z > 0.8:
            break
    return trimesh.util.concatenate(parts)


def thing(number: int) -> trimesh.Trimesh:
    """The mesh of that number."""
    random = np.random.default_rng([53, number])
    return (vase, pagoda, stack)[number % 3](random)


def main(arguments: list[str]) -> None:
    if arguments in (["-h"], ["--help"]):
        return print(__doc__)
    if len(arguments) != 2 or not arguments[1].isdigit() or int(arguments[1]) > MOST:
        sys.exit(f"usage: python examples/make_things.py OUT_FOLDER COUNT, COUNT at most {MOST}")
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(int(arguments[1])):
        write_gltf(thing(number), folder / f"thing_{number:02d}.glb")
    print(f"{arguments[1]} things in {folder}")


if __name__ == "__main__":
    main(sys.argv[1:])
