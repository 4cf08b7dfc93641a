"""Films: frames come back in number, size and colour, and a film that fails leaves nothing."""

import contextlib
import itertools
import subprocess
import sys
import types

import numpy as np
import pytest
from PIL import Image

from formats.errors import BadImage, MissingExtra, NoViews
from formats.video import check_film, write_film

LEVELS = (0, 64, 128, 192, 255)
PATCH = 16
"""Pixels a side of a patch of one colour: a block of the encoder."""
CODING = 8
"""Of 255: what compression may change in the middle of a patch. The wrong matrix is off by 40."""


def frames(n: int, size=(12, 9)):
    for i in range(n):
        yield np.full((*size, 3), 25 * i, np.uint8)


def test_gif(tmp_path):
    write_film(tmp_path / "f.gif", frames(5), 25)
    with Image.open(tmp_path / "f.gif") as film:
        assert (film.n_frames, film.size, film.info["loop"], film.info["duration"]) == (5, (9, 12), 0, 40)
        film.seek(4)
        assert film.convert("RGB").getpixel((3, 3)) == (100, 100, 100)


def test_film_of_nothing(tmp_path):
    with pytest.raises(NoViews):
        write_film(tmp_path / "f.gif", iter([]), 25)
    assert not list(tmp_path.iterdir())


def test_a_film_that_fails_leaves_nothing(tmp_path):
    def failing():
        yield from frames(2)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_film(tmp_path / "f.gif", failing(), 25)
    assert not list(tmp_path.iterdir())


def test_unknown_film(tmp_path):
    with pytest.raises(BadImage, match=r"\.gif or \.mp4"):
        check_film(tmp_path / "f.avi")


def test_mp4_without_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtra) as caught:
        write_film(tmp_path / "f.mp4", frames(2), 25)
    assert 'pip install "fusedrf[video]"' in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_ffmpeg_is_asked_to_convert_and_tag_by_bt709(tmp_path, monkeypatch):
    """The command line alone, which can be checked where ffmpeg is not installed."""
    asked = {}

    @contextlib.contextmanager
    def writer(path, *_, **options):
        asked.update(options)
        with open(path, "wb") as file:
            yield types.SimpleNamespace(append_data=lambda frame: file.write(frame.tobytes()))

    monkeypatch.setattr("formats.video.find_spec", lambda name: name == "imageio_ffmpeg")
    monkeypatch.setattr("imageio.v2.get_writer", writer)
    write_film(tmp_path / "f.mp4", frames(2, (3, 5)), 12)
    assert (asked["fps"], asked["macro_block_size"]) == (12, 1)
    options = dict(zip(asked["output_params"][::2], asked["output_params"][1::2], strict=True))
    assert options["-f"] == "mp4" and options["-movflags"] == "+faststart"
    scale, tags = options["-vf"].split(",")
    assert {"out_color_matrix=bt709", "out_range=tv"} <= set(scale.removeprefix("scale=").split(":"))
    assert set(tags.removeprefix("setparams=").split(":")) == {
        *("colorspace=bt709", "color_primaries=bt709", "color_trc=bt709", "range=tv")
    }
    assert (tmp_path / "f.mp4").read_bytes() == bytes(6 * 4 * 3) + bytes([25]) * (6 * 4 * 3)


@pytest.fixture
def ffmpeg():
    return pytest.importorskip("imageio_ffmpeg", reason="needs the extra [video]")


# imageio-ffmpeg leaves its pipes to the garbage collector.
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_mp4(tmp_path, ffmpeg):
    write_film(tmp_path / "f.mp4", frames(6, (33, 47)), 12)
    reader = ffmpeg.read_frames(str(tmp_path / "f.mp4"))
    about = next(reader)
    assert (about["size"], about["fps"], sum(1 for _ in reader)) == ((48, 34), 12, 6)


def patches() -> tuple[np.ndarray, np.ndarray]:
    """(10, 13, 3) 125 colours and the first five again, and a picture with a patch of each."""
    colours = np.array(list(itertools.product(LEVELS, repeat=3)), np.uint8)
    rows = np.resize(colours, (10, 13, 3))
    return rows, rows.repeat(PATCH, 0).repeat(PATCH, 1)


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("reader", ["null", "scale=in_color_matrix=bt709:in_range=tv"])
def test_mp4_has_the_colours_of_its_frames(tmp_path, ffmpeg, reader):
    """For a player that honours the tags and for one that assumes BT.709 whatever they say."""
    colours, picture = patches()
    write_film(tmp_path / "f.mp4", [picture] * 3, 25)
    raw = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-")
    decode = [ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(tmp_path / "f.mp4"), "-vf", reader, *raw]
    data = subprocess.run(decode, capture_output=True, check=True).stdout
    film = np.frombuffer(data, np.uint8).reshape(3, 10, PATCH, 13, PATCH, 3).astype(int)
    middle = film[:, :, PATCH // 4 : -PATCH // 4, :, PATCH // 4 : -PATCH // 4]
    assert abs(middle - colours[:, None, :, None].astype(int)).max() <= CODING


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_mp4_says_its_colours_and_starts_at_once(tmp_path, ffmpeg):
    write_film(tmp_path / "f.mp4", frames(3, (32, 48)), 25)
    said = subprocess.run(
        [ffmpeg.get_ffmpeg_exe(), "-i", str(tmp_path / "f.mp4")], capture_output=True, text=True
    )
    assert "yuv420p(tv, bt709, progressive)" in said.stderr  # one name: matrix, primaries and transfer
    data = (tmp_path / "f.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")
