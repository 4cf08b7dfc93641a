"""Edits of fused scenes: python -m benchmarks.edits DATA [--out docs/real] [--keep FOLDER]

DATA is a folder with chair/ and fuze/fuze.obj. OUT gets edits.md, edits.svg and edits.json that they are made
of (a kind that is there and not asked for stays): for each kind of field what many additions one by one come
to against one fuse of all, what an edit changes outside of its region, what is left after an addition was
deleted again, what the order of additions changes, and how long an edit takes; and what 2,000 edits leave.
With KEEP a run that was interrupted goes on where it was.
"""

import argparse
import json
import random
import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.paper.figures import over_time
from benchmarks.paper.table import markdown
from benchmarks.paper.work import Kept, fusedrf, tell
from formats.bundle import read_headers
from formats.captures import write_capture
from formats.history import distilled
from formats.views import View
from fusedrf_cli.bridge.rendering import renderable, to_pixels
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.distillation.judging import meets
from fusedrf_cli.engine.rendering.cameras import Camera, framing, framing_lens
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.engine.settings import current

FUSING = {"vm": ("--time-budget", "20"), "sparse": ("--max-size", "4MB")}
"""Further words of a fuse."""


@dataclass(frozen=True)
class Edits:
    """What is edited, how often, and how it is looked at."""

    objects: tuple[tuple[str, int], ...] = (("blocks", 32), ("sparse", 8), ("vm", 32))
    """How many are added one by one; bricks take longer."""
    most: str = "1MB"
    """For a source: bricks as fine as larger ones take minutes to fill."""
    shuffled: int = 6
    side: int = 300
    views: int = 4
    points: int = 200_000
    inner: int = 3
    """Of the objects that were fused, one that is deleted."""
    repeats: int = 3
    photos: int = 40
    photo_side: int = 300
    refit: str = "30"
    edits: int = 2000
    """Of the long run."""
    cycle: int = 20
    """Of them that add an object, move it about, name it anew, and delete it."""


