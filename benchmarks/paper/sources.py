"""Fields and scenes to experiment on: made from nothing, or trained on captures; kept between runs."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from benchmarks.paper.work import Work, fusedrf, tell

EXAMPLES = Path(__file__).parents[2] / "examples"
MOST_THINGS = 32
DRAFT = ("--quality", "draft", "--views", "20", "--size", "128", "--max-size", "800kB")
NORMAL = ("--quality", "draft", "--views", "60", "--size", "300")
LEAST_TRAINED = 22.0  # dB, below which a field is no object to experiment with
STAND = 0.06  # height of the ground's top
GOLDEN = np.pi * (3 - np.sqrt(5))
SPREAD, SHRUNK = 0.312, 0.55  # of the places and the things, so that 32 stand on the ground
PLACES = [
    {"name": "ground", "source": "ground.rfpack", "background": True},
    {
        "name": "chair",
        "source": "chair.rfpack",
        "translation": [-0.6, 0.3, 0.74],
        "rotation": [0, 0, 0.2588190451, 0.9659258263],
        "scale": [0.7, 0.7, 0.7],
    },
    {
        "name": "small",
        "source": "chair.rfpack",
        "translation": [0.6, -0.9, 0.40],
        "rotation": [0, 0, 0.7071067812, 0.7071067812],
        "scale": [0.35, 0.35, 0.35],
    },
    {"name": "bottle", "source": "bottle.rfpack", "translation": [0.9, 0.7, 0.06], "scale": [4, 4, 4]},
]
"""Of the chair, the bottle and the ground."""
OWN_PLACES = [
    {"name": "ground", "source": "ground.rfpack", "background": True},
    {"name": "tower", "source": "tower.rfpack", "translation": [-0.6, 0.4, STAND], "scale": [1.1] * 3},
    {
        "name": "small",
        "source": "tower.rfpack",
        "translation": [0.7, -0.9, STAND],
        "rotation": [0, 0, 0.3826834, 0.9238795],
        "scale": [0.5] * 3,
    },
    {"name": "ball", "source": "ball.rfpack", "translation": [0.9, 0.7, STAND], "scale": [0.9] * 3},
]
TINY = 0.2  # units tall, on a ground of four: the twentieth part


def write_scene(path: Path, nodes: list[dict]) -> Path:
    """A scene.json of nodes."""
    path.write_text(json.dumps({"format": "rfpack", "version": "1.0", "nodes": nodes}))
    return path


def make(script: str, folder: Path, *words: str) -> None:
    """Run a script of examples/."""
    line = [sys.executable, str(EXAMPLES / script), str(folder), *words]
    subprocess.run(line, check=True, stdout=subprocess.DEVNULL)


def train(folder: Path, name: str, *words: str) -> None:
    """A mesh to a field, unless it is there."""
    if not (folder / f"{name}.rfpack").exists():
        tell(f"training {name}")
        report = fusedrf(folder, "train", f"{name}.glb", "-o", f"{name}.rfpack", *words)
        if report["training_psnr"] < LEAST_TRAINED:
            (folder / f"{name}.rfpack").unlink()
            raise RuntimeError(f"{name}: {report['training_psnr']:.1f} dB in training; is the machine busy?")


def own_fields(work: Work) -> None:
    """ground, tower and ball."""
    if not (work.folder / "ground.glb").exists():
        make("make_scene.py", work.folder)
    for name in ("ground", "tower", "ball"):
        train(work.folder, name, *NORMAL, "--max-size", "6MB")


def four_objects(work: Work) -> Path:
    """Chair, small chair, bottle and ground where captures are given, else four of our own."""
    if work.data is None:
        own_fields(work)
        return write_scene(work.folder / "four.json", OWN_PLACES)
    folder = work.folder / "captured"
    folder.mkdir(exist_ok=True)
    if not all((folder / f"{name}.rfpack").exists() for name in ("chair", "bottle", "ground")):
        tell("training chair, bottle and ground")
        train_captured(work.data, folder)
    return write_scene(folder / "four.json", PLACES)


def train_captured(data: Path, folder: Path) -> None:
    """chair, bottle and ground, where they are not there yet."""
    captures = {"chair": (data / "chair", "--quality", "high"), "bottle": (data / "fuze" / "fuze.obj",)}
    for name, (where, *words) in captures.items():
        if not (folder / f"{name}.rfpack").exists():
            fusedrf(folder, "train", str(where), "-o", f"{name}.rfpack", *words)
    if not (folder / "ground.rfpack").exists():
        make("make_scene.py", folder)
        fusedrf(folder, "train", "ground.glb", "-o", "ground.rfpack", "--max-size", "6MB")


def places(count: int) -> np.ndarray:
    """(count, 2) even places around the middle, as a sunflower's seeds: the first do not depend on how many
    follow.
    """
    i = np.arange(count) + 0.5
    return SPREAD * np.sqrt(i)[:, None] * np.stack([np.cos(GOLDEN * i), np.sin(GOLDEN * i)], 1)


def things_on_ground(work: Work, count: int) -> Path:
    """A scene of the ground and so many things, all different: they are as large and stand at the same places
    whatever their number.
    """
    own_fields(work)
    if not (work.folder / f"thing_{MOST_THINGS - 1:02d}.glb").exists():
        make("make_things.py", work.folder, str(MOST_THINGS))
    nodes = [OWN_PLACES[0]]
    for i, (x, y) in enumerate(places(count)):
        train(work.folder, f"thing_{i:02d}", *DRAFT)
        turn = [0, 0, float(np.sin(i / 2)), float(np.cos(i / 2))]
        where = {"translation": [float(x), float(y), STAND], "rotation": turn, "scale": [SHRUNK] * 3}
        nodes.append({"name": f"thing {i}", "source": f"thing_{i:02d}.rfpack"} | where)
    return write_scene(work.folder / f"things_{count:02d}.json", nodes)


def with_a_tiny_one(work: Work) -> tuple[Path, np.ndarray]:
    """Our own scene with one more tower, TINY units tall; and its box (6,)."""
    own_fields(work)
    place = np.array([0.1, -0.3, STAND])
    node = {"name": "tiny", "source": "tower.rfpack", "translation": place.tolist(), "scale": [TINY] * 3}
    box = np.concatenate([place - [0.3 * TINY, 0.3 * TINY, 0], place + [0.3 * TINY, 0.3 * TINY, TINY]])
    return write_scene(work.folder / "tiny.json", [*OWN_PLACES, node]), box
