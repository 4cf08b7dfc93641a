"""The outer layer of a bundle: a ZIP of stored, aligned members, every byte fixed by names and contents.

A reader takes names, sizes and checksums from the directory, builds the headers that follow from them, and
compares these with the file byte by byte. So no data can be hidden between members, and any ZIP tool can
still list and extract them.
"""

import contextlib
import hashlib
import mmap
import os
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from formats.errors import (
    BadHeader,
    ChecksumMismatch,
    LimitExceeded,
    NotABundle,
    ResourceError,
    TruncatedBundle,
)
from formats.other_files import HEAD, not_a_bundle
from formats.safe_input import open_input

ALIGNMENT = 64
MAX_ARCHIVE = 2**32 - 2
MAX_MEMBERS = 10_001
MAGIC = b"PK\x03\x04"
NAME = re.compile(rb"[a-z0-9_]+(?:[/.\-][a-z0-9_]+){0,8}")
# "rf" as a little-endian id of the extra field that holds the padding.
PADDING_ID = 0x6672
# 1980-01-01, the earliest day a ZIP can state: no time of day reaches the bytes.
DATE = 0x0021
EXTRACT_VERSION = 20
LOCAL = struct.Struct("<4sHHHHHIIIHH")
CENTRAL = struct.Struct("<4sHHHHHHIIIHHHHHII")
END = struct.Struct("<4sHHHHIIH")
EXTRA = struct.Struct("<HH")
PIECE = 16 << 20  # bytes of a member that are looked at before their pages are given back
REWRITTEN = "the file is damaged, or another tool packed it: write it with fusedrf"


@dataclass(frozen=True)
class Member:
    """One stored member: `offset` is where its local header begins, `crc` its CRC-32, `size` in bytes."""

    name: bytes
    crc: int
    size: int
    offset: int

    def local_header(self) -> bytes:
        padding = _padding(self.offset + LOCAL.size + len(self.name))
        lengths = (self.size, self.size, len(self.name), len(padding))
        return LOCAL.pack(MAGIC, EXTRACT_VERSION, 0, 0, 0, DATE, self.crc, *lengths) + self.name + padding

    def central_header(self) -> bytes:
        versions = (b"PK\x01\x02", EXTRACT_VERSION, EXTRACT_VERSION)
        lengths = (self.size, self.size, len(self.name), 0, 0)
        return CENTRAL.pack(*versions, 0, 0, 0, DATE, self.crc, *lengths, 0, 0, 0, self.offset) + self.name

    @property
    def start(self) -> int:
        """Where the data begins: a multiple of 64."""
        position = self.offset + LOCAL.size + len(self.name)
        return position + len(_padding(position))

    @property
    def stop(self) -> int:
        return self.start + self.size


def write_archive(file: BinaryIO, members: Iterable[tuple[str, bytes]]) -> None:
    """Write `members` to `file` in the given order, holding one at a time in memory. Raises LimitExceeded at
    4 GiB."""
    directory, offset = [], 0
    for name, data in members:
        member = Member(name.encode("ascii"), zlib.crc32(data), len(data), offset)
        if member.stop > MAX_ARCHIVE:
            raise LimitExceeded(f"member {name}: the bundle would pass 4 GiB; fuse with a smaller --max-size")
        file.write(member.local_header())
        file.write(data)
        directory.append(member)
        offset = member.stop
    file.write(_directory(directory, offset))


def read_archive(path: Path | str, *, verify: bool = True) -> dict[str, memoryview]:
    """The members of a bundle, memory-mapped, in order; structure always checked, CRCs with `verify`. They
    stay those of the file that was opened, whatever takes its name later.

    Raises MissingFile, NotAFile, NotABundle, TruncatedBundle, BadHeader, ChecksumMismatch, LimitExceeded.
    """
    allow_files()
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        head = file.read(HEAD)
        magic = head[: len(MAGIC)]
        if (other := not_a_bundle(Path(path), head)) is not None:
            raise other
        if magic != MAGIC:
            raise NotABundle(f"{path}: begins with {magic!r}, expected an .rfpack bundle ({MAGIC!r})")
        if size > MAX_ARCHIVE:
            raise LimitExceeded(f"{path}: has {size:,} bytes, but a bundle is smaller than 4 GiB")
        try:
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except OSError as error:
            raise ResourceError(f"{path}: cannot be mapped ({error.strerror})") from error
    return parse_archive(memoryview(data), str(path), verify=verify)


def pieces(data: bytes | memoryview) -> Iterator[bytes | memoryview]:
    """Bytes of a member piece by piece, so that no more of a large file is in memory at once."""
    for start in range(0, len(data), PIECE):
        yield data[start : start + PIECE]
        give_back(data)


