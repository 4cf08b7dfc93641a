"""Frames of scenes of many objects and kinds: python -m benchmarks.filled DATA [--keep FOLDER] [--naive 200]
    [--first] [--fused]

DATA is a folder with bear/, chair/ and fuze/fuze.obj. Sources are learnt for half a minute each, the bear,
which is the background, for a minute. Prints Markdown tables of frames that take turns:
    four objects that fill 800 x 800, all `vm` and of four kinds;
    400 x 400 in which small copies of a chair and a bottle stand on the bear's rock, seen from one of its
    photos' cameras and from close by; N counts the background;
    300 x 300 in which 1,000 copies of ten fields stand there.
*Over* is the median over the first frame of the table, each turn's own, by the clock and by the time of all
cores; *ready* is what there is to do before a loaded scene is drawn. With --naive, *to naive* is the PSNR in
dB to the naive composition in frames of that size by the pictures' own steps, and *at a quarter* by a quarter
of them both. With --first, the seconds of `fusedrf render` of the four kinds, with nothing compiled and after
that; with --fused, what the four of one kind and of four show of their scenes when they are fused to as many
bytes, half of those of the four kinds.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.commit import commit_line
from benchmarks.paper.sources import PLACES, make, write_scene
from benchmarks.paper.table import markdown
from benchmarks.paper.work import fusedrf, tell
from benchmarks.placed import SOURCES, STANDS, UPRIGHT
from fusedrf_cli.bridge.capture_cameras import camera_set_of
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import Composite
from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.rendering.cameras import Camera, framing_camera
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image

WHITE = (1.0, 1.0, 1.0)
FILLED, SMALL, CROWDED = 800, 400, 300  # pixels a side
ZOOM = 1.9  # of the picture that frames all four objects: the ground reaches over its borders
NUMBERS, CROWD = (1, 2, 8, 32), 1001
SHRUNK = 0.3  # of the objects' sizes in benchmarks/placed.py
SPREAD = 1.1  # radius of the disc of small objects, in the bear's world
TURN = np.pi * (3 - 5**0.5)  # from one to the next: as a sunflower's seeds
CLOSE = 0.4  # of the camera's way to the objects
KINDS = {"chair": "sparse", "small": "dense", "bottle": "cp"}  # of the four objects' nodes; the ground is vm
DISTINCT = 10


@dataclass(frozen=True)
class Frame:
    """A view of a scene."""

    what: str
    placed: list[Placed]
    camera: Camera

    def ready(self) -> tuple[Composite, float]:
        """The scene as pictures are made of it, and the seconds until the first could be."""
        started = time.perf_counter()
        scene = Composite(self.placed)
        scene.instances, scene.traces  # noqa: B018
        return scene, time.perf_counter() - started

    def likeness(self, size: int) -> dict:
        """How like the naive composition it is, by its step and by a quarter of it."""
        view = resized(self.camera, size)
        scene, naive, found = Composite(self.placed), ComposedField(self.placed), []
        grid = naive.occupancy
        for finer in (1, 4):
            naive.__dict__["occupancy"] = replace(grid, unit=grid.unit / finer)
            shots = [
                render_image(field, view, origin=scene.origin, step=sampling_step(field) / finer).over(WHITE)
                for field in (scene, naive)
            ]
            found.append(f"{psnr(*shots):.1f}")
        return {"to naive": found[0], "at a quarter": found[1]}


def resized(camera: Camera, size: int) -> Camera:
    """A square camera with so many pixels a side."""
    times = size / camera.width
    lens = {name: getattr(camera, name) * times for name in ("fl_x", "fl_y", "cx", "cy")}
    return replace(camera, width=size, height=size, **lens)


# -- scenes --------------------------------------------------------------------------------------------------


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
        make("make_scene.py", folder)
        fusedrf(folder, "train", "ground.glb", "-o", "ground.rfpack", "--time-budget", "30")
    for node, kind in KINDS.items():
        source = "fuze" if node == "bottle" else "chair"
        if not (folder / f"{source}-{kind}.rfpack").exists():
            tell(f"{source} as {kind}")
            words = ("-o", f"{source}-{kind}.rfpack", "--kind", kind, "--time-budget", "30")
            fusedrf(folder, "convert", f"{source}.rfpack", *words)


def placed(folder: Path, nodes: list[dict], name: str = "filled") -> list[Placed]:
    """The nodes' fields in memory, equal ones once; the scene is kept by its name."""
    path = write_scene(folder / f"{name}.json", nodes)
    return [replace(p, field=opened(p.field)) for p in load_scene(str(path)).placed]