FRAME = np.array([-0.6, -0.6, -0.6, 9.7, 4.5, 0.6])
FRAME_SIDES = FRAME[3:] - FRAME[:3]
"""Of the lattice, which pictures show."""
EXTRA = "extra", "fuze.rfpack", ["-t", "4.55,0.1,0", "-r", "0,0,20", "-s", "4"]
"""One more object, between two others and reaching into their boxes."""
SMALL = "small", "chair.rfpack", ["-t", "4.55,2.0,0.2", "-s", "0.53"]
"""One whose box is about a hundredth of the scene's of 32; of that of 8 it is the one before."""
ABOUT = (
    f"Written by `python -m benchmarks.edits DATA`: chairs and bottles of {Edits.most} on a lattice, turned "
    f"and scaled. All PSNR is of {Edits.views} pictures of the whole. *One by one* is the PSNR to the "
    "composed "
    "scene of a field that all were added to, *at once* that of one fuse. To what was fused at once "
    "another object is added, between two and into their boxes: *outside* is the largest change of "
    "density, in parts of the largest, at points outside of the region that this touched, and the PSNR "
    "to before of the pixels whose rays miss it. *Deleted again*: the PSNR to before once it is "
    f"deleted, with all sources known; and with none, but {Edits.photos} photos of "
    f"{Edits.photo_side} x {Edits.photo_side} "
    "pixels of the scene before (`--refit`, half a minute). *Fused in, deleted*: of an object that was "
    "fused with the others, the PSNR to one fuse of the others as blocks, sources known and photos "
    f"alone. *Shuffled*: {Edits.shuffled} additions to the same in another order. *Edit*: seconds to add an "
    "object whose box has that share of the scene's, and over those of the fuse of all."
)
LONG = (
    f"\n## {Edits.edits:,} edits\n\nOf a small scene of blocks, in place and with `--keep-history`: an "
    f"object is added, moved {Edits.cycle - 3} times, named anew and deleted, over and over. Median seconds "
    "per edit of the first and the last hundred; bytes that history takes in the bundle, and bundles that "
    "are kept.\n\n"
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


def fused(folder: Path, kind: str, objects, output: str) -> float:
    """One fuse of all of them; its seconds."""
    compose(folder, objects, "some.json")
    started = time.monotonic()
    fusedrf(folder, "fuse", "some.json", "--kind", kind, *FUSING.get(kind, ()), "-o", output)
    return time.monotonic() - started


def put(folder: Path, bundle: str, one, output: str) -> tuple[float, dict]:
    """Add an object; the seconds and the report."""
    name, source, place = one
    started = time.monotonic()
    said = fusedrf(folder, "add", bundle, source, "--name", name, *place, "-o", output)
    return time.monotonic() - started, said


def changed_box(said: dict) -> list[float]:
    """(6,) outside of which an edit changed nothing, as it reported."""
    return said["touched"]["aabb"]


def held(bundle: Path) -> set[str]:
    """Names of the objects in a bundle."""
    scene = read_headers(bundle)[0]
    return {leaf.name for leaf in scene.leaves()} | distilled(scene.history).keys()


def begun(folder: Path, kind: str, one, output: str) -> None:
    """A fuse of one object."""
    first = folder / f"{kind}_first.rfpack"
    if not first.exists():
        fused(folder, kind, [one], first.name)
    shutil.copy(first, folder / output)


def added(folder: Path, kind: str, objects, output: str, kept: Kept) -> list[list]:
    """A fuse of the first and an addition of each other, and after every quarter of them their number and the
    PSNR to the scene of them."""
    along = kept.found.get(output, [])
    done = along[-1][0] if along else 0
    every = max(1, len(objects) // 4)
    ends = [*range(every, len(objects), every), len(objects)]
    for last in (end for end in ends if end > done):
        for i in range(done, last):
            if i == 0:
                begun(folder, kind, objects[0], output)
            elif objects[i][0] not in held(folder / output):
                put(folder, output, objects[i], output)
        compose(folder, objects[:last], "some.json")
        done, along = last, [*along, [last, psnr(pictures(folder, output), pictures(folder, "some.json"))]]
        kept.note(output, along)
    return along


def cameras() -> list[Camera]:
    """From around the lattice."""
    config = current(Edits)
    lens = framing_lens(config.side, config.side)
    angles = (2 * np.pi * i / config.views + 0.3 for i in range(config.views))
    return [framing(FRAME, lens, angle, 0.5).camera(lens) for angle in angles]


def pictures(folder: Path, bundle: str) -> np.ndarray:
    """(`views`, H, W, 3) of a bundle or a scene over white."""
    field, origin = renderable(load_scene(str(folder / bundle)))
    return np.array([render_image(field, camera, origin=origin).over((1, 1, 1)) for camera in cameras()])


def likeness(folder: Path, one: str, other: str) -> float:
    """PSNR in dB of pictures of two bundles or scenes; 99 where they are the same."""
    found = psnr(pictures(folder, one), pictures(folder, other))
    return min(float(found), 99.0)


def densities(folder: Path, bundle: str, points: np.ndarray) -> np.ndarray:
    """(N,) at world points."""
    field, origin = renderable(load_scene(str(folder / bundle)))
    ahead = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(len(points), 3)
    return field.query(torch.from_numpy(points - origin), ahead, False)[0].numpy()


def outside(folder: Path, before: str, after: str, box: np.ndarray) -> tuple[float, float]:
    """The largest change of density at points outside of a box (6,) of the world, in parts of the largest
    density, and the PSNR in dB of the pixels whose rays miss it."""
    config = current(Edits)
    points = np.random.default_rng(1).uniform(FRAME[:3], FRAME[3:], (config.points, 3))
    points = points[((points < box[:3]) | (points > box[3:])).any(1)]
    old, new = (densities(folder, bundle, points) for bundle in (before, after))
    missed = np.array([~meets(*camera.rays(), box).reshape(config.side, config.side) for camera in cameras()])
    shots = [pictures(folder, bundle)[missed] for bundle in (before, after)]
    return float(np.abs(new - old).max() / old.max()), min(float(psnr(*shots)), 99.0)


def photographed(folder: Path, scene: str, output: Path) -> None:
    """A capture of a scene from around it and above, with what is empty transparent."""
    config = current(Edits)
    field, origin = renderable(load_scene(str(folder / scene)))
    lens, views, shots = framing_lens(config.photo_side, config.photo_side), [], []
    for i in range(config.photos):
        outlook = framing(FRAME, lens, 2.4 * i, 0.15 + 1.0 * i / config.photos)
        c = outlook.camera(lens, name=f"p{i:02d}")
        shots.append(to_pixels(render_image(field, c, origin=origin), None))
        views.append(View(c.name, c.camera_to_world, c.fl_x, c.fl_y, c.cx, c.cy, c.width, c.height))
    write_capture(output, views, np.array(shots))


def deleted(folder: Path, bundle: str, name: str, before: str) -> tuple[float, float]:
    """PSNR in dB to a bundle or scene of what is left when an object is deleted: where the other sources are
    found, and where none is, but there are photos of that scene."""
    learning = ("--time-budget", current(Edits).refit)
    fusedrf(folder, "delete", bundle, name, *learning, "-o", "less.rfpack")
    known = likeness(folder, "less.rfpack", before)
    apart = folder / "apart"
    shutil.rmtree(apart, ignore_errors=True)
    apart.mkdir()
    shutil.copy(folder / bundle, apart / "bundle.rfpack")
    photographed(folder, before, apart / "photos")
    fusedrf(apart, "delete", "bundle.rfpack", name, "--refit", "photos", *learning, "-o", "../less.rfpack")
    return known, likeness(folder, "less.rfpack", before)


def shuffled(folder: Path, kind: str, objects) -> float:
    """PSNR in dB of additions to the same in another order."""
    orders = objects, [objects[0], *random.Random(2).sample(objects[1:], len(objects) - 1)]
    for order, output in zip(orders, ("few.rfpack", "other.rfpack"), strict=True):
        begun(folder, kind, order[0], output)
        for one in order[1:]:
            put(folder, output, one, output)
    return likeness(folder, "few.rfpack", "other.rfpack")


def timed(folder: Path, bundle: str, one) -> tuple[float, float]:
    """Median seconds of adding an object, and the share that it touches of the scene's box."""
    tried = [put(folder, bundle, one, "more.rfpack") for _ in range(current(Edits).repeats)]
    low, high = np.array(tried[0][1]["touched"]["aabb"]).reshape(2, 3)
    return float(np.median([seconds for seconds, _ in tried])), float(np.prod((high - low) / FRAME_SIDES))


def row(folder: Path, kind: str) -> tuple[dict, list[list]]:
    """All of it for one kind: the table's row, and number of objects and dB along the additions."""
    config = current(Edits)
    tell(kind)
    kept = Kept(folder / f"{kind}.json")
    objects = nodes(dict(config.objects)[kind])
    once, many, more = (f"{kind}_{name}.rfpack" for name in ("once", "many", "more"))
    compose(folder, objects, "all.json")
    whole = kept.once("seconds", lambda: fused(folder, kind, objects, once))
    seconds, share = kept.once("edit", lambda: timed(folder, once, SMALL if len(objects) > 8 else EXTRA))
    at_once = kept.once("at once", lambda: likeness(folder, once, "all.json"))
    box = kept.once("box", lambda: changed_box(put(folder, once, EXTRA, more)[1]))
    change, missed = kept.once("outside", lambda: outside(folder, once, more, np.array(box)))
    again = kept.once("deleted again", lambda: deleted(folder, more, EXTRA[0], once))
    without = f"without_{len(objects)}.rfpack"
    if not (folder / without).exists():  # as blocks it is the composed scene, and is rendered sooner
        fused(folder, "blocks", objects[: config.inner] + objects[config.inner + 1 :], without)
    inner = kept.once("fused in", lambda: deleted(folder, once, objects[config.inner][0], without))
    order = kept.once("shuffled", lambda: shuffled(folder, kind, objects[: config.shuffled]))
    along = added(folder, kind, objects, many, kept)
    return {
        "kind": kind,
        "objects": len(objects),
        "one by one, dB": f"{along[-1][1]:.2f}",
        "at once, dB": f"{at_once:.2f}",
        "outside": f"{change:.2g}; {decibels(missed)}",
        "deleted again: known; photos": f"{decibels(again[0])}; {decibels(again[1])}",
        "fused in, deleted: known; photos": f"{decibels(inner[0])}; {decibels(inner[1])}",
        "shuffled": decibels(order),
        "edit: share, s": f"{share:.3f}, {seconds:.1f}",
        "over a fuse": f"{seconds / whole:.2f}",
        "fuse, s": f"{whole:.1f}",
    }, along


def decibels(value: float) -> str:
    """In the table."""
    return "identical" if value >= 99 else f"{value:.1f} dB"


def long_run(folder: Path) -> dict:
    """Edit after edit of a small scene, in place."""
    kept = Kept(folder / "long.json")
    seconds, history = kept.found.get("run", ([], 0))
    if not seconds:
        objects = nodes(2)
        lone = [(name, source, []) for name, source, _ in objects[1:]]
        for name, chosen in (("pair", objects), ("lone", lone)):
            compose(folder, chosen, "some.json")
            words = ("--kind", "blocks", "--max-size", "200kB", "-o", f"{name}.rfpack")
            fusedrf(folder, "fuse", "some.json", *words)
        shutil.copy(folder / "pair.rfpack", folder / "cycle.rfpack")
        shutil.rmtree(folder / "pair.rfpack.history", ignore_errors=True)
    shutil.copy(folder / "cycle.rfpack", folder / "pair.rfpack")
    while len(seconds) < current(Edits).edits:
        seconds += cycle(folder)
        shutil.copy(folder / "pair.rfpack", folder / "cycle.rfpack")
        said = read_headers(folder / "pair.rfpack")[0].history
        history = max(history, len(json.dumps(said)))
        kept.note("run", (seconds, history))
    return {
        "edits": len(seconds),
        "first hundred, s": f"{np.median(seconds[:100]):.3f}",
        "last hundred, s": f"{np.median(seconds[-100:]):.3f}",
        "history, bytes": history,
        "bundles kept": len(list((folder / "pair.rfpack.history").iterdir())),
    }


def cycle(folder: Path) -> list[float]:
    """Seconds of each of `cycle` edits, after which the scene holds what it did."""
    steps = [
        ("add", "lone.rfpack", "--name", "one", "-t", "1.3,1,0", "-s", "4"),
        ("move", "one", "-r", "0,0,17"),
        *[("move", "one", "-t", f"{0.3 * (-1) ** i},0,0") for i in range(current(Edits).cycle - 4)],
        ("rename", "one", "two"),
        ("delete", "two"),
    ]
    seconds = []
    for verb, *words in steps:
        started = time.monotonic()
        fusedrf(folder, verb, "pair.rfpack", *words, "--keep-history", "-o", "pair.rfpack")
        seconds.append(time.monotonic() - started)
    return seconds


def write_page(out: Path, found: dict) -> None:
    """edits.json, edits.svg and edits.md; what an earlier run measured and this one did not stays."""
    path = out / "edits.json"
    found = (json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}) | found
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    kinds = [found[kind] for kind in dict(current(Edits).objects) if kind in found]
    lines = {row["kind"]: along for row, along in kinds}
    over_time(lines, {}, ("objects, added one by one", "PSNR to the scene of them, dB"), out / "edits.svg")
    table = markdown([row for row, _ in kinds])
    text = f"# Edits\n\n{ABOUT}\n\n{table}\n![PSNR along additions](edits.svg)\n"
    if "long" in found:
        text += LONG + markdown([found["long"]])
    (out / "edits.md").write_text(text, encoding="utf-8")


def main() -> None:
    """Train, fuse, edit, measure, and write the page."""
    config = current(Edits)
    parser = argparse.ArgumentParser(prog="python -m benchmarks.edits", description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "real")
    measured = [*dict(config.objects), "long"]
    parser.add_argument("--kind", action="append", choices=measured, help="one; may be repeated")
    parser.add_argument("--keep", type=Path, help="a folder in which sources and figures are kept")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = (asked.keep or Path(name)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        for source, where in {"chair": "chair", "fuze": "fuze/fuze.obj"}.items():
            if not (folder / f"{source}.rfpack").exists():
                words = ("-o", f"{source}.rfpack", "--time-budget", "15", "--max-size", config.most)
                fusedrf(folder, "train", str(asked.data.resolve() / where), *words)
        for what in asked.kind or measured:
            write_page(asked.out, {what: long_run(folder) if what == "long" else row(folder, what)})


if __name__ == "__main__":
    main()
