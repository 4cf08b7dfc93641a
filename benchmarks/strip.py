"""A statue from one park to another room: python -m benchmarks.strip DATA [--out docs/real] [--keep FOLDER]

DATA is a folder with the captures bear/ and fox/. OUT gets strip.jpg: a photo's view of the park, the mask
painted over it, the statue alone, the park without it, and the statue under the fox. The masks are polygons
drawn by hand on five photos, good to a few pixels.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.paper.work import fusedrf, tell
from formats.bundle import read_headers
from formats.rig import Rig, read_rig

SIDE = 512
POLYGONS = {
    "frame_00001": "12,72 30,66 48,68 75,66 110,67 150,67 180,68 205,78 218,100 217,125 210,148 214,150 "
    "216,190 38,192 38,160 44,140 55,135 72,134 75,115 60,105 45,100 25,97 14,88",
    "frame_00017": "31,85 38,70 55,55 80,47 100,52 115,70 128,85 140,105 150,128 145,150 142,165 152,185 "
    "166,207 166,217 88,252 60,215 45,170 38,140 31,120",
    "frame_00033": "80,100 84,80 95,68 112,70 130,80 150,85 170,100 182,130 187,165 192,190 205,217 205,224 "
    "118,247 68,142 80,130",
    "frame_00049": "0,60 20,45 60,40 90,36 130,42 180,45 205,60 218,85 217,110 210,140 214,142 214,162 "
    "85,234 18,182 22,170 55,165 48,150 70,140 72,110 40,102 0,102",
    "frame_00065": "0,5 80,2 120,18 150,18 200,28 225,40 245,38 247,52 235,65 232,84 200,85 150,82 148,130 "
    "165,128 187,140 187,190 100,174 0,147",
}
"""By photo, the statue and its base, in pixels of 256 x 256."""
SHOWN = "frame_00001"
SIZE, BELOW, BEFORE = 0.25, 0.3, 0.3
"""Of the statue under the fox, how far under it and before it, in distances of the cameras from it."""


def masks(folder: Path) -> None:
    """The polygons as pictures."""
    folder.mkdir(exist_ok=True)
    for name, words in POLYGONS.items():
        corners = [tuple(2 * float(x) for x in word.split(",")) for word in words.split()]
        picture = Image.new("L", (SIDE, SIDE))
        ImageDraw.Draw(picture).polygon(corners, fill=255)
        picture.convert("RGB").save(folder / f"{name}.png")


def rig_of(path: Path) -> Rig:
    """The cameras that a bundle keeps."""
    return read_rig(read_headers(path)[0].cameras)


def under(statue: np.ndarray, own: Rig, other: Rig) -> np.ndarray:
    """(4, 4) that puts a box (6,) of one capture's world, upright, under what another's cameras look at."""

    def axes(rig: Rig) -> np.ndarray:
        ahead = rig.focus - rig.typical.camera_to_world[:3, 3]
        right = np.cross(ahead, rig.up)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(rig.up, right), rig.up], 1)

    scale = SIZE * other.distance / (statue[3:] - statue[:3]).max()
    matrix = np.eye(4)
    matrix[:3, :3] = scale * axes(other) @ axes(own).T
    at = other.focus - other.distance * (BELOW * other.up + BEFORE * axes(other)[:, 1])
    matrix[:3, 3] = at - matrix[:3, :3] @ ((statue[:3] + statue[3:]) / 2)
    return matrix


def main() -> None:
    """Train what is not there, cut out, place, and draw."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.strip", description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "real")
    parser.add_argument("--keep", type=Path, help="a folder in which trained captures are kept")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = (asked.keep or Path(name)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        for capture in ("bear", "fox"):
            if not (folder / f"{capture}.rfpack").exists():
                words = ("-o", f"{capture}.rfpack", "--time-budget", "120")
                fusedrf(folder, "train", str(asked.data.resolve() / capture), *words)
        masks(folder / "masks")
        words = ("extract", "bear.rfpack", "--masks", "masks")
        said = fusedrf(folder, *words, "-o", "statue.rfpack")
        fusedrf(folder, *words, "--invert", "--fill", "-o", "without.rfpack", "--preview", "look")
        tell(str({key: said[key] for key in ("sure", "seen", "bytes", "total_seconds")}))
        other = rig_of(folder / "fox.rfpack")
        matrix = under(np.array(said["box"]), rig_of(folder / "bear.rfpack"), other)
        text = ",".join(f"{x:.9g}" for x in matrix.ravel())
        fusedrf(folder, "compose", "fox.rfpack", "statue.rfpack", f"--matrix={text}", "-o", "room.json")
        fusedrf(folder, "fuse", "room.json", "-o", "room.rfpack")
        fusedrf(folder, "render", "room.rfpack", "-o", "room.png")
        shots = [folder / "look" / f"{SHOWN}_{what}.png" for what in ("marked", "object", "rest")]
        strip([*shots, folder / "room.png"], asked.out / "strip.jpg")


def strip(shots: list[Path], path: Path) -> None:
    """Pictures side by side, equally high, over white."""
    high, rows = 360, []
    for shot in shots:
        picture = Image.open(shot).convert("RGBA")
        picture = Image.alpha_composite(Image.new("RGBA", picture.size, "white"), picture).convert("RGB")
        rows.append(np.array(picture.resize((round(picture.width * high / picture.height), high))))
    Image.fromarray(np.concatenate(rows, 1)).save(path, quality=88)


if __name__ == "__main__":
    main()
