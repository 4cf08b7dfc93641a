"""The table: what is asked of this project, and what was seen."""

import csv
import os
from pathlib import Path

from benchmarks.commit import commit_column, commit_line
from benchmarks.paper.work import write_csv

MEASURES = {
    "flat": ("fused frame time at N = 8 over N = 1", "1.00", "≤ 1.10", "≤ 1.02"),
    "naive over fused": ("naive over fused frame time at N = 8", "8.4×", "≥ 7×", "≥ 8×"),
    "points": ("PSNR, 3D losses only, ≤ 25 MB", "35.2 to 37.2 dB", "≥ 38 dB", "≥ 42 dB"),
    "pictures": ("PSNR, with RGB finishing, ≤ 25 MB", "38.8 to 40.3 dB", "≥ 41 dB", "≥ 45 dB"),
    "time": ("time to 37 dB, retraining over fusing", "3×", "≥ 10×", "≥ 30×"),
    "picked": ("size that --target-psnr 40 picks over the chart's smallest", "–", "≤ 1.3", "≤ 1.1"),
    "smallest": ("smallest bundle at 40 dB, four objects", "25 MB", "≤ 12 MB", "≤ 3 MB"),
    "closeup": ("close-up of an object at 1/20 of the scene's size", "fails", "≥ 33 dB", "≥ 38 dB"),
    "capacity": ("PSNR in 25 MB with 1, 2, 4, 8, 16, 32 objects", "–", "drawn", "≥ 38 dB at 32"),
    "seeds": ("spread of five seeds", "–", "≤ 0.3 dB", "–"),
}
PARTS = {  # CSVs that the page shows whole, and what it says of them
    "capacity": "N different things stand on one ground, all of one size, at places that do not depend on N "
    "(a sunflower's seeds); the timed camera frames the ground and is the same for all N. "
    "`ms at n = 1` is the fused scene of one thing, whose frames take turns with the others of the row. "
    "Peak memory is that of a process that reads the scene and renders one frame of 400 × 400.",
    "kinds": "Four objects, at most 25 MB (bricks 6 MB, since more take minutes to fill), on views of "
    "400 × 400.",
    "times": "Seconds of the whole command once kernels are loaded. Retraining first renders 60 views of "
    "300 × 300 of the scene as composed, which counts, and is told the scene's box.",
    "closeup": "Views that frame the small object alone.",
    "seeds": "Views of 200 × 200.",
    "sizes": "Blocks of the four objects in fewer bytes.",
    "smallest": "The smallest point of the chart at 40 dB, and what the search picks.",
}
ABOUT = (
    "Written by `make bench-paper` on {cores} CPU cores. PSNR and SSIM are against the naive composition, "
    "mean over views that nothing was trained or chosen on: of the whole scene, and of each object from "
    "where and as large as it was photographed. *Covered* is the PSNR of the pixels that the scene covers, "
    "*covered share* how many of all they are. Parts that a run leaves out stay as they were: "
    "the tables are of the commits of their measures, sizes of that of the smallest bundle."
)
PLOTS = {"capacity": "capacity", "times": "times", "smallest": "chart"}


def update(out: Path, seen: dict[str, str]) -> None:
    """Note what was seen in measures.csv, keep what is there of other measures, and write table.md."""
    kept = {}
    if (out / "measures.csv").exists():
        with (out / "measures.csv").open(newline="", encoding="utf-8") as file:
            kept = {row["key"]: (row["seen"], row["commit"]) for row in csv.DictReader(file)}
    kept |= {key: (text, commit_column()["commit"]) for key, text in seen.items()}
    columns = ("measure", "the paper", "bar", "aim", "seen", "commit")
    rows = [dict(zip(columns, (*m, *kept.get(key, ("", ""))), strict=True)) for key, m in MEASURES.items()]
    write_csv(out / "measures.csv", [{"key": k} | row for k, row in zip(MEASURES, rows, strict=True)])
    (out / "table.md").write_text(page(out, rows), encoding="utf-8")


def page(out: Path, rows: list[dict]) -> str:
    """table.md of the measures and of the CSVs that are there."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    text = f"# The paper's experiments\n\n{commit_line()}\n\n{ABOUT.format(cores=cores)}\n\n"
    text += markdown(rows)
    for part, what in PARTS.items():
        path = out / f"{part}.csv"
        if path.exists():
            with path.open(newline="", encoding="utf-8") as file:
                text += f"\n## {part.capitalize()}\n\n{what}\n\n" + markdown(list(csv.DictReader(file)))
            if part in PLOTS:
                text += f"\n![{part}]({PLOTS[part]}.svg)\n"
    return text


def markdown(rows: list[dict]) -> str:
    """A table of rows with the same keys."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([str(v) for v in row.values()] for row in rows)]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)
