"""Checkpoints of interrupted runs: arrays and a state, under one checksum over every byte.

    MAGIC · length of the header (8 bytes, little-endian) · header · arrays, one after the other · SHA-256

The header is JSON: the version, the state, and of each array its name, type and shape. The SHA-256 is of all
that comes before it, so that a file that was cut short or changed is known as such before anything in it is
believed.
"""

import hashlib
import json
import math
import os
import re
from pathlib import Path
from typing import BinaryIO

import numpy as np

from formats.atomic import atomic_writer
from formats.errors import BadHeader, ChecksumMismatch, MissingFile, NewerVersion, NotAFile, OlderVersion

Saved = tuple[dict[str, np.ndarray], dict]
"""Arrays and JSON-able state of an interrupted run."""
MAGIC = b"fusedrf checkpoint\n"
VERSION = 3
DIGEST_BYTES = 32
MAX_HEADER_BYTES = 1 << 26
MAX_DIMENSIONS = 8
DTYPE = re.compile(r"[<|][biuf][1248]")
AT_ONCE_BYTES = 1 << 20
REMEDY = "delete it and run without --resume"


def write_checkpoint(path: Path | str, arrays: dict[str, np.ndarray], state: dict) -> None:
    """Write a run's state whole or not at all, without another copy of its arrays. Raises ResourceError."""
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    listed = [[name, array.dtype.str, array.shape] for name, array in arrays.items()]
    text = json.dumps({"version": VERSION, "state": state, "arrays": listed}, sort_keys=True).encode()
    start = MAGIC + len(text).to_bytes(8, "little") + text
    size = len(start) + sum(array.nbytes for array in arrays.values()) + DIGEST_BYTES
    with atomic_writer(path, reserve=size) as file:
        digest = hashlib.sha256()
        for part in (start, *(array.reshape(-1).view(np.uint8).data for array in arrays.values())):
            digest.update(part)
            file.write(part)
        file.write(digest.digest())


def read_checkpoint(path: Path | str) -> Saved:
    """What `write_checkpoint` wrote. Raises MissingFile, NotAFile, BadHeader, ChecksumMismatch, OlderVersion,
    NewerVersion."""
    if not os.path.isfile(path):
        if os.path.lexists(path):
            raise NotAFile(f"{path}: not a file, expected a checkpoint; {REMEDY}")
        raise MissingFile(f"{path}: no checkpoint to resume from; run without --resume")
    with open(path, "rb") as file:
        covered = _checked(path, file)
        length = int.from_bytes(file.read(8), "little")
        if length > min(MAX_HEADER_BYTES, covered - file.tell()):
            raise BadHeader(f"{path}: not a readable checkpoint, its header has {length:,} bytes; {REMEDY}")
        try:
            header = json.loads(file.read(length))
            if (version := header["version"]) != VERSION:
                older = type(version) is int and version < VERSION
                raise (OlderVersion if older else NewerVersion)(
                    f"{path}: a checkpoint of version {version}, and this fusedrf reads {VERSION}; go on "
                    f"with the fusedrf that wrote it, or {REMEDY}"
                )
            state, listed = header["state"], _listed(header["arrays"], covered - file.tell())
            if not isinstance(state, dict):
                raise ValueError("its state is no object")
        except (ValueError, TypeError, LookupError, RecursionError) as error:
            raise BadHeader(f"{path}: not a readable checkpoint ({error}); {REMEDY}") from error
        return {n: np.fromfile(file, t, math.prod(shape)).reshape(shape) for n, t, shape in listed}, state


def _checked(path: Path | str, file: BinaryIO) -> int:
    """How many bytes the checksum covers, once all of them were looked at; the file stands behind MAGIC."""
    covered = os.fstat(file.fileno()).st_size - DIGEST_BYTES
    start = file.read(len(MAGIC))
    if start != MAGIC:
        if start[8:10] == b'{"':  # a safetensors file, as checkpoints were before
            raise OlderVersion(
                f"{path}: a checkpoint of an earlier fusedrf, which has no checksum; go on with that one, or "
                f"{REMEDY}"
            )
        raise BadHeader(f"{path}: not a readable checkpoint, it begins as none does; {REMEDY}")
    digest, left = hashlib.sha256(start), covered - len(start)
    while left > 0 and (data := file.read(min(AT_ONCE_BYTES, left))):
        digest.update(data)
        left -= len(data)
    if left or file.read() != digest.digest():
        raise ChecksumMismatch(f"{path}: this checkpoint was damaged or cut short; {REMEDY}")
    file.seek(len(MAGIC))
    return covered


def _listed(arrays: list, room: int) -> list[tuple[str, np.dtype, tuple[int, ...]]]:
    """Names, types and shapes of arrays that fill `room` bytes; ValueError where they do not."""
    listed = []
    for name, dtype, shape in arrays:
        if not isinstance(name, str) or not DTYPE.fullmatch(dtype) or len(shape) > MAX_DIMENSIONS:
            raise ValueError("an array without name, type or shape")
        if not all(type(count) is int and count >= 0 for count in shape):
            raise ValueError(f"array {name!r} has no shape")
        listed.append((name, np.dtype(dtype), tuple(shape)))
    if (needed := sum(math.prod(shape) * dtype.itemsize for _, dtype, shape in listed)) != room:
        raise ValueError(f"its arrays take {needed:,} bytes, and {room:,} are there")
    return listed
