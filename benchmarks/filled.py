"""Frames full of trained detail: python -m benchmarks.filled DATA [--keep FOLDER] [--frames 5]

DATA is a folder with bear/, chair/ and fuze/fuze.obj. Sources are learnt for half a minute each, the bear,
which is the background, for a minute. Prints Markdown tables: of an 800 x 800 frame that four objects fill,
and of frames of 400 x 400 in which small copies of a chair and a bottle stand on the bear's rock, seen from
one of its photos' cameras and from close by. N counts the background too, and frames of all N take turns.
*Without* is without the insides of cells (engine/fields/insides.py) and by all blocks together instead of by
those that a ray meets (engine/kinds/vm/routes.py), *telling* what it takes to know insides; samples and
shares of the time are of all blocks together; *to denser* is the PSNR in dB to samples four times as dense. A
hit ray is one that takes a sample.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from benchmarks import counting
from benchmarks.must_show import PLACES
from benchmarks.paper.table import markdown
from benchmarks.paper.work import fusedrf, tell
from benchmarks.placed import SOURCES, STANDS, UPRIGHT
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.rigs import rig_of
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.fields.computed import ComputedField
from fusedrf_cli.engine.fields.insides import WORTH_TELLING
from fusedrf_cli.engine.kernels.loops import RAYS_PER_TASK, Rays
from fusedrf_cli.engine.kinds.vm.blocks import blocks_of
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.rendering.cameras import Camera, framing_camera, tile_order
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import EARLY_STOP, reach_of, render_image, seen_from

WHITE = (1.0, 1.0, 1.0)
FILLED, SMALL = 800, 400  # pixels a side
ZOOM = 1.9  # of the picture that frames all four objects: the ground reaches over its borders
NUMBERS = (1, 2, 4, 8, 16, 32)
SHRUNK = 0.3  # of the objects' sizes in benchmarks/placed.py
SPREAD = 1.1  # radius of the disc of small objects, in the bear's world
TURN = np.pi * (3 - 5**0.5)  # from one to the next: as a sunflower's seeds
CLOSE = 0.4  # of the camera's way to the objects
DENSER = 4
KEPT_FRAMES = 5


@dataclass(frozen=True)
class Frame:
    """A view of a field."""

    what: str
    field: VMField
    origin: np.ndarray
    camera: Camera

    @cached_property
    def known(self) -> VMField:
        """As `render` makes pictures of it: under a grid that knows the insides of cells."""
        return self.field.for_pictures(WORTH_TELLING)

    @property
    def telling(self) -> float:
        """Seconds that it takes to know them."""
        return seconds([partial(self.field.for_pictures, WORTH_TELLING)], 1)[0]

    def picture(self, known: bool = True, denser: int = 1) -> np.ndarray:
        """(H, W, 3) over white, whose cells are known inside or not, by samples so many times as dense."""
        field, step = self.known if known else self.field, sampling_step(self.field) / denser
        if denser > 1 and field.occupancy.stride is not None:
            field = copy(field)._afresh("arrays", "grid")
            field.occupancy = replace(field.occupancy, unit=step)
        return render_image(field, self.camera, origin=self.origin, step=step).over(WHITE)


def train(folder: Path, data: Path) -> None:
    """The sources that are not there yet."""
    for name in ("bear", "chair", "fuze"):
        if not (folder / f"{name}.rfpack").exists():
            where, seconds, *more = SOURCES[name]
            tell(f"training {name}")
            words = ("-o", f"{name}.rfpack", "--time-budget", str(seconds), *more)
            fusedrf(folder, "train", str(data / where), *words)
    if not (folder / "ground.rfpack").exists():
        tell("training ground")
        made = Path(__file__).parents[1] / "examples" / "make_scene.py"
        subprocess.run([sys.executable, str(made), str(folder)], check=True, stdout=subprocess.DEVNULL)
        fusedrf(folder, "train", "ground.glb", "-o", "ground.rfpack", "--time-budget", "30")


def fused(folder: Path, nodes: list[dict]) -> tuple[VMField, np.ndarray]:
    """Placed sources as blocks, as `render` and `fuse` make them, and where their frame lies."""
    content = {"format": "rfpack", "version": "1.0", "composition": "max", "nodes": nodes}
    (folder / "filled.json").write_text(json.dumps(content))
    composed = load_scene(str(folder / "filled.json")).composed()
    return blocks_of(composed.placed), composed.origin


def filled_frame(folder: Path) -> Frame:
    """Four objects that fill the frame."""
    sources = {"bottle.rfpack": "fuze.rfpack"}
    nodes = [node | {"source": sources.get(node["source"], node["source"])} for node in PLACES]
    field, origin = fused(folder, nodes)
    box = field.occupancy.tight_aabb(0) + np.tile(origin, 2)
    camera = framing_camera(box, 0.9, 0.6, FILLED, FILLED)
    near = replace(camera, fl_x=ZOOM * camera.fl_x, fl_y=ZOOM * camera.fl_y)
    return Frame("four objects", field, origin, near)


def crowd(count: int) -> list[dict]:
    """The bear and count - 1 small objects on a disc around those of benchmarks/placed.py."""
    middle = np.mean([at for _, at in STANDS.values()], axis=0)
    nodes = [{"name": "bear", "source": "bear.rfpack", "background": True}]
    for i in range(count - 1):
        name = ("chair", "fuze")[i % 2]
        angle, far = TURN * i, SPREAD * ((i + 0.5) / NUMBERS[-1]) ** 0.5
        matrix = np.eye(4)
        matrix[:3, :3] = SHRUNK * STANDS[name][0] * UPRIGHT
        matrix[:3, 3] = middle + far * UPRIGHT[:, :2] @ [np.cos(angle), np.sin(angle)]
        nodes.append({"name": f"{name}-{i}", "source": f"{name}.rfpack", "matrix": matrix.tolist()})
    return nodes


def crowded_frames(folder: Path) -> dict[str, list[Frame]]:
    """Far and close, a frame for each number of objects."""
    view = rig_of(load_scene(str(folder / "bear.rfpack"))).typical
    far = camera_of(view.reframed(SMALL, SMALL))
    pose = far.camera_to_world.copy()
    pose[:3, 3] += CLOSE * (np.mean([at for _, at in STANDS.values()], axis=0) - pose[:3, 3])
    cameras = {"far": far, "close": replace(far, camera_to_world=pose)}
    fields = {count: fused(folder, crowd(count)) for count in NUMBERS}
    return {
        where: [Frame(f"{where}, N = {n}", *fields[n], camera) for n in NUMBERS]
        for where, camera in cameras.items()
    }


# -- measuring -----------------------------------------------------------------------------------------------


def seconds(work: list, repeats: int) -> list[float]:
    """The median time of each piece of work, taking turns, after a turn that loads kernels."""
    took: list[list[float]] = [[] for _ in work]
    for _ in range(1 + repeats):
        for run, times in zip(work, took, strict=True):
            started = time.perf_counter()
            run()
            times.append(time.perf_counter() - started)
    return [statistics.median(times[1:]) for times in took]


def parts(frame: Frame, repeats: int) -> dict[str, float]:
    """Samples per hit ray, and the shares of a frame's time by leaving parts out."""
    camera, field = frame.camera, copy(frame.known)
    rays_o, rays_d = camera.rays(order=tile_order(camera.width, camera.height))
    rays_o, rays_d, _ = seen_from(frame.origin, rays_o, rays_d)
    reach = reach_of(len(rays_o), 0.0, np.inf)
    rays = Rays(*map(np.ascontiguousarray, (rays_o, rays_d)), reach, sampling_step(field), EARLY_STOP)
    field.bodies = counting
    field._afresh("loops")
    counts = counting.Counts(*np.zeros((3, len(rays_o)), np.int64))
    field.loops.each("count_ray", field.arrays, field.grid, rays, len(rays_o), counts, RAYS_PER_TASK)
    out = np.zeros((len(rays_o), 5), np.float32)

    def run(item: str, asked, to) -> None:
        field.loops.each(item, field.arrays, field.grid, asked, len(rays_o), to, RAYS_PER_TASK)

    walk, weigh, whole = seconds(
        [
            lambda: run("walk_ray", counting.Walked(*rays, counts.samples, False), out[:, 0]),
            lambda: run("walk_ray", counting.Walked(*rays, counts.samples, True), out[:, 0]),
            lambda: ComputedField.show(field, rays, out),
        ],
        repeats,
    )
    hit = counts.samples > 0
    return {
        "hit": f"{hit.mean():.0%}",
        "samples": f"{counts.samples[hit].mean():.1f}",
        "of them dense": f"{counts.dense[hit].mean():.1f}",
        "colours": f"{counts.colours[hit].mean():.1f}",
        "marching": f"{walk / whole:.0%}",
        "density": f"{(weigh - walk) / whole:.0%}",
        "colour": f"{(whole - weigh) / whole:.0%}",
    }


