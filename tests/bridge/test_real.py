"""`make bench-real`, made small: what it writes can be read, and other captures' rows stay."""

import csv
import json
import shutil
import sys

import numpy as np
import pytest

from benchmarks import extraction, placed, real
from benchmarks.commit import commit_line
from benchmarks.real import RealConfig
from formats.images import read_image_header, write_png
from tests.formats.test_captures import looking_at


@pytest.fixture
def data(tmp_path):
    """A folder with a capture of noise, one of rendered pictures, photos without poses, and no capture."""
    for name in ("wall", "nothing", "loose"):
        (tmp_path / "data" / name).mkdir(parents=True)
    frames = []
    for i in range(9):
        eye = np.array([4 * np.cos(i), 4 * np.sin(i), 1.0])
        pixels = np.random.default_rng(i).integers(0, 256, (16, 24, 3), np.uint8)
        write_png(tmp_path / f"data/wall/{i}.png", pixels)
        write_png(tmp_path / f"data/loose/{i}.png", pixels)
        frames.append({"file_path": f"{i}.png", "transform_matrix": looking_at(eye, np.zeros(3)), "fl_x": 20})
    (tmp_path / "data/wall/transforms.json").write_text(json.dumps({"frames": frames}))
    return tmp_path / "data"


@pytest.mark.slow
def test_the_page(data, shop, tmp_path, monkeypatch, in_force):
    shutil.copytree(shop / "photos", data / "made")
    out = tmp_path / "real"
    in_force(RealConfig(others=(1.0, 2.0), frame_width=24))
    monkeypatch.setattr(sys, "argv", ["real", str(data), "--out", str(out), "--share", "0.5"])
    real.main()
    with (out / "real.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["capture"], row["minutes"]) for row in rows] == [("wall", "0.008333"), ("wall", "0.01667")]
    assert all(float(row["nearest photo"]) < 12 and float(row["seconds"]) > 0.5 for row in rows)
    assert read_image_header(out / "wall.jpg")[:2] == (640, 213)
    page = (out / "table.md").read_text()
    assert "![wall](wall.jpg)" in page and (out / "psnr.svg").exists()
    assert page.splitlines()[2] == commit_line()
    assert real.stored_rows(out / "real.csv", "capture", {"wall"}) == []
    kept = real.stored_rows(out / "real.csv", "capture", {"fox"})
    assert [row["capture"] for row in kept] == ["wall", "wall"]


def test_rows_of_kinds_that_are_not_measured_stay(tmp_path):
    placed.write_page(tmp_path, [{"kind": "sparse", "MB": "1"}, {"kind": "vm", "MB": "2"}])
    placed.write_page(tmp_path, [{"kind": "blocks", "MB": "3"}, {"kind": "vm", "MB": "4"}])
    page = (tmp_path / "placed.md").read_text()
    assert "| blocks | 3 |\n| vm | 4 |\n| sparse | 1 |" in page
    assert page.splitlines()[2] == commit_line()


def test_parts_of_extraction_that_are_not_measured_stay(tmp_path):
    extraction.write_page(tmp_path, {"cup": [{"what": "cup", "commit": "1234567"}]})
    extraction.write_page(tmp_path, {"tankard": [{"what": "tankard", "commit": "89abcde"}]})
    page = (tmp_path / "extraction.md").read_text()
    assert "| tankard | 89abcde |\n| cup | 1234567 |" in page and page.splitlines()[2] == commit_line()
