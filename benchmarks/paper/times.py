"""Time to a PSNR: fusing from the background's weights, from scratch with 3D losses alone, and training anew
from pictures of the naive composition. All are held to the same views of it, which none was trained on.
"""

import time
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from benchmarks.paper import figures
from benchmarks.paper.sources import four_objects
from benchmarks.paper.work import SIZES, FusedConfig, Work, course, fusedrf, tell, write_csv
from formats.captures import write_capture
from formats.views import View
from fusedrf_cli.bridge.rendering import to_pixels
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.rendering.cameras import scattered
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class TimesConfig:
    """How long what is compared takes, and by which pictures."""

    wanted: float = 37.0
    """PSNR in dB."""
    fusing: tuple[int, ...] = (5, 15, 45)
    """Seconds of learning."""
    training: tuple[int, ...] = (10, 30, 90, 240)
    views: int = 60
    """That retraining learns from."""
    size: int = 300
    """Pixels a side of these."""
    seed: int = 31
    compared: int = 400
    """Pixels a side of the pictures compared."""


DISTILLED = {"background": (), "scratch": ("--from-scratch", "--no-finetune")}


def times(work: Work) -> dict[str, str]:
    """Write times.csv and times.svg; the figures of the table."""
    config = current(TimesConfig)
    scene = four_objects(work)
    held, rows = course(scene, config.compared), []

    def note(way: str, path: Path, seconds: float) -> None:
        rows.append({"way": way, "seconds": seconds, "psnr": held.quality(path)["psnr"]})
        write_csv(work.out / "times.csv", rows)
        figures.times(rows, config.wanted, work.out / "times.svg")

    for way, path, seconds in chain(fusings(scene), trainings(scene, held.box)):  # all write one path
        note(way, path, seconds)
    retraining = seconds_to(rows, "retraining")
    limit = max(r["seconds"] for r in rows if r["way"] == "retraining")
    ways = [way for way in dict.fromkeys(r["way"] for r in rows) if way != "retraining"]
    ratios = []
    for way in ways:
        found = seconds_to(rows, way)
        if found is not None:
            more = f"{retraining / found:.0f}×" if retraining else f"more than {limit / found:.0f}×"
            ratios.append(f"{way} {more}")
    best = max(r["psnr"] for r in rows if r["way"] == "retraining")
    missed = "" if retraining else f"; retraining is at {best:.1f} dB after {limit:.0f} s"
    return {"time": (", ".join(ratios) or f"none reached {config.wanted:g} dB") + missed}


def fusings(scene: Path):
    """(way, bundle, seconds) of fused fields."""
    for kind in current(FusedConfig).kinds:  # the first of a kind loads kernels
        if kind not in SIZES:
            fuse(scene, "--kind", kind, *(("--time-budget", "1") if kind == "vm" else ()))
    for kind in current(FusedConfig).kinds:
        if kind != "vm" and kind not in SIZES:
            yield kind, *fuse(scene, "--kind", kind)
    for way, words in DISTILLED.items():
        for budget in current(TimesConfig).fusing:
            yield way, *fuse(scene, "--kind", "vm", "--time-budget", str(budget), *words)


def fuse(scene: Path, *words: str) -> tuple[Path, float]:
    """A fused bundle, and the seconds that it took."""
    tell(f"times: {' '.join(words)}")
    size = SIZES.get(words[words.index("--kind") + 1], current(FusedConfig).most_bytes)
    line = ("-o", "times.rfpack", "--max-size", str(size), *words)
    report = fusedrf(scene.parent, "fuse", scene.name, *line)
    return scene.with_name("times.rfpack"), report["total_seconds"]


def trainings(scene: Path, box: np.ndarray):
    """(way, bundle, seconds) of fields trained on pictures of the scene, whose rendering counts."""
    config = current(TimesConfig)
    tell(f"times: {config.views} views of the scene as composed")
    photos, started = scene.with_name("photos"), time.monotonic()
    photograph(scene, box, photos)
    rendering = time.monotonic() - started
    aabb = ",".join(f"{v:.4f}" for v in box)
    words = ("train", photos.name, "-o", "times.rfpack", "--aabb", aabb, "--quality", "high")
    fusedrf(scene.parent, *words, "--time-budget", "1")  # loads kernels
    for budget in config.training:
        tell(f"times: training for {budget} s")
        started = time.monotonic()
        fusedrf(scene.parent, *words, "--time-budget", str(budget))
        yield "retraining", scene.with_name("times.rfpack"), rendering + time.monotonic() - started


def photograph(scene: Path, box: np.ndarray, folder: Path) -> None:
    """A capture of the scene as composed, from all around a box (6,)."""
    config = current(TimesConfig)
    composed = load_scene(str(scene)).composed()
    cameras = scattered(box, config.views, config.size, config.size, seed=config.seed)
    shots = [render_image(composed, c, origin=composed.origin) for c in cameras]
    views = [View(c.name, c.camera_to_world, c.fl_x, c.fl_y, c.cx, c.cy, c.width, c.height) for c in cameras]
    write_capture(folder, views, np.stack([to_pixels(shot, None) for shot in shots]), "train")


def seconds_to(rows: list[dict], way: str) -> float | None:
    """Seconds after which a way is at `wanted`, between two of its points by a straight line over the
    logarithm of time; None where it never is.
    """
    config = current(TimesConfig)
    found = [(r["seconds"], r["psnr"]) for r in rows if r["way"] == way]
    before = None
    for seconds, psnr in sorted(found):
        if psnr >= config.wanted:
            if before is None:
                return seconds
            share = (config.wanted - before[1]) / (psnr - before[1])
            return float(np.exp(np.log(before[0]) + share * (np.log(seconds) - np.log(before[0]))))
        before = seconds, psnr
    return None
