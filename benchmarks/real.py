"""Real captures: python -m benchmarks.real DATA [--out docs/real] [--share 1] (or make bench-real DATA=…)

DATA is a folder of captures. Every eighth photo of each is held out, and each is trained at several time
budgets, which --share multiplies. OUT gets table.md, real.csv that it is made of, psnr.svg, and of each
capture a held-out photo beside the picture of it after the longest budget. Rows of captures that DATA does
not hold stay as they were. Rendered pictures (with alpha) and photos without poses are left out.
"""

import argparse
import csv
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.commit import commit_column, commit_line
from benchmarks.paper.figures import over_time
from benchmarks.paper.table import markdown
from benchmarks.paper.work import fusedrf, median_frame, stored_rows, tell, write_csv
from formats.captures import is_capture, read_capture
from formats.errors import FormatError
from formats.views import Capture, View, hold_out
from fusedrf_cli import plots
from fusedrf_cli.bridge.pictures import camera_of, truth_of
from fusedrf_cli.bridge.rendering import renderable
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.engine.settings import current

EVERY = 8
BUDGETS = {"fox": (30, 120, 600), "bear": (120, 600), "cup": (300, 900), "fern": (300,)}
"""Seconds of learning."""


@dataclass(frozen=True)
class RealConfig:
    """How captures are learnt and shown."""

    others: tuple[float, ...] = (120,)
    """Of captures that are not named."""
    frame_width: int = 800
    """Pixels."""
    frames: int = 3
    """That are timed."""


SHOWN_WIDTH = 320
"""Pixels of a picture on the page, of which two stand side by side."""
QUALITY = 80
"""Of JPEG: some 20 kB a picture."""
ABOUT = (
    "Written by `make bench-real`; rows that a run leaves out stay, each with its *commit*. "
    f"Every {EVERY}th photo is held out; *kind* is what `train` took at that commit. "
    "PSNR is the mean over those photos, "
    "in the pixels that masks keep; *corrected* is after the affine map of colours that suits each photo "
    "best, which the photo itself tells; *gap* is the training PSNR less the held-out one; *mean colour* and "
    "*nearest photo* are what the mean colour of the training photos and a copy of the nearest one reach. "
    "*Minutes* are the time budget of learning, *seconds* those of the whole command, with reading and "
    f"measuring; *frame* is the median of {RealConfig.frames} pictures of a held-out view, "
    f"{RealConfig.frame_width} pixels wide."
)


def captures(data: Path) -> Iterator[tuple[str, Capture]]:
    """Name and capture, with its photos held out, of each folder with posed photos."""
    for folder in sorted(data.iterdir()):
        if not folder.is_dir() or not is_capture(folder):
            continue
        try:
            capture = hold_out(read_capture(folder), EVERY)
        except FormatError as error:
            tell(f"{folder.name} is left out: {error}")
            continue
        if capture.opaque:
            yield folder.name, capture
        else:
            tell(f"{folder.name} is left out: its pictures have alpha, and are no photos")


def measured(folder: Path, name: str, capture: Capture, seconds: float, field: Path) -> dict:
    """Train for so many seconds, write the field, and measure it: a row of the table."""
    tell(f"{name}: {seconds:g} s")
    words = ("--holdout", str(EVERY), "--time-budget", str(seconds))
    started = time.monotonic()
    report = fusedrf(folder, "train", str(folder.resolve()), "-o", str(field), *words)
    total, held = time.monotonic() - started, report["holdout"]
    return {
        "capture": name,
        "photos": f"{report['views']} of {report['capture']['photos']}",
        "poses": report["capture"]["kind"],
        "space": report["space"],
        "kind": report["kind"],
        "minutes": seconds / 60,
        "steps": report["steps"],
        "PSNR": held["psnr"],
        "corrected": held["colour_corrected_psnr"],
        "SSIM": held["ssim"],
        "gap": held["psnr_gap"],
        "mean colour": held["baseline_psnr"]["mean_colour"],
        "nearest photo": held["baseline_psnr"]["nearest_photo"],
        "MB": report["bytes"] / 1e6,
        "seconds": total,
        "frame, s": frame_seconds(field, capture.test[len(capture.test) // 2]),
    } | commit_column()


def frame_seconds(field: Path, view: View) -> float:
    """The median of `frames` pictures of a view, `frame_width` wide, after one that loads kernels."""
    config = current(RealConfig)
    shown, origin = renderable(load_scene(str(field)))
    wide = config.frame_width
    camera = camera_of(view.reframed(wide, round(wide * view.height / view.width)))
    return median_frame(shown, camera, origin, config.frames)


def write_pair(field: Path, view: View, path: Path) -> None:
    """A photo, of which masks leave white what they exclude, beside the field's picture of it, as JPEG."""
    shown, origin = renderable(load_scene(str(field)))
    truth, kept = truth_of(view)
    shot = np.clip(render_image(shown, camera_of(view), origin=origin).over(), 0, 1)
    pair = np.concatenate([np.where(kept[..., None], truth, 1), shot], 1)
    size = (2 * SHOWN_WIDTH, round(SHOWN_WIDTH * view.height / view.width))
    Image.fromarray(np.rint(255 * pair).astype(np.uint8)).resize(size, Image.Resampling.BOX).save(
        path, quality=QUALITY
    )


# -- the page ------------------------------------------------------------------------------------------------


def chart(rows: list[dict], path: Path) -> None:
    """PSNR over minutes of each capture, and as a dotted line what a copy of the nearest photo reaches."""
    lines, copies = {}, {}
    for row in rows:
        lines.setdefault(row["capture"], []).append((float(row["minutes"]), float(row["PSNR"])))
        copies[row["capture"]] = float(row["nearest photo"])
    words = ("minutes of learning", "PSNR of held-out photos, dB (dotted: a copy of the nearest photo)")
    over_time(lines, copies, words, path)


def write_page(out: Path, rows: list[dict]) -> None:
    """real.csv, psnr.svg and table.md."""
    rows = sorted(rows, key=lambda row: (row["capture"], float(row["minutes"])))
    write_csv(out / "real.csv", rows)
    chart(rows, out / "psnr.svg")
    with (out / "real.csv").open(newline="", encoding="utf-8") as file:
        text = f"# Real captures\n\n{commit_line()}\n\n{ABOUT}\n\n{markdown(list(csv.DictReader(file)))}"
    text += "\n![PSNR over minutes](psnr.svg)\n\n## Held-out photos, and the field's pictures of them\n"
    for name in dict.fromkeys(row["capture"] for row in rows):
        if (out / f"{name}.jpg").exists():
            longest = max(float(row["minutes"]) for row in rows if row["capture"] == name)
            text += f"\n{name}, after {longest:g} minutes:\n\n![{name}]({name}.jpg)\n"
    (out / "table.md").write_text(text, encoding="utf-8")


def main() -> None:
    """Measure capture after capture; the page is written anew after each."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.real", description=__doc__)
    parser.add_argument("data", type=Path, help="a folder of captures")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "real")
    parser.add_argument("--share", type=float, default=1.0, help="of the time budgets")
    asked = parser.parse_args()
    plots.check()
    asked.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        field = Path(folder) / "field.rfpack"
        for name, capture in captures(asked.data):
            rows = stored_rows(asked.out / "real.csv", "capture", {name})
            for seconds in BUDGETS.get(name, current(RealConfig).others):
                rows.append(measured(asked.data / name, name, capture, seconds * asked.share, field))
            write_pair(field, capture.test[len(capture.test) // 2], asked.out / f"{name}.jpg")
            write_page(asked.out, rows)


if __name__ == "__main__":
    main()
