"""Edits of fused scenes: python -m benchmarks.edits DATA [--out docs/real] [--keep FOLDER]

DATA is a folder with chair/ and fuze/fuze.obj. OUT gets edits.md, edits.svg and edits.json that they are made
of (a kind that is there and not asked for stays): for each kind of field what many additions one by one come
to against one fuse of all, what an edit changes outside of its region, what is left after an addition was
deleted again, what the order of additions changes, and how long an edit takes.
"""

import argparse
import json
import random
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from benchmarks.paper.figures import over_time
from benchmarks.paper.table import markdown
from benchmarks.paper.work import fusedrf, tell
from fusedrf_cli.bridge.rendering import renderable
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.rendering.cameras import framing, framing_lens
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image

OBJECTS = {"blocks": 32, "sparse": 8, "vm": 8}
"""How many are added one by one; kinds that ask or learn take longer."""
SHUFFLED = 6
SIDE = 300
POINTS = 200_000
ABOUT = (
    "Written by `python -m benchmarks.edits DATA`: chairs and bottles on a lattice, turned and scaled. *One "
    "by one* is the PSNR to the composed scene of a field that all were added to, *at once* that of one "
    "fuse; *outside* is the largest change of density, in parts of the largest, at points outside of the "
    "region that one more `add` touched, and *add, delete* the PSNR of what a `delete` of it leaves to what "
    f"was before; *shuffled* is the PSNR of {SHUFFLED} additions to the same in another order; *time* is one "
    "`add`'s over the fuse of all."
)


def nodes(count: int) -> list[tuple[str, str, list[str]]]:
    """Name, source and placement of so many objects."""
    rng = random.Random(5)
    found = []
    for i in range(count):
        row, column = divmod(i, 8)
        words = ["-t", f"{1.3 * column},{1.3 * row},0", "-r", f"0,0,{rng.uniform(0, 360):.1f}"]
        source, size = (("chair", 0.6), ("fuze", 4.0))[i % 2]
        found.append((f"n{i:02d}", f"{source}.rfpack", [*words, "-s", f"{size * rng.uniform(0.7, 1.1):.3f}"]))
    return found


def compose(folder: Path, objects, scene: str) -> None:
    """A scene of some of them."""
    words = [word for name, source, place in objects for word in (source, "--name", name, *place)]
    fusedrf(folder, "compose", *words, "-o", scene)


def added(folder: Path, kind: str, objects, output: str, every: int = 0) -> tuple[list[float], list[list]]:
    """One fuse of the first, and an addition of each other; the seconds of each addition, and after every so
    many objects their number and the PSNR to the scene of them."""
    compose(folder, objects[:1], "first.json")
    fusedrf(folder, "fuse", "first.json", "--kind", kind, "-o", output)
    seconds, along = [], []
    for i, (name, source, place) in enumerate(objects[1:], 2):
        started = time.monotonic()
        fusedrf(folder, "add", output, source, "--name", name, *place, "-o", output)
        seconds.append(time.monotonic() - started)
        if every and i % every == 0:
            compose(folder, objects[:i], "some.json")
            along.append([i, psnr(pictures(folder, output), pictures(folder, "some.json"))])
    return seconds, along


def pictures(folder: Path, bundle: str, views: int = 4) -> np.ndarray:
    """Of a bundle or a scene, from around the lattice."""
    field, origin = renderable(load_scene(str(folder / bundle)))
    box, lens = np.array([-0.6, -0.6, -0.6, 9.7, 4.5, 0.6]), framing_lens(SIDE, SIDE)
    cameras = [framing(box, lens, 2 * np.pi * i / views + 0.3, 0.5).camera(lens) for i in range(views)]
    return np.array([render_image(field, camera, origin=origin).over((1, 1, 1)) for camera in cameras])


