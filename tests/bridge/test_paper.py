"""`make bench-paper`, made small: every part runs, what it writes can be read, and the table shows it."""

import csv
import itertools
import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.commit import commit_column, commit_line
from benchmarks.paper import capacity, figures, quality, smallest, sources, table, times
from benchmarks.paper.__main__ import EXPERIMENTS
from benchmarks.paper.capacity import CapacityConfig
from benchmarks.paper.quality import QualityConfig
from benchmarks.paper.smallest import SmallestConfig
from benchmarks.paper.times import TimesConfig
from benchmarks.paper.work import FusedConfig, Work, course, fusedrf
from fusedrf_cli.engine.rendering.cameras import projected
from tests.bridge.conftest import write_scene_of

SMALL = (
    FusedConfig(kinds=("blocks", "vm"), most_bytes=300_000),
    QualityConfig(size=24, seeds=2),
    SmallestConfig(size=24),
    TimesConfig(compared=24, size=24, fusing=(1,), training=(1,), views=4, wanted=5.0),
)
BLOCKS = FusedConfig(kinds=("blocks",))


@pytest.fixture
def work(folder, tmp_path, monkeypatch, in_force) -> Work:
    """The shop's scene in place of all others, and tiny pictures."""
    for module in (quality, times, smallest):
        monkeypatch.setattr(module, "four_objects", lambda work: folder / "scene.json")
    in_force(*SMALL)
    (tmp_path / "out").mkdir()
    return Work(folder, tmp_path / "out", None)


