"""Names of files that a command makes of other names: no two are one file, on whatever disk."""

import os
import unicodedata
from collections.abc import Sequence
from pathlib import Path

from formats.names import MAX_NAME_BYTES

DEPTH = "_depth"
"""What the name of a depth picture has behind that of its picture."""


def depth_of(picture: Path) -> Path:
    """The path of the depth that belongs to a picture."""
    return picture.with_name(f"{picture.stem}{DEPTH}.png")


def distinct(names: Sequence[str], endings: Sequence[str] = ("",)) -> list[str]:
    """The names, or others like them, so that no two, each with every one of the endings, are the same to a
    file system that knows no case, or that writes an accented letter in one of two ways."""
    used: set[str] = set()
    unique = []
    for name in names:
        short = os.fsencode(name)[:MAX_NAME_BYTES].decode("utf-8", "ignore")
        chosen, count = short, 1
        while used & (spellings := {folded(chosen + ending) for ending in endings}):
            count += 1
            chosen = f"{short}-{count}"
        used |= spellings
        unique.append(chosen)
    return unique


def folded(name: str) -> str:
    """One spelling of all that are the same to some file system."""
    return unicodedata.normalize("NFKC", unicodedata.normalize("NFKD", name).casefold())