def filled_frames(folder: Path) -> list[Frame]:
    """Four objects that fill the frame, as `vm` and of four kinds."""
    sources = {"chair": "chair", "small": "chair", "bottle": "fuze", "ground": "ground"}
    alike = [node | {"source": f"{sources[node['name']]}.rfpack"} for node in PLACES]
    mixed = [
        node | {"source": f"{sources[node['name']]}-{KINDS[node['name']]}.rfpack"}
        if node["name"] in KINDS
        else node
        for node in alike
    ]
    scene = placed(folder, alike, "alike")
    boxes = np.stack([p.aabb for p in scene])
    box = np.concatenate([boxes[:, :3].min(0), boxes[:, 3:].max(0)])
    camera = framing_camera(box, 0.9, 0.6, FILLED, FILLED)
    camera = replace(camera, fl_x=ZOOM * camera.fl_x, fl_y=ZOOM * camera.fl_y)
    return [Frame("four, vm", scene, camera), Frame("four kinds", placed(folder, mixed, "four"), camera)]


def crowd(folder: Path, count: int, most: int = NUMBERS[-1], size: float = SHRUNK) -> list[Placed]:
    """The bear and count - 1 small objects on a disc around those of benchmarks/placed.py."""
    middle = np.mean([at for _, at in STANDS.values()], axis=0)
    nodes = [{"name": "bear", "source": "bear.rfpack", "background": True}]
    for i in range(count - 1):
        name = ("chair", "fuze")[i % 2]
        angle, far = TURN * i, SPREAD * ((i + 0.5) / most) ** 0.5
        matrix = np.eye(4)
        matrix[:3, :3] = size * STANDS[name][0] * UPRIGHT
        matrix[:3, 3] = middle + far * UPRIGHT[:, :2] @ [np.cos(angle), np.sin(angle)]
        nodes.append({"name": f"{name}-{i}", "source": f"{name}.rfpack", "matrix": matrix.tolist()})
    return placed(folder, nodes)


def of_ten_fields(scene: list[Placed]) -> list[Placed]:
    """The same objects, of which every tenth has the same field: copies, which loops know no more of."""
    copies: dict[tuple, object] = {}
    return [
        replace(p, field=copies.setdefault((id(p.field), i % DISTINCT), p.field.with_params(p.field.params)))
        for i, p in enumerate(scene)
    ]


def crowded_frames(folder: Path) -> list[list[Frame]]:
    """Far and close, a frame for each number of objects; and that of a crowd."""
    view = camera_set_of(load_scene(str(folder / "bear.rfpack"))).typical
    far = camera_of(view.reframed(SMALL, SMALL))
    pose = far.camera_to_world.copy()
    pose[:3, 3] += CLOSE * (np.mean([at for _, at in STANDS.values()], axis=0) - pose[:3, 3])
    cameras = {"far": far, "close": replace(far, camera_to_world=pose)}
    scenes = {count: crowd(folder, count) for count in NUMBERS}
    tables = [
        [Frame(f"{where}, N = {n}", scenes[n], camera) for n in NUMBERS] for where, camera in cameras.items()
    ]
    many = of_ten_fields(crowd(folder, CROWD, CROWD, SHRUNK / 3))
    camera = resized(far, CROWDED)
    crowded = [Frame("the bear", scenes[1], camera), Frame(f"{CROWD - 1} objects", many, camera)]
    return [*tables, crowded]