def rows(frames: list[Frame], repeats: int) -> list[dict]:
    """A table's rows of frames that take turns, with the insides of cells known and without."""
    ways = (True, False)
    took = seconds([partial(frame.picture, way) for frame in frames for way in ways], repeats)
    found = []
    for frame, own, plain in zip(frames, took[::2], took[1::2], strict=True):
        fine, told, bare = frame.picture(False, DENSER), *(frame.picture(way) for way in ways)
        found.append(
            {"frame": frame.what, "s": f"{own:.2f}", "over N = 1": f"{own / took[0]:.2f}"}
            | {"without, s": f"{plain:.2f}", "telling, s": f"{frame.telling:.2f}"}
            | parts(frame, repeats)
            | {"dB to without": f"{psnr(told, bare):.1f}", "to denser": f"{psnr(told, fine):.1f}"}
            | {"without, to denser": f"{psnr(bare, fine):.1f}"}
        )
    return found


def main() -> None:
    """Train what is not there, measure, and print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.filled", description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--keep", type=Path, help="a folder in which trained sources are kept")
    parser.add_argument("--frames", type=int, default=KEPT_FRAMES, help="that a median is taken of")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = (asked.keep or Path(name)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        train(folder, asked.data.resolve())
        print(markdown(rows([filled_frame(folder)], asked.frames)), flush=True)
        for frames in crowded_frames(folder).values():
            print(markdown(rows(frames, asked.frames)), flush=True)


if __name__ == "__main__":
    main()
