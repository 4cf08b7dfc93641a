"""Frames of scenes of many objects and kinds: python -m benchmarks.filled DATA [--keep FOLDER] [--naive 200]

DATA is a folder with bear/, chair/ and fuze/fuze.obj. Sources are learnt for half a minute each, the bear,
which is the background, for a minute. Prints Markdown tables of frames that take turns:
    four objects that fill 800 x 800, all `vm` and of four kinds;
    400 x 400 in which small copies of a chair and a bottle stand on the bear's rock, seen from one of its
    photos' cameras and from close by; N counts the background;
    300 x 300 in which 1,000 copies of ten fields stand there.
*Over* is the median over the first frame of the table, each turn's own; *ready* is what there is to do before
a loaded scene is drawn. With --naive, *to naive* is the PSNR in dB to the naive composition in frames of that
size by the pictures' own steps, and *at a quarter* by a quarter of them both.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.must_show import PLACES
from benchmarks.paper.table import markdown
from benchmarks.paper.work import fusedrf, tell
from benchmarks.placed import SOURCES, STANDS, UPRIGHT
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.rigs import rig_of
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
        made = Path(__file__).parents[1] / "examples" / "make_scene.py"
        subprocess.run([sys.executable, str(made), str(folder)], check=True, stdout=subprocess.DEVNULL)
        fusedrf(folder, "train", "ground.glb", "-o", "ground.rfpack", "--time-budget", "30")
    for node, kind in KINDS.items():
        source = "fuze" if node == "bottle" else "chair"
        if not (folder / f"{source}-{kind}.rfpack").exists():
            tell(f"{source} as {kind}")
            words = ("-o", f"{source}-{kind}.rfpack", "--kind", kind, "--time-budget", "30")
            fusedrf(folder, "convert", f"{source}.rfpack", *words)


def placed(folder: Path, nodes: list[dict]) -> list[Placed]:
    """The nodes' fields in memory, equal ones once."""
    content = {"format": "rfpack", "version": "1.0", "composition": "max", "nodes": nodes}
    (folder / "filled.json").write_text(json.dumps(content))
    return [replace(p, field=opened(p.field)) for p in load_scene(str(folder / "filled.json")).placed]


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
    scene = placed(folder, alike)
    boxes = np.stack([p.aabb for p in scene])
    box = np.concatenate([boxes[:, :3].min(0), boxes[:, 3:].max(0)])
    camera = framing_camera(box, 0.9, 0.6, FILLED, FILLED)
    camera = replace(camera, fl_x=ZOOM * camera.fl_x, fl_y=ZOOM * camera.fl_y)
    return [Frame("four, vm", scene, camera), Frame("four kinds", placed(folder, mixed), camera)]


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
    view = rig_of(load_scene(str(folder / "bear.rfpack"))).typical
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
    scenes, took = [frame.ready() for frame in frames], [[] for _ in frames]
    for _ in range(1 + repeats):
        for frame, (scene, _), times in zip(frames, scenes, took, strict=True):
            started = time.perf_counter()
            render_image(scene, frame.camera, origin=scene.origin)
            times.append(time.perf_counter() - started)
    found = []
    for frame, (_, ready), times in zip(frames, scenes, took, strict=True):
        over = statistics.median(a / b for a, b in zip(times[1:], took[0][1:], strict=True))
        row = {"frame": frame.what, "ready, s": f"{ready:.3f}", "s": f"{statistics.median(times[1:]):.3f}"}
        found.append(row | {"over": f"{over:.3f}"} | (frame.likeness(naive) if naive else {}))
    return found


def main() -> None:
    """Train what is not there, measure, and print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.filled", description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--keep", type=Path, help="a folder in which trained sources are kept")
    parser.add_argument("--frames", type=int, default=5, help="that a median is taken of")
    parser.add_argument("--naive", type=int, default=0, help="pixels a side of frames of both compositions")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = (asked.keep or Path(name)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        train(folder, asked.data.resolve())
        for frames in [filled_frames(folder), *crowded_frames(folder)]:
            print(markdown(rows(frames, asked.frames, asked.naive)), flush=True)


if __name__ == "__main__":
    main()
