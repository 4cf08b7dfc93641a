"""Untrusted input: regular files are opened safely, and JSON is read strictly."""

import errno
import json
import math
import os
import stat
from pathlib import Path
from typing import BinaryIO

from formats.errors import BadJson, LimitExceeded, MissingFile, NotAFile, ResourceError

MAX_BYTES = 2**31  # of a file that is read at once
MAX_INTEGER = 2**63 - 1
# Commas and opening brackets of a document, and its colons: what bounds the time and memory of parsing it.
MAX_VALUES = 500_000
MAX_KEYS = 200_000
# A scene of 64 levels has 130; recursion over a document of this many is safe.
MAX_NESTING = 200


def open_input(path: Path | str) -> BinaryIO:
    """A regular file opened for reading; never waits on a pipe or reads a device.

    Raises MissingFile, NotAFile, or ResourceError where permission is missing.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0))
    except PermissionError as error:
        raise ResourceError(f"{path}: no permission to read it; check the file's mode") from error
    except (OSError, ValueError) as error:
        raise _unopened(path, error) from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise NotAFile(f"{path}: expected a regular file, found a folder, pipe or device")
    return os.fdopen(descriptor, "rb")


def _unopened(path: Path | str, error: Exception) -> Exception:
    if not str(path):
        return MissingFile("the path is empty; give that of a file")
    if isinstance(error, ValueError) or error.errno in (errno.ENOENT, errno.ENOTDIR, errno.ENAMETOOLONG):
        return MissingFile(f"{path}: no such file; check the spelling and the folder it is relative to")
    if error.errno in (errno.EISDIR, errno.ENXIO, errno.ELOOP):
        return NotAFile(f"{path}: expected a regular file, found a folder, pipe or endless link")
    return ResourceError(f"{path}: cannot be read ({error.strerror})")


def read_input(path: Path | str, limit: int = MAX_BYTES) -> bytes:
    """All bytes of a regular file; LimitExceeded, from its size alone, where it holds more than `limit`."""
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise LimitExceeded(f"{path}: has {size:,} bytes, but at most {limit:,} are read")
        return file.read(size)  # and not of `limit`, which would be allocated first


def decoded(data: bytes, errors: str = "strict") -> str:
    """Text of a file: UTF-8, or as the byte-order mark says that it begins with. Raises UnicodeDecodeError
    unless `errors` are replaced."""
    if data.startswith((b"\xff\xfe\0\0", b"\0\0\xfe\xff")):
        return data.decode("utf-32", errors)
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors)
    return data.decode("utf-8-sig", errors)


def parse_json(data: bytes, where: str):
    """Strict JSON: UTF-8, no duplicate keys, finite numbers, integers below 2^63; BadJson otherwise.

    Raises LimitExceeded, before parsing, where parsing would take more than about a second.
    """
    data = bytes(data)
    values, keys = sum(map(data.count, (b",", b"[", b"{"))), data.count(b":")
    if values > MAX_VALUES or keys > MAX_KEYS:
        raise LimitExceeded(
            f"{where}: JSON of about {values:,} values and {keys:,} keys, but at most {MAX_VALUES:,} and "
            f"{MAX_KEYS:,} are read"
        )
    try:
        content = json.loads(
            data.decode("utf-8"),
            object_pairs_hook=_unique,
            parse_float=_finite,
            parse_int=_bounded,
            parse_constant=_refuse,
        )
    except RecursionError as error:
        raise BadJson(f"{where}: JSON is nested too deep to be read") from error
    except ValueError as error:
        raise BadJson(f"{where}: not strict JSON: {error}") from error
    if _nesting(content) > MAX_NESTING:
        raise BadJson(f"{where}: JSON is nested deeper than {MAX_NESTING} levels")
    return content


def _nesting(content: object) -> int:
    """Levels of lists and objects, without recursion."""
    level, depth = [content], 0
    while level := [value for value in level if isinstance(value, dict | list)]:
        depth += 1
        level = [inner for value in level for inner in (value.values() if isinstance(value, dict) else value)]
    return depth


def _unique(pairs: list[tuple[str, object]]) -> dict:
    content = {}
    for key, value in pairs:
        if key in content:
            raise ValueError(f"key {key[:40]!r} appears twice in one object")
        _encodable(key)
        _encodable(value)
        content[key] = value
    return content


def _encodable(text: object) -> None:
    if isinstance(text, list):
        for item in text:
            _encodable(item)
    elif isinstance(text, str) and not text.isascii():
        try:
            text.encode()
        except UnicodeEncodeError:
            raise ValueError(f"{text[:40]!r} holds half of a surrogate pair") from None


def _finite(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(f"number {digits[:40]} is beyond the range of 64-bit floats")
    return value


def _bounded(digits: str) -> int:
    if len(digits) > 20 or abs(int(digits)) > MAX_INTEGER:
        raise ValueError(f"integer {digits[:40]} is beyond 64 bits")
    return int(digits)


def _refuse(name: str) -> None:
    raise ValueError(f"{name} is not a JSON number")