# -- measuring -----------------------------------------------------------------------------------------------


def rows(frames: list[Frame], repeats: int, naive: int) -> list[dict]:
    """A table's rows of frames that take turns, after a turn that loads kernels."""
    scenes, took = [frame.ready() for frame in frames], np.empty((len(frames), 1 + repeats, 2))
    for turn in range(1 + repeats):
        for i, (frame, (scene, _)) in enumerate(zip(frames, scenes, strict=True)):
            started = time.perf_counter(), time.process_time()
            render_image(scene, frame.camera, origin=scene.origin)
            took[i, turn] = np.subtract((time.perf_counter(), time.process_time()), started)
    seconds, over = np.median(took[:, 1:], 1), np.median(took[:, 1:] / took[0, 1:], 1)
    found = []
    for i, (frame, (_, ready)) in enumerate(zip(frames, scenes, strict=True)):
        row = {"frame": frame.what, "ready, s": f"{ready:.3f}", "s": f"{seconds[i, 0]:.3f}"}
        row |= {"over": f"{over[i, 0]:.3f}", "over, all cores": f"{over[i, 1]:.3f}"}
        found.append(row | (frame.likeness(naive) if naive else {}))
    return found


def first_frames(folder: Path) -> list[dict]:
    """The seconds of a command that draws the four kinds, with an empty cache of kernels and with a full
    one."""
    words = ["render", "four.json", "-o", "four.png", "--size", f"{SMALL}x{SMALL}", "-w"]
    line, found = [sys.executable, "-m", "fusedrf_cli", *words], []
    with tempfile.TemporaryDirectory() as cache:
        for what in ("nothing compiled", "kernels kept"):
            started = time.perf_counter()
            subprocess.run(line, cwd=folder, env=os.environ | {"NUMBA_CACHE_DIR": cache}, check=True)
            found.append({"first frame": what, "s": f"{time.perf_counter() - started:.1f}"})
    return found


def fused_alike(folder: Path) -> list[dict]:
    """What the four show when they are fused to half the bytes of the four kinds."""
    names = {"ground.rfpack", "chair-sparse.rfpack", "chair-dense.rfpack", "fuze-cp.rfpack"}
    most, found = sum((folder / name).stat().st_size for name in names) // 2, []
    for scene in ("alike", "four"):
        words = ("--kind", "blocks", "--max-size", str(most))
        said = fusedrf(folder, "fuse", f"{scene}.json", "-o", f"{scene}.rfpack", *words)
        psnr = fusedrf(folder, "eval", f"{scene}.rfpack", "--against", f"{scene}.json")["mean"]["psnr"]
        seconds = f"{said['total_seconds']:.1f}"
        found.append({"fused": scene, "bytes": said["bytes"], "dB": f"{psnr:.2f}", "s": seconds})
    return found


def main() -> None:
    """Train what is not there, measure, and print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.filled", description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--keep", type=Path, help="a folder in which trained sources are kept")
    parser.add_argument("--frames", type=int, default=5, help="that a median is taken of")
    parser.add_argument("--naive", type=int, default=0, help="pixels a side of frames of both compositions")
    parser.add_argument("--first", action="store_true", help="the first frame's seconds, too")
    parser.add_argument("--fused", action="store_true", help="what fusing to half the bytes leaves, too")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = (asked.keep or Path(name)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        train(folder, asked.data.resolve())
        print(f"{commit_line()}\n")
        for frames in [filled_frames(folder), *crowded_frames(folder)]:
            print(markdown(rows(frames, asked.frames, asked.naive)), flush=True)
        for wanted, measure in ((asked.first, first_frames), (asked.fused, fused_alike)):
            if wanted:
                print(markdown(measure(folder)), flush=True)


if __name__ == "__main__":
    main()
