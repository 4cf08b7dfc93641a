"""Films: frames of 8-bit sRGB to GIF and MP4, whole or not at all."""

import itertools
import os
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from formats.atomic import atomic_writer
from formats.errors import BadImage, MissingExtra, NoViews

FILMS = (".gif", ".mp4")
"""The endings of names under which films are written."""
BT709 = (
    "scale=out_color_matrix=bt709:out_range=tv:flags=bicubic+accurate_rnd+full_chroma_int",
    "setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=tv",
)
"""ffmpeg's filters that convert RGB to YUV by BT.709 and say so in the film. Without them it converts by
BT.601 and says nothing, and most players then take it for BT.709."""
MP4_OPTIONS = ("-f", "mp4", "-vf", ",".join(BT709), "-movflags", "+faststart")
"""The format is named because the temporary's name does not end in .mp4; `faststart` moves the index to the
front, so that a browser can play the film while it is still loading."""


def check_film(path: Path | str) -> None:
    """Before any work: can a film of this name be written here? Raises BadImage or MissingExtra."""
    if Path(path).suffix.lower() not in FILMS:
        raise BadImage(f"{path}: a film is written as .gif or .mp4; choose a name that ends so")
    if Path(path).suffix.lower() == ".mp4" and not find_spec("imageio_ffmpeg"):
        raise MissingExtra(f'{path}: films as .mp4 need an extra: pip install "fusedrf[video]"')


def write_film(path: Path | str, frames: Iterable[np.ndarray], fps: float) -> None:
    """Frames (H, W, 3) uint8 of one size, taken one at a time, to a .gif (looping) or .mp4.

    GIF counts in hundredths of a second, so frames last as near to 1/fps as those allow. An odd side of an
    .mp4 gets its last row or column twice. Raises BadImage, MissingExtra, NoViews, ResourceError.
    """
    check_film(path)
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise NoViews(f"{path}: a film needs at least one frame")
    write = _write_gif if Path(path).suffix.lower() == ".gif" else _write_mp4
    with atomic_writer(path) as file:
        write(path, file, itertools.chain([first], frames), fps)


def _write_gif(path: Path | str, file, frames: Iterator[np.ndarray], fps: float) -> None:
    from PIL import Image

    pictures = (Image.fromarray(frame).quantize(256, dither=Image.Dither.FLOYDSTEINBERG) for frame in frames)
    duration = 10 * max(1, round(100 / fps))
    next(pictures).save(file, "GIF", save_all=True, append_images=pictures, duration=duration, loop=0)


def _write_mp4(path: Path | str, file, frames: Iterator[np.ndarray], fps: float) -> None:
    from imageio import v2

    how = {"quality": 5, "macro_block_size": 1, "ffmpeg_log_level": "warning"}
    with v2.get_writer(file.name, ".mp4", "I", fps=fps, output_params=[*MP4_OPTIONS], **how) as writer:
        for f in frames:
            writer.append_data(np.pad(f, ((0, f.shape[0] % 2), (0, f.shape[1] % 2), (0, 0)), mode="edge"))
    if os.path.getsize(file.name) == 0:
        raise BadImage(f"{path}: ffmpeg wrote nothing; try a .gif")