def sha256_of_bytes(data: bytes | memoryview) -> str:
    """Hex SHA-256, a piece after the other."""
    digest = hashlib.sha256()
    for piece in pieces(data):
        digest.update(piece)
    return digest.hexdigest()


def give_back(data: bytes | memoryview) -> None:
    """Let go of the pages of the file that members are mapped from: they are read again where they are asked
    for again."""
    mapping = data.obj if isinstance(data, memoryview) else None
    if isinstance(mapping, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        mapping.madvise(mmap.MADV_DONTNEED)


def allow_files() -> None:
    """Allow this process as many open files as the system lets it: every bundle of a scene stays open."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        if soft != hard:
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def parse_archive(data: memoryview, where: str, *, verify: bool = True) -> dict[str, memoryview]:
    """The members of a bundle's bytes, as views of `data`; as `read_archive`."""
    if bytes(data[: len(MAGIC)]) != MAGIC:
        raise NotABundle(f"{where}: begins with {bytes(data[:4])!r}, expected an .rfpack bundle ({MAGIC!r})")
    members, stop = _members(data, where)
    for member in members:
        if data[member.offset : member.start] != member.local_header():
            raise BadHeader(f"{where}: member {_text(member)} contradicts the directory; {REWRITTEN}")
    if data[stop:] != _directory(members, stop):
        raise BadHeader(f"{where}: its ZIP directory is not laid out as a bundle's; {REWRITTEN}")
    views = {_text(member): data[member.start : member.stop] for member in members}
    if verify:
        for member in members:
            crc = 0
            for piece in pieces(views[_text(member)]):
                crc = zlib.crc32(piece, crc)
            if crc != member.crc:
                raise ChecksumMismatch(f"{where}: member {_text(member)} is damaged (CRC-32); copy it again")
    return views


def _members(data: memoryview, where: str) -> tuple[list[Member], int]:
    """The members that the directory lists, with offsets recomputed, and where the directory begins."""
    end = data[-END.size :]
    if len(data) < END.size or end[:4] != b"PK\x05\x06":
        raise TruncatedBundle(f"{where}: has no ZIP end record: cut short or appended to; copy it again")
    count, length, begin = END.unpack(end)[4:7]
    if not 0 < count <= MAX_MEMBERS:
        raise LimitExceeded(f"{where}: has {count:,} members, expected 1 to {MAX_MEMBERS:,}")
    if begin + length + END.size != len(data):
        expected = begin + length + END.size
        raise TruncatedBundle(
            f"{where}: has {len(data):,} bytes, but its end record says {expected:,}; copy it again"
        )
    members, at, offset = [], begin, 0
    for _ in range(count):
        member = _member(data[at : at + CENTRAL.size + 256], offset, where)
        members.append(member)
        at, offset = at + CENTRAL.size + len(member.name), member.stop
        if offset > begin:
            raise TruncatedBundle(f"{where}: member {_text(member)} reaches past the directory; {REWRITTEN}")
    if len({member.name for member in members}) != count:
        raise BadHeader(f"{where}: a member's name appears twice; {REWRITTEN}")
    if offset != begin:
        raise BadHeader(f"{where}: {begin - offset} stray bytes before its directory; {REWRITTEN}")
    return members, begin


def _member(entry: memoryview, offset: int, where: str) -> Member:
    if len(entry) < CENTRAL.size:
        raise TruncatedBundle(f"{where}: its ZIP directory is cut short; copy the file again")
    fields = CENTRAL.unpack(entry[: CENTRAL.size])
    name = bytes(entry[CENTRAL.size : CENTRAL.size + fields[10]])
    if not NAME.fullmatch(name) or len(name) > 255:
        raise BadHeader(f"{where}: member name {name[:80]!r} is not allowed in a bundle; {REWRITTEN}")
    if fields[4] != 0:
        raise BadHeader(f"{where}: member {name.decode()} is compressed, expected stored; {REWRITTEN}")
    return Member(name, fields[7], fields[9], offset)


def _directory(members: list[Member], begin: int) -> bytes:
    headers = b"".join(member.central_header() for member in members)
    return headers + END.pack(b"PK\x05\x06", 0, 0, len(members), len(members), len(headers), begin, 0)


def _padding(position: int) -> bytes:
    """The extra field that moves data at `position` to a multiple of 64; empty where it is at one."""
    missing = -position % ALIGNMENT
    if missing == 0:
        return b""
    length = missing if missing >= EXTRA.size else missing + ALIGNMENT
    return EXTRA.pack(PADDING_ID, length - EXTRA.size) + bytes(length - EXTRA.size)


def _text(member: Member) -> str:
    return member.name.decode()
