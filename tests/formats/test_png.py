"""PNG by rows: Pillow reads back what was written, whatever pieces it came in."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from formats.errors import ResourceError
from formats.png import depth_png_writer, png_writer

RANDOM = np.random.default_rng(0)
SIZES = [(1, 1), (1, 40), (40, 1), (7, 13), (4097, 3), (3, 4097)]


def smooth(width: int, height: int, channels: int) -> np.ndarray:
    """A picture with edges, ramps and some noise, so that every filter is the best one somewhere."""
    y, x = np.mgrid[:height, :width]
    ramps = np.stack([3 * x + y, 5 * y, np.where(x > y, 200, 10), x * y][:channels], -1)
    ramps[height // 2 :] += RANDOM.integers(0, 255, ramps[height // 2 :].shape)
    return (ramps % 256).astype(np.uint8)


@pytest.mark.parametrize("channels, mode", [(1, "L"), (3, "RGB"), (4, "RGBA")])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("rows", [1, 5, 10_000])
def test_rows_in_any_pieces_are_the_picture(tmp_path, size, channels, mode, rows):
    pixels = smooth(*size, channels)
    with png_writer(tmp_path / "a.png", *size, channels) as write:
        for top in range(0, size[1], rows):
            write(pixels[top : top + rows])
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.mode == mode and picture.size == size
        assert np.array_equal(np.array(picture).reshape(pixels.shape), pixels)


def test_a_picture_is_not_much_larger_than_pillows(tmp_path):
    pixels = smooth(300, 400, 3)
    with png_writer(tmp_path / "a.png", 300, 400, 3) as write:
        write(pixels)
    Image.fromarray(pixels).save(tmp_path / "b.png")
    assert (tmp_path / "a.png").stat().st_size < 1.1 * (tmp_path / "b.png").stat().st_size


@pytest.mark.parametrize("rows", [(2,), (2, 2, 2)])
def test_too_few_or_too_many_rows_leave_nothing(tmp_path, rows):
    with pytest.raises(ValueError, match="missing"), png_writer(tmp_path / "a.png", 4, 5, 3) as write:
        for count in rows:
            write(np.zeros((count, 4, 3), np.uint8))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("rows", [np.zeros((2, 3, 3), np.uint8), np.zeros((2, 4, 3), np.uint16)])
def test_rows_that_do_not_fit_are_refused(tmp_path, rows):
    with pytest.raises(ValueError, match="should be"), png_writer(tmp_path / "a.png", 4, 5, 3) as write:
        write(rows)
    assert not list(tmp_path.iterdir())


def test_no_folder_is_a_sentence(tmp_path):
    with pytest.raises((ResourceError, FileNotFoundError)), png_writer(tmp_path / "no" / "a.png", 4, 5, 3):
        pass


def written_depth(path: Path, depth: np.ndarray, rows: int = 2) -> dict:
    with depth_png_writer(path, *depth.shape[::-1]) as (add, report):
        for top in range(0, len(depth), rows):
            add(depth[top : top + rows])
    return report


def test_depth_round_trip(tmp_path):
    depth = RANDOM.uniform(0.01, 9, (5, 7))
    depth[0, :4] = [0, np.inf, np.nan, 1e-9]
    report = written_depth(tmp_path / "d.png", depth)
    with Image.open(tmp_path / "d.png") as picture:
        levels, text = np.array(picture), picture.text["depth"]
    back = levels * report["scale"]
    assert levels[0, :3].tolist() == [0, 0, 0]
    assert levels[0, 3] == 1  # something is there, however near
    assert np.abs(back[1:] - depth[1:]).max() <= report["scale"] * 0.51
    assert repr(report["scale"]) in text
    assert report["scale"] == depth[1:].max() / 65535 or report["scale"] == depth[0, 4:].max() / 65535


def test_depth_of_nothing(tmp_path):
    assert written_depth(tmp_path / "d.png", np.zeros((2, 2)))["scale"] > 0
    with Image.open(tmp_path / "d.png") as picture:
        assert not np.array(picture).any()


def test_an_interrupted_depth_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), depth_png_writer(tmp_path / "d.png", 4, 4) as (add, _):
        add(np.ones((2, 4)))
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


HUGE = """
import resource, sys, numpy as np
from formats.png import png_writer
import zlib
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
side, band = 16384, np.random.default_rng(0).integers(0, 256, (16, 16384, 4), np.uint8)
with png_writer(sys.argv[1], side, side, 4) as write:
    for _ in range(side // 16):
        write(band)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.slow
def test_a_gigapixel_is_written_in_the_memory_of_a_band(tmp_path):
    """268 million pixels, a gigabyte of them, by a process that grows by less than a tenth of that."""
    words = [sys.executable, "-c", HUGE, str(tmp_path / "a.png")]
    grown = subprocess.run(words, check=True, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert int(grown.stdout) < 100_000 * (1 if sys.platform != "darwin" else 1024)  # KiB, but bytes on macOS
