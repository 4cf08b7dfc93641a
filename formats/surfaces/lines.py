"""Text of meshes: its lines, and numbers in them."""

import re
import warnings
from collections.abc import Sequence

import numpy as np

COMMENT = re.compile(r"^ *#[^\r\n]*|(?<=\r) *#[^\r\n]*", re.MULTILINE)
CONTINUED = re.compile(r"\\ *(\r\n|\n|\r)")


def lines_of(data: bytes) -> list[str]:
    """Lines without marks, comments and outer spaces; a backslash at the end goes on in the next, but for
    comments, which may end in a folder of Windows."""
    text = data.removeprefix(b"\xef\xbb\xbf").decode("utf-8", "surrogateescape").replace("\t", " ")
    if "\\" in text:
        text = CONTINUED.sub(" ", COMMENT.sub("", text))
    stripped = (line.strip() for line in re.split(r"\r\n|\n|\r", text))
    return [line for line in stripped if line and line[0] != "#"]


def numbers_in(text: str, kind: type = np.float64) -> np.ndarray:
    """All numbers of a text, between spaces. Raises ValueError where something else is there."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, kind, sep=" ")
        except (DeprecationWarning, ValueError):
            word = next((word for word in text.split() if not _is_number(word)), text)
            raise ValueError(f"{word[:40]!r} in place of a number") from None


def table(lines: Sequence[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All numbers of lines, and (n,) how many each line has and where they begin. Raises ValueError."""
    widths = np.array([len(line.split()) for line in lines], np.int64)
    numbers = numbers_in(" ".join(lines))
    if len(numbers) != widths.sum():
        raise ValueError("words that are no numbers")
    return numbers, widths, np.cumsum(widths) - widths


def within(counts: np.ndarray) -> np.ndarray:
    """(sum of counts,) 0, 1, ... in each group of so many."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)


def western(name: str) -> str:
    """Bytes that are no UTF-8 taken for the letters of Windows."""
    if name.isascii() or not any("\ud800" <= letter <= "\udfff" for letter in name):
        return name
    return name.encode("utf-8", "surrogateescape").decode("cp1252", "replace")


def without_comment(text: str) -> str:
    """A name without quotes and what follows " #"; names may hold that and are tried as written first."""
    return text.partition(" #")[0].strip().strip('"')


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
