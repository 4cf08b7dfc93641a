"""Objects on a real background: python -m benchmarks.placed DATA [--out docs/real] [--share 1]

DATA is a folder with bear/, chair/, tankard/ and fuze/fuze.obj. Each is trained (--share multiplies the
seconds), the objects are put onto the bear's rock, and the scene is fused under 50 MB as blocks, vm and
sparse, or as each --kind. OUT gets placed.csv and placed.md: what each reaches by its own views, before
finishing on rays and after, bytes, seconds, and a frame over the background's alone. Rows of kinds that are
not measured stay as they were.
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.commit import commit_column, commit_line
from benchmarks.paper.table import markdown
from benchmarks.paper.work import fusedrf, stored_rows, tell, write_csv
from fusedrf_cli.bridge.capture_cameras import camera_set_of
from fusedrf_cli.bridge.evaluation_views import share_seen, view_targets
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.rendering import renderable
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.rendering.volume import render_image

SOURCES = {
    "bear": ("bear", 60),
    "chair": ("chair", 30),
    "tankard": ("tankard", 40, "--masks", "alpha"),
    "fuze": ("fuze/fuze.obj", 25),
}
"""Where each is in DATA, seconds of learning, and options."""
STANDS = {
    "chair": (0.45, (2.380991, 0.7681, -0.846972)),
    "tankard": (0.5, (2.621249, -0.45674, -0.499158)),
    "fuze": (3.0, (1.89, -0.79, -1.42)),
}
"""The size and the position in the bear's world of each object."""
UPRIGHT = np.array([[0.46212, 0.13039, -0.87718], [0.0, 0.98913, 0.14703], [0.88682, -0.06794, 0.45709]])
"""Columns: an object's axes in the bear's world, whose photos were taken with a tilted up."""
KINDS = ("blocks", "vm", "sparse")
MOST = "50MB"
FRAME, FRAMES = (800, 533), 9
ABOUT = (
    "Written by `make bench-real`; rows that a run leaves out stay, each with its *commit*. "
    "The chair, the tankard and the bottle stand on the bear's rock; PSNR is "
    "that of the fused field against the composition, mean of views from where the photos were taken and of "
    "views of each object from where it was photographed, none of which anything was learnt from; *the worst "
    f"object* is the mean of its own views. *frame* is the median of {FRAMES} pictures of "
    f"{FRAME[0]}×{FRAME[1]} pixels from one of the photos' cameras, and that over the background's alone, in "
    "turns."
)


def sources(folder: Path, data: Path, share: float) -> None:
    """Train what is not there yet."""
    for name, (where, seconds, *more) in SOURCES.items():
        if not (folder / f"{name}.rfpack").exists():
            tell(f"training {name}")
            words = ("-o", f"{name}.rfpack", "--time-budget", str(share * seconds), *more)
            fusedrf(folder, "train", str(data / where), *words)


def scene(folder: Path) -> None:
    """All of it in one scene."""
    words = ["bear.rfpack", "--background-node"]
    for name, (size, at) in STANDS.items():
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = size * UPRIGHT, at
        words += [f"{name}.rfpack", "--matrix", ",".join(f"{x:g}" for x in matrix.ravel())]
    fusedrf(folder, "compose", *words, "-o", "scene.json")


def check_seen(folder: Path) -> None:
    """Raise where an object is seen from none of the photos' cameras: it would be sunk in the rock, and what
    is said of it would be of fog."""
    loaded = load_scene(str(folder / "scene.json"))
    seen = share_seen(loaded, loaded.composed())
    cameras = [camera_of(view) for view in camera_set_of(loaded).views]
    for subject in view_targets(loaded):
        if not any(seen(camera, subject) > 0 for camera in cameras):
            raise SystemExit(f"{folder / 'scene.json'}: '{subject.name}' is seen in none of the photos")


def measured(folder: Path, kind: str) -> dict:
    """Fuse the scene as a kind: a row of the table."""
    tell(kind)
    fused = f"{kind}.rfpack"
    said = fusedrf(folder, "fuse", "scene.json", "--kind", kind, "--max-size", MOST, "-o", fused)
    own, alone = frame_seconds([folder / fused, folder / "bear.rfpack"])
    psnr = said["psnr"]
    figures = {
        "PSNR as stored, dB": psnr["stored"],
        "covered pixels": psnr.get("covered"),
        "the worst object": (psnr.get("worst_object") or {}).get("psnr"),
        "before rays": psnr["before_rgb"],
        "after": psnr["after_rgb"],
        "MB": said["bytes"] / 1e6,
        "seconds": said["total_seconds"],
        "frame, s": own,
        "over the background's": own / alone,
    }
    row = {k: "" if v is None else f"{v:.3g}" for k, v in figures.items()}
    return {"kind": kind} | row | commit_column()


def frame_seconds(bundles: list[Path]) -> list[float]:
    """The median seconds of a frame of each, taking turns after one that loads kernels."""
    loaded = [load_scene(str(path)) for path in bundles]
    camera = camera_of(camera_set_of(loaded[-1]).typical.reframed(*FRAME))
    fields = [renderable(scene) for scene in loaded]
    took: list[list[float]] = [[] for _ in bundles]
    for _ in range(1 + FRAMES):
        for (shown, origin), times in zip(fields, took, strict=True):
            started = time.perf_counter()
            render_image(shown, camera, origin=origin)
            times.append(time.perf_counter() - started)
    return [statistics.median(times[1:]) for times in took]


def write_page(out: Path, rows: list[dict]) -> None:
    """placed.csv and placed.md, with the rows that are there of other kinds."""
    path = out / "placed.csv"
    rows = rows + stored_rows(path, "kind", {row["kind"] for row in rows})
    rows.sort(key=lambda row: KINDS.index(row["kind"]))
    write_csv(path, rows)
    text = f"# Objects on a real background\n\n{commit_line()}\n\n{ABOUT}\n\n{markdown(rows)}"
    (out / "placed.md").write_text(text, encoding="utf-8")


def main() -> None:
    """Train, compose, fuse as every kind, and write the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.placed", description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "real")
    parser.add_argument("--share", type=float, default=1.0, help="of the seconds of training")
    parser.add_argument("--kind", action="append", choices=KINDS, help="this kind; may be repeated")
    parser.add_argument("--keep", type=Path, help="a folder in which trained sources are kept")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = (asked.keep or Path(name)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        sources(folder, asked.data.resolve(), asked.share)
        scene(folder)
        check_seen(folder)
        rows = [measured(folder, kind) for kind in asked.kind or KINDS]
    write_page(asked.out, rows)


if __name__ == "__main__":
    main()