def densities(folder: Path, bundle: str, points: np.ndarray) -> np.ndarray:
    """(N,) at world points."""
    field, origin = load_scene(str(folder / bundle)).lone()
    ahead = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(len(points), 3)
    return field.query(torch.from_numpy(points - origin), ahead, False)[0].numpy()


def row(folder: Path, kind: str) -> tuple[dict, list[list]]:
    """All of it for one kind: the table's row, and number of objects and dB along the additions."""
    tell(kind)
    objects = nodes(OBJECTS[kind] + 1)
    before, extra = objects[:-1], objects[-1]
    compose(folder, before, "all.json")
    started = time.monotonic()
    fusedrf(folder, "fuse", "all.json", "--kind", kind, "-o", "once.rfpack")
    whole = time.monotonic() - started
    seconds, along = added(folder, kind, before, "many.rfpack", every=len(before) // 8 or 1)
    truth, once, many = (pictures(folder, name) for name in ("all.json", "once.rfpack", "many.rfpack"))

    name, source, place = extra
    said = fusedrf(folder, "add", "many.rfpack", source, "--name", name, *place, "-o", "more.rfpack")
    box = np.array(said["touched"]["aabb"])
    points = np.random.default_rng(1).uniform([-0.6, -0.6, -0.6], [9.7, 4.5, 0.6], (POINTS, 3))
    points = points[((points < box[:3]) | (points > box[3:])).any(1)]
    old, new = (densities(folder, bundle, points) for bundle in ("many.rfpack", "more.rfpack"))
    fusedrf(folder, "delete", "more.rfpack", name, "-o", "less.rfpack")

    few = before[:SHUFFLED]
    added(folder, kind, few, "few.rfpack")
    added(folder, kind, [few[0], *random.Random(2).sample(few[1:], SHUFFLED - 1)], "other.rfpack")
    found = {
        "kind": kind,
        "objects": len(before),
        "one by one, dB": f"{psnr(many, truth):.2f}",
        "at once, dB": f"{psnr(once, truth):.2f}",
        "outside": f"{np.abs(new - old).max() / old.max():.2g}",
        "add, delete, dB": f"{psnr(pictures(folder, 'less.rfpack'), many):.1f}",
        "shuffled, dB": f"{psnr(pictures(folder, 'few.rfpack'), pictures(folder, 'other.rfpack')):.1f}",
        "time": f"{np.median(seconds[len(seconds) // 2 :]) / whole:.2f}",
        "fuse, s": f"{whole:.1f}",
    }
    tell(str(found))
    return found, along


def write_page(out: Path, found: dict[str, tuple[dict, list[list]]]) -> None:
    """edits.json, edits.svg and edits.md; kinds that an earlier run measured stay."""
    path = out / "edits.json"
    kept = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    found = {kind: found.get(kind) or kept[kind] for kind in OBJECTS if kind in found or kind in kept}
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    lines = {kind: along for kind, (_, along) in found.items()}
    words = ("objects, added one by one", "PSNR to the scene of them, dB")
    over_time(lines, {}, words, out / "edits.svg")
    table = markdown([row for row, _ in found.values()])
    text = f"# Edits\n\n{ABOUT}\n\n{table}\n![PSNR along additions](edits.svg)\n"
    (out / "edits.md").write_text(text, encoding="utf-8")


def main() -> None:
    """Train, fuse, edit, measure, and write the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.edits", description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "real")
    parser.add_argument("--kind", action="append", choices=OBJECTS, help="this kind; may be repeated")
    parser.add_argument("--keep", type=Path, help="a folder in which trained sources are kept")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = (asked.keep or Path(name)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        for source, where in {"chair": "chair", "fuze": "fuze/fuze.obj"}.items():
            if not (folder / f"{source}.rfpack").exists():
                words = ("-o", f"{source}.rfpack", "--time-budget", "15")
                fusedrf(folder, "train", str(asked.data.resolve() / where), *words)
        for kind in asked.kind or OBJECTS:
            write_page(asked.out, {kind: row(folder, kind)})


if __name__ == "__main__":
    main()
