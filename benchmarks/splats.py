"""Splats as fields, alone and among others: python -m benchmarks.splats DATA [NAME ..]
    [--mitsuba PYTHON] [--keep FOLDER] [--mix | --alone]

DATA is a folder with splats/, and for the mix bear/ and foreign/. Prints Markdown tables:
    each file of splats/, or NAME, imported as `fusedrf import` does it and drawn in 400 x 400 pixels: seconds
    to import, to open the bundle, and of a frame; the PSNR to Mitsuba's picture of the file (16 samples a
    pixel, black), where the Python that --mitsuba names has it; and in 200 x 200 pixels, over white, to a
    sorted splatter without its low-pass (tests/engine/splats), of the whole frame and of the pixels that it
    covers. One more row takes the first 100,000 splats of a .splat that has as many;
    a captured park, learnt for a minute, with a TensoRF, a Plenoxels, an Instant-NGP field and a plant of
    splats placed on it: the PSNR of the composite to the naive composition, of all and of each alone with the
    park, and what fusing it shows of it in 25 MB more than the park takes.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.commit import commit_line
from benchmarks.foreign import source_of
from benchmarks.paper.table import markdown
from benchmarks.paper.work import fusedrf, tell
from formats.splats.reading import read_splats
from formats.splats.splats import Splats
from fusedrf_cli.bridge.capture_cameras import camera_set_of
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.rendering import reference, renderable
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.kinds.splats.field import ARRAYS
from fusedrf_cli.engine.rendering.cameras import Camera, framing_camera
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image
from tests.engine.splats import sorted_splatter

FRAME, SORTED, MIXED = 400, 200, 300  # pixels a side
TURNS = 5  # frames of which the median is taken
MANY, DOT_SPLAT = 100_000, 32  # splats, and bytes of one in a .splat
COVERED = 0.01  # alpha from which a pixel is
NEAR = 1e-3  # before which the sorted splatter draws nothing
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
SAMPLER = Path(__file__).with_name("mitsuba_splats.py")
PLACED = {
    "torus": ("foreign/tensorf-vm-mlpfea-mask", "-s 0.3 -r 0,20,0 -t 2.38,0.77,-0.85"),
    "plenoxels": ("foreign/svox2-sh9", "-s 0.3 -r 30,0,50 -t 2.62,-0.46,-0.5"),
    "ngp": ("foreign/ngp-aabb1", "-s 0.2 -t 1.89,-0.79,-1.42"),
    "plant": ("splats/plant.splat", "-s 0.8 -r -90,0,20 -t 2.0,0.2,-0.9"),
}
"""Where each is in DATA, and how it is placed in the bear's world."""
TRAINED, BEYOND = 60, 25_000_000  # seconds, bytes


# -- a file alone --------------------------------------------------------------------------------------------


def mitsubas(python: str) -> bool:
    """Whether a Python has Mitsuba; says how to give one that has where it has not."""
    if subprocess.run([python, "-c", "import mitsuba"], capture_output=True).returncode == 0:
        return True
    tell(f"{python} has no mitsuba, so nothing is compared with it; name a Python that has by --mitsuba")
    return False


def by_mitsuba(python: str, splats: Splats, camera: Camera, folder: Path) -> np.ndarray:
    """(H, W, 3) premultiplied, by Mitsuba."""
    given, shown = folder / "given.npz", folder / "shown.npz"
    arrays = {name: getattr(splats, name) for name in ARRAYS}
    pose, focal, size = camera.camera_to_world, camera.fl_x, camera.width
    np.savez(given, camera_to_world=pose, focal=focal, size=size, **arrays)
    subprocess.run([python, str(SAMPLER), str(given), str(shown)], check=True)
    return np.load(shown)["picture"]


def to_sorted(splats: Splats, field, origin: np.ndarray, box: np.ndarray) -> tuple[float, float]:
    """The PSNR to a sorted splatter over white: of the whole frame, and of covered pixels."""
    camera = framing_camera(box, 0.6, 0.3, SORTED, SORTED)
    lens = sorted_splatter.Camera(camera.camera_to_world, camera.fl_x, SORTED, SORTED)
    shown, alpha = sorted_splatter.rendered(splats, lens, low_pass=0.0, near=NEAR)
    truth = np.clip(shown + (1 - alpha)[..., None], 0, 1)
    ours = render_image(field, camera, origin=origin).over(WHITE)
    return psnr(ours, truth), psnr(ours[alpha > COVERED], truth[alpha > COVERED])


