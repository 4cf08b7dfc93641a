"""What every experiment uses: commands run in this process, views to hold fields to, memory, and files."""

import contextlib
import csv
import io
import json
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fusedrf_cli.bridge.charting import Benchmark, frame_seconds
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.main import cli


@dataclass(frozen=True)
class FusedConfig:
    """The fused fields that are measured."""

    most_bytes: int = 25_000_000
    """The paper's size of a fused field."""
    kinds: tuple[str, ...] = ("blocks", "sparse", "vm")


SIZES = {"sparse": 6_000_000}
"""Bytes of a kind of which less is taken: bricks of the paper's size take minutes to fill."""


@dataclass(frozen=True)
class Work:
    """Where an experiment reads and writes."""

    folder: Path
    """Sources and scenes, which are kept between runs."""
    out: Path
    """Tables and plots."""
    data: Path | None
    """Captures: chair/ and fuze/fuze.obj; None: scenes that are made here alone."""


class Kept:
    """What was measured so far, in a file, so that a run can go on."""

    def __init__(self, path: Path):
        self.path = path
        self.found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}

    def note(self, name: str, value) -> None:
        """Remember a value."""
        self.found[name] = value
        self.path.write_text(json.dumps(self.found), encoding="utf-8")
        tell(f"{name}: {value}"[:200])

    def once(self, name: str, measure: Callable[[], object]):
        """What `measure` gives, which is asked once."""
        if name not in self.found:
            self.note(name, measure())
        return self.found[name]


def fusedrf(folder: Path, *words: str) -> dict:
    """The JSON report of a command in a folder. It runs in this process, so that kernels are loaded once.
    RuntimeError with its sentence where it fails; a missed quality is a report.
    """
    line = [*words, "--json"] if words[0] == "eval" else [*words, "--json", "-w"]
    said, wrong = io.StringIO(), io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(said), contextlib.redirect_stderr(wrong):
        try:
            cli.main(line)
        except SystemExit as end:
            code = end.code
    if code not in (0, 7):
        raise RuntimeError(f"fusedrf {' '.join(line)}: {wrong.getvalue().strip()}")
    return json.loads(said.getvalue())


def course(scene: Path, size: int, box=None) -> Benchmark:
    """Views of a scene that nothing was trained or chosen on; box (6,) is what they frame, by default the
    whole and its objects as they were photographed."""
    return Benchmark.prepare(str(scene), Memory(), (size, size), box=box)


def frame_times(held: Benchmark, bundles: Sequence[Path]) -> list[float]:
    """Median ms of a frame of the scene as composed and of each bundle, all taking turns."""
    return held.frame_times(bundles, lambda done: None)


def median_frame(field, camera: Camera, origin: np.ndarray, frames: int) -> float:
    """The median seconds of so many frames, after one that loads kernels."""
    took = [frame_seconds(field, camera, origin) for _ in range(1 + frames)]
    return statistics.median(took[1:])


def peak_of(scene: Path, size: int) -> int:
    """Bytes that a process of its own holds at most, which reads a scene and renders one frame of it."""
    picture = str(scene.with_suffix(".peak.png"))
    words = ["render", str(scene), "-o", picture, "--size", f"{size}x{size}", "-w", "--json"]
    line = [sys.executable, "-m", "fusedrf_cli", *words]
    done = subprocess.run(line, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=True)
    return json.loads(done.stdout)["memory"]["peak_bytes"]


def stored_rows(path: Path, key: str, measured: set[str]) -> list[dict]:
    """Rows that are in a file, if it is there, but for those whose `key` is among what was measured anew."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if row[key] not in measured]


def write_csv(path: Path, rows: Iterable[dict]) -> None:
    """Rows with the same keys, which are the columns."""
    rows = list(rows)
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        table.writeheader()
        table.writerows({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in r.items()} for r in rows)


def tell(text: str) -> None:
    """A line of progress."""
    print(text, file=sys.stderr, flush=True)
