"""Lines and numbers of the text files of a COLMAP model."""

import math
import re
from collections.abc import Iterator
from pathlib import Path

from formats.errors import BadModel
from formats.safe_input import decoded

LINE_ENDS = re.compile(r"\r\n?|\n")


def check_count(path: Path, count: int, length: int, smallest: int) -> None:
    if count > length // smallest:
        raise BadModel(f"{path}: {count:,} records do not fit into {length:,} bytes; copy or export it again")


def numbered_lines(path: Path, data: bytes) -> Iterator[tuple[int, str]]:
    """Number and text of each line that is not a comment."""
    for i, line in enumerate(LINE_ENDS.split(decoded(data, "replace")), 1):
        text = line.strip()
        if not text.startswith("#"):
            yield i, text


def pose_number(path: Path, line: int, word: str) -> float:
    """A number of a pose, which may be NaN: its image alone is then of no use."""
    return math.nan if word.lower().lstrip("+-") in ("nan", "inf") else number(path, line, word, float)


def number(path: Path, line: int, word: str, kind: type):
    try:
        value = float(word) if len(word) < 40 else math.nan
        value = int(word) if kind is int and word.lstrip("+-").isdecimal() and len(word) < 40 else value
    except ValueError:
        value = math.nan
    if not abs(value) < 1e30 or kind is int and value != int(value):
        points = "; write decimals with a point" if "," in word else ""
        what = "a whole number" if kind is int else "a number"
        raise BadModel(f"{path}: line {line}: found {word[:40]!r}, expected {what}{points}")
    return kind(value)
