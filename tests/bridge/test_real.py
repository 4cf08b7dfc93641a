"""`make bench-real`, made small: what it writes can be read, and other captures' rows stay."""

import csv
import json
import shutil
import sys

import numpy as np
import pytest

from benchmarks import edits, placed, real, spoiled
from benchmarks.real import RealConfig
from formats.captures import hold_out, read_capture
from formats.images import read_image, read_image_header, write_png
from fusedrf_cli.bridge.pictures import over_white
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
    assert "![wall](wall.jpg)" in (out / "table.md").read_text() and (out / "psnr.svg").exists()
    assert real.kept_rows(out / "real.csv", "capture", {"wall"}) == []
    kept = real.kept_rows(out / "real.csv", "capture", {"fox"})
    assert [row["capture"] for row in kept] == ["wall", "wall"]


@pytest.mark.slow
def test_the_table_of_spoiled_captures(data, monkeypatch, capsys):
    """Held-out photos and their poses stay as they are, the others do not."""
    seen = []

    def watched(folder, name, seconds, *words):
        capture = hold_out(read_capture(folder), spoiled.EVERY)
        seen.append((name, capture, over_white(np.stack([read_image(v.image_path) for v in capture.train]))))
        return row(folder, name, seconds, *words)

    row = spoiled.row
    monkeypatch.setattr(spoiled, "row", watched)
    monkeypatch.setattr(sys, "argv", ["spoiled", str(data / "wall"), "--seconds", "1"])
    spoiled.main()
    assert [len(line.split("|")) for line in capsys.readouterr().out.strip().splitlines()] == [7] * 7
    (_, whole, pixels), *_, (_, moved, _) = seen
    assert not np.allclose(pixels, seen[2][2]) and np.array_equal(pixels, seen[3][2])
    for one, other in zip(whole.train, moved.train, strict=True):
        assert 0 < abs(one.camera_to_world - other.camera_to_world).max() < 2
    for one, other in zip(whole.test, moved.test, strict=True):
        assert np.array_equal(one.camera_to_world, other.camera_to_world)


@pytest.mark.slow
def test_the_page_of_edits(folder, tmp_path, monkeypatch, in_force):
    """Of two solids in place of the captures; what was measured once is not measured again."""
    for name, solid in (("chair", "red"), ("fuze", "blue")):
        shutil.copy(folder / f"{solid}.rfpack", folder / f"{name}.rfpack")
    out = tmp_path / "real"
    out.mkdir()
    small = {"side": 40, "views": 2, "shuffled": 3, "photos": 6, "photo_side": 32, "edits": 20, "refit": "2"}
    kinds = ("blocks", 4), ("sparse", 4)
    in_force(edits.Edits(**small, points=2000, repeats=1, objects=kinds))
    monkeypatch.setattr(sys, "argv", ["edits", str(folder), "--out", str(out), "--keep", str(folder)])
    edits.main()
    found = json.loads((out / "edits.json").read_text())
    assert found["long"]["edits"] == 20 and found["long"]["bundles kept"] == 20
    for kind in ("blocks", "sparse"):
        row, along = found[kind]
        assert [count for count, _ in along] == [1, 2, 3, 4] and row["outside"].startswith("0;")
        assert row["shuffled"] == "identical" or kind == "sparse"
    monkeypatch.setattr(edits, "fused", None)
    edits.write_page(out, {"sparse": edits.row(folder, "sparse")})
    assert json.loads((out / "edits.json").read_text()) == found
    assert "![PSNR along additions](edits.svg)" in (out / "edits.md").read_text()


def test_rows_of_kinds_that_are_not_measured_stay(tmp_path):
    placed.write_page(tmp_path, [{"kind": "sparse", "MB": "1"}, {"kind": "vm", "MB": "2"}])
    placed.write_page(tmp_path, [{"kind": "blocks", "MB": "3"}, {"kind": "vm", "MB": "4"}])
    page = (tmp_path / "placed.md").read_text()
    assert "| blocks | 3 |\n| vm | 4 |\n| sparse | 1 |" in page