def rows_of(work: Work, name: str) -> list[dict]:
    with (work.out / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_kinds_and_seeds(work, in_force):
    in_force(BLOCKS)
    seen = quality.kinds(work) | quality.seeds(work)
    plain, finished = rows_of(work, "kinds")
    assert (plain["rgb"], finished["rgb"]) == ("False", "True")
    assert seen["points"] == f"blocks {float(plain['psnr']):.1f} dB" and float(plain["psnr"]) > 30
    assert [row["seed"] for row in rows_of(work, "seeds")] == ["0", "1"]


def test_a_close_up_frames_the_object_alone(work, folder, monkeypatch, in_force):
    box = np.array([-0.8, -0.3, -0.3, -0.2, 0.3, 0.3])  # of red
    monkeypatch.setattr(quality, "with_a_tiny_one", lambda work: (folder / "scene.json", box))
    in_force(BLOCKS)
    held = []
    monkeypatch.setattr(quality, "course", lambda *asked: held.append(course(*asked)) or held[-1])
    quality.closeup(work)
    corners = np.array(list(itertools.product(*box.reshape(2, 3).T)))

    def framed(camera) -> bool:
        """Whether the box takes most of a picture of 24 x 24 pixels and is hardly cut."""
        pixels, _, _ = projected(camera, corners)
        return np.ptp(pixels, axis=0).max() > 14 and pixels.min() > -2 and pixels.max() < 26

    close, whole = ([framed(camera) for camera in benchmark.cameras] for benchmark in held)
    assert all(close) and not any(whole)
    (row,) = rows_of(work, "closeup")
    assert float(row["psnr"]) > 30 and float(row["psnr of the whole"]) > 30


def test_the_chart_of_times_names_every_way(tmp_path):
    """Kinds of any name among them: none has a look of its own."""
    ways = ("blocks", "background", "scratch", "retraining")
    rows = [{"way": way, "seconds": s, "psnr": 30.0 + s} for way in ways for s in (1.0, 2.0)]
    figures.times(rows, 37.0, tmp_path / "times.svg")
    text = (tmp_path / "times.svg").read_text()
    assert all(name in text for name in ("fuse --kind blocks", "--from-scratch", "then train"))


@pytest.mark.slow
def test_times(work):
    seen = times.times(work)
    rows = rows_of(work, "times")
    assert [row["way"] for row in rows] == ["blocks", "background", "scratch", "retraining"]
    assert all(float(row["seconds"]) > 0 for row in rows) and "blocks" in seen["time"]
    assert (work.out / "times.svg").stat().st_size < 200_000


@pytest.mark.slow
def test_capacity(work, folder, monkeypatch, in_force):
    def places(work, count):
        write_scene_of(folder, *("floor", "red", "blue")[: count + 1], file=f"things_{count:02d}.json")
        return folder / f"things_{count:02d}.json"

    monkeypatch.setattr(capacity, "things_on_ground", places)
    limits = {"25MB": 25_000_000, "150kB": 150_000}
    in_force(CapacityConfig((1, 2), compared=24, frame=24, measured_at=2, limits=tuple(limits.items())))
    seen = capacity.capacity(work)
    rows = rows_of(work, "capacity")
    assert [(row["n"], row["limit"]) for row in rows] == [(n, s) for n in "12" for s in limits]
    assert all(int(row["bytes"]) <= limits[row["limit"]] for row in rows)
    assert all(int(row["fused peak bytes"]) > 1e8 for row in rows)  # of a process of its own
    assert float(seen["flat"]) > 0 and seen["naive over fused"].endswith("×")
    assert (work.out / "capacity.svg").stat().st_size < 200_000


@dataclass(frozen=True)
class Reports:
    """Commands that report what they are told to."""

    points: list[dict]

    def __call__(self, folder: Path, command: str, *words: str) -> dict:
        if command == "chart":
            for name in ("chart.csv", "chart.svg"):
                (folder / "chart").mkdir(exist_ok=True)
                (folder / "chart" / name).write_text("")
            return {"points": self.points}
        return {"bytes": 1_100_000, "total_seconds": 3.0}


def test_smallest_is_the_least_of_those_that_reach_the_psnr(work, monkeypatch):
    sizes = ((40.5, 2_000_000), (41.0, 1_000_000), (39.9, 500_000))
    points = [{"flags": "", "psnr": q, "covered": q, "bytes": b, "seconds": 1.0} for q, b in sizes]
    held = SimpleNamespace(quality=lambda path: {"psnr": 40.2, "ssim": 1.0, "covered": 38.0})
    monkeypatch.setattr(smallest, "course", lambda scene, size: held)
    monkeypatch.setattr(smallest, "fusedrf", Reports(points))
    seen = smallest.smallest(work)
    assert seen == {"picked": "1.10 (40.2 dB)", "smallest": "1 MB (41.0 dB)"}
    monkeypatch.setattr(smallest, "fusedrf", Reports(points[2:]))
    assert smallest.smallest(work)["smallest"] == "none"


def test_the_table_keeps_what_other_parts_saw(work):
    table.update(work.out, {"flat": "1.01"})
    measures, (_, own) = work.out / "measures.csv", commit_column().popitem()
    measures.write_text(measures.read_text().replace(own, "1234567"))
    table.update(work.out, {"seeds": "blocks 0.1 dB"})
    page = (work.out / "table.md").read_text()
    assert "| fused frame time at N = 8 over N = 1 | 1.00 | ≤ 1.10 | ≤ 1.02 | 1.01 | 1234567 |" in page
    assert f"| blocks 0.1 dB | {own} |" in page and page.splitlines()[2] == commit_line()


def test_pages_say_the_commit_and_its_date(tmp_path):
    if not shutil.which("git"):
        pytest.skip("needs git")
    assert commit_line(tmp_path) == "Measured in no repository." and commit_column(tmp_path) == {"commit": ""}
    who = {f"GIT_{role}_{what}": "a@b" for role in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
    dates = {"GIT_AUTHOR_DATE": "2001-02-03T04:05:06Z", "GIT_COMMITTER_DATE": "2002-03-04T05:06:07Z"}
    env = {k: v for k, v in os.environ.items() if not k.startswith("GIT_")} | who | dates
    git = ["git", "-C", str(tmp_path), "-c", "commit.gpgsign=false"]
    for words in (["init", "-q"], ["commit", "-q", "--allow-empty", "-m", "first"]):
        subprocess.run(git + words, check=True, env=env)
    short = commit_column(tmp_path)["commit"]
    said = subprocess.run([*git, "rev-parse", "HEAD"], check=True, env=env, capture_output=True, text=True)
    assert len(short) >= 7 and said.stdout.startswith(short)
    assert commit_line(tmp_path) == f"Measured at commit {short}, 2002-03-04."
    (tmp_path / "inside").mkdir()
    assert commit_line(tmp_path / "inside") == "Measured in no repository."  # of somebody else's repository


def test_seconds_to_a_psnr_lie_between_its_points(in_force):
    in_force(TimesConfig(wanted=35.0))
    rows = [{"way": "a", "seconds": s, "psnr": q} for s, q in ((40, 40.0), (10, 30.0), (2, 20.0))]
    assert times.seconds_to(rows, "a") == pytest.approx(20)  # half way, in logarithms
    assert times.seconds_to(rows[1:], "a") is None and times.seconds_to(rows[:1], "a") == 40


def test_thirty_two_things_find_places_on_the_ground():
    found = sources.places(32)
    apart = np.linalg.norm(found[:, None] - found[None], axis=-1) + 9 * np.eye(32)
    widest = 0.4 * sources.SHRUNK  # the radius of a thing
    assert apart.min() > 2 * widest and np.linalg.norm(found, axis=1).max() + widest < 2
    np.testing.assert_array_equal(sources.places(8), found[:8])


def test_a_command_that_fails_says_why(folder):
    with pytest.raises(RuntimeError, match="ranks does not apply to kind"):
        write_scene_of(folder, "floor", "red", file="fog.json", composition="add")
        fusedrf(folder, "fuse", "fog.json", "-o", "fog.rfpack", "--kind", "dense", "--ranks", "8,16")


def test_every_measure_is_somebodys():
    assert set(table.PARTS) == set(EXPERIMENTS)
