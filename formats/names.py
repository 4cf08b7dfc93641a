"""Names of cameras, under which their pictures are written: they come from files of anyone's making."""

import unicodedata
from collections.abc import Iterable

MAX_NAME_BYTES = 200
"""A picture is written under the name of its camera, with an ending: file systems end at 255."""
SHORT = 40


def is_name(name: str) -> bool:
    """Whether a picture can be written under it everywhere."""
    return name.isprintable() and not set(name) & set("/\\") and 0 < len(name.encode()) <= MAX_NAME_BYTES


def folded(name: str) -> str:
    """Equal for names that differ in the case of letters, or in how accents are put together."""
    return unicodedata.normalize("NFC", name).casefold()


def distinct_names(names: Iterable[str]) -> list[str]:
    """The names, or ones that are allowed and different where theirs are not: with the place in the list."""
    used: dict[str, None] = {}
    for number, name in enumerate(names):
        plain = "".join(c if c.isprintable() and c not in "/\\" else "_" for c in name)
        allowed = plain if is_name(plain) else f"{plain[:SHORT]}_{number:05d}"
        while allowed in used:  # ends: each turn counts on
            allowed, number = f"{plain[:SHORT]}_{number:05d}", number + 1
        used[allowed] = None
    return list(used)