def alone(path: Path, folder: Path, python: str | None) -> dict:
    """The row of a file."""
    tell(path.name)
    bundle, began = folder / "field.rfpack", time.perf_counter()
    fusedrf(folder, "import", str(path), "-o", str(bundle))
    imported = time.perf_counter()
    field, origin = renderable(load_scene(str(bundle)))
    box, opened = field.occupancy.look_at_box, time.perf_counter()
    camera, took = framing_camera(box, 0.6, 0.3, FRAME, FRAME), []
    for _ in range(1 + TURNS):  # the first loads kernels
        started = time.perf_counter()
        shown = render_image(field, camera, origin=origin)
        took.append(time.perf_counter() - started)
    splats = read_splats(path)
    row = {"file": path.name, "splats": f"{len(splats):,}", "import, s": f"{imported - began:.1f}"}
    row |= {"open, s": f"{opened - imported:.2f}", "frame, s": f"{np.median(took[1:]):.2f}"}
    mitsuba = ""
    if python is not None:
        mitsuba = f"{psnr(shown.over(BLACK), np.clip(by_mitsuba(python, splats, camera, folder), 0, 1)):.1f}"
    whole, covered = to_sorted(splats, field, origin, box)
    return row | {"to Mitsuba, dB": mitsuba, "sorted, dB": f"{whole:.1f}", "covered, dB": f"{covered:.1f}"}


def files_of(folder: Path, names: list[str], kept: Path) -> list[Path]:
    """The files that are measured, and the one that is cut to MANY splats."""
    files = [f for f in sorted(folder.iterdir()) if f.suffix != ".md" and (not names or f.name in names)]
    large = [f for f in files if f.suffix == ".splat" and f.stat().st_size >= MANY * DOT_SPLAT]
    for file in large[:1]:
        cut = kept / f"{MANY}-of-{file.name}"
        cut.write_bytes(file.read_bytes()[: MANY * DOT_SPLAT])
        files.append(cut)
    return files


# -- among others --------------------------------------------------------------------------------------------


def compose(data: Path, folder: Path) -> None:
    """Learn the park and import the others where they are not there yet, and write the scenes."""
    if not (folder / "bear.rfpack").exists():
        tell("training bear")
        fusedrf(folder, "train", str(data / "bear"), "-o", "bear.rfpack", "--time-budget", str(TRAINED))
    words = {}
    for name, (where, placement) in PLACED.items():
        path = data / where
        file = source_of(path) if path.is_dir() else path
        fusedrf(folder, "import", str(file), "-o", f"{name}.rfpack", "--name", name)
        words[name] = [f"{name}.rfpack", *placement.split()]
    park = ["compose", "bear.rfpack", "--background-node"]
    for name, own in words.items():
        fusedrf(folder, *park, *own, "-o", f"{name}.json")
    fusedrf(folder, *park, *(word for own in words.values() for word in own), "-o", "mix.json")


def likeness(scene: Path) -> tuple[float, float]:
    """The PSNR of the composite to the naive composition, and the seconds of a frame of it."""
    loaded = load_scene(str(scene))
    camera = camera_of(camera_set_of(loaded).typical.reframed(MIXED, MIXED))
    shots = []
    for field, origin in (renderable(loaded), renderable(loaded), reference(loaded)):
        began = time.perf_counter()
        shots.append((render_image(field, camera, origin=origin).over(WHITE), time.perf_counter() - began))
    return psnr(shots[1][0], shots[2][0]), shots[1][1]


def mix(data: Path, folder: Path) -> list[dict]:
    """The rows of the park."""
    compose(data, folder)
    rows = []
    for scene in (*PLACED, "mix"):
        tell(f"{scene}: composite and naive")
        found, seconds = likeness(folder / f"{scene}.json")
        rows.append({"on the park": scene, "to naive, dB": f"{found:.1f}", "frame, s": f"{seconds:.2f}"})
    tell("fusing")
    most = (folder / "bear.rfpack").stat().st_size + BEYOND
    said = fusedrf(folder, "fuse", "mix.json", "-o", "mix.rfpack", "--max-size", str(most))
    shown = fusedrf(folder, "eval", "mix.rfpack", "--against", "mix.json")["mean"]["psnr"]
    row = {"on the park": f"mix, fused in {said['bytes'] / 1e6:.1f} MB of {most / 1e6:.1f}"}
    return [*rows, row | {"to naive, dB": f"{shown:.1f}", "frame, s": ""}]


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.splats", description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("names", nargs="*", help="of files of splats/; default: all")
    parser.add_argument("--mitsuba", default=sys.executable, help="a Python that has Mitsuba")
    parser.add_argument("--keep", type=Path, help="a folder in which the park is kept")
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--mix", action="store_true", help="the mix only")
    only.add_argument("--alone", action="store_true", help="files alone only")
    asked = parser.parse_args()
    data = asked.data.resolve()
    with tempfile.TemporaryDirectory() as name:
        folder = (asked.keep or Path(name)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        print(f"{commit_line()} {len(os.sched_getaffinity(0))} CPU cores.\n", flush=True)
        if not asked.mix:
            python = asked.mitsuba if mitsubas(asked.mitsuba) else None
            files = files_of(data / "splats", asked.names, folder)
            print(markdown([alone(file, folder, python) for file in files]), flush=True)
        if not asked.alone:
            print(markdown(mix(data, folder)), flush=True)


if __name__ == "__main__":
    main()
