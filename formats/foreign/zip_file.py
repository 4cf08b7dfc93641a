"""Members of a ZIP archive, read one by one when they are asked for, with sizes checked before allocation."""

import os
import struct
import zipfile
import zlib
from pathlib import Path
from typing import BinaryIO, NamedTuple

from formats.errors import BadCheckpoint, ChecksumMismatch, LimitExceeded
from formats.safe_input import open_input

MAGIC = b"PK\x03\x04"
MAX_DIRECTORY = 8 << 20
"""Bytes of a directory: 100,000 members."""
MAX_RATIO = 250
"""How often larger than its bytes in the file a member may become, beyond FREE bytes."""
FREE = 64 << 20
MOST_READ = 64
"""How often as much as all members unpack to may be read: tensors share what they are stored in."""
LOCAL = struct.Struct("<4s22xHH")
DAMAGED = (
    zipfile.BadZipFile,
    NotImplementedError,
    ValueError,
    struct.error,
    OverflowError,
    LookupError,
    OSError,
)


class Member(NamedTuple):
    """Where a member lies: its local header begins at `offset`, `packed` bytes unpack to `size`."""

    offset: int
    packed: int
    size: int
    crc: int
    deflated: bool


class Archive:
    """The directory of a ZIP archive: `members` by name, in the file's order."""

    def __init__(self, path: Path | str):
        """Raises MissingFile, NotAFile, ResourceError, BadCheckpoint, LimitExceeded."""
        self.path = path
        with open_input(path) as file:
            try:
                entries = zipfile.ZipFile(_Guarded(file, path)).infolist()
            except DAMAGED as error:
                raise BadCheckpoint(f"{path}: not a whole ZIP archive ({error}); copy it again") from error
            size = os.fstat(file.fileno()).st_size
        self.members: dict[str, Member] = {}
        for entry in entries:
            name = entry.filename
            if name in self.members:
                raise BadCheckpoint(f"{path}: member {name} is there twice; write it again")
            if entry.flag_bits & 1 or entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise BadCheckpoint(
                    f"{path}: member {name} is encrypted or packed in an unusual way; repack it"
                )
            deflated = entry.compress_type == zipfile.ZIP_DEFLATED
            packed = entry.compress_size
            reaches = not 0 <= entry.header_offset <= size - LOCAL.size - packed
            if reaches or not deflated and packed != entry.file_size:
                raise BadCheckpoint(f"{path}: member {name} does not fit the file; copy it again")
            if deflated and entry.file_size > max(FREE, MAX_RATIO * packed):
                raise LimitExceeded(
                    f"{path}: member {name} has {packed:,} bytes and says that it unpacks to "
                    f"{entry.file_size:,}, which is more than is believed"
                )
            self.members[name] = Member(entry.header_offset, packed, entry.file_size, entry.CRC, deflated)
        self.bytes_left = MOST_READ * sum(member.size for member in self.members.values())

    def read(self, name: str) -> bytes | bytearray:
        """All bytes of a member. Raises BadCheckpoint, ChecksumMismatch, LimitExceeded."""
        member = self.members[name]
        self.bytes_left -= member.size
        if self.bytes_left < 0:
            raise LimitExceeded(f"{self.path}: what it holds uses member {name} and others over and over")
        with open_input(self.path) as file:
            data = self._data(file, name, member)
        if member.deflated:
            data = self._inflated(data, name, member)
        if zlib.crc32(data) != member.crc:
            raise ChecksumMismatch(f"{self.path}: member {name} is damaged (CRC-32); copy the file again")
        return data

    def start(self, name: str, count: int) -> bytes | bytearray:
        """The first `count` bytes of a member, unchecked. Raises BadCheckpoint."""
        member = self.members[name]
        with open_input(self.path) as file:
            data = self._data(file, name, member._replace(packed=min(count, member.packed)))
        try:
            return zlib.decompressobj(-15).decompress(data, count) if member.deflated else data
        except zlib.error as error:
            raise BadCheckpoint(f"{self.path}: member {name} is damaged ({error}); copy it again") from error

    def _data(self, file: BinaryIO, name: str, member: Member) -> bytearray:
        file.seek(member.offset)
        header = file.read(LOCAL.size)
        data = bytearray(member.packed)
        if len(header) == LOCAL.size and (fields := LOCAL.unpack(header))[0] == MAGIC:
            file.seek(fields[1] + fields[2], os.SEEK_CUR)
            if file.readinto(data) == len(data):
                return data
        raise BadCheckpoint(
            f"{self.path}: member {name} is cut short or its header is damaged; copy it again"
        )

    def _inflated(self, data: bytearray, name: str, member: Member) -> bytes:
        unpacker = zlib.decompressobj(-15)
        try:
            unpacked = unpacker.decompress(data, member.size + 1)
        except zlib.error as error:
            raise BadCheckpoint(f"{self.path}: member {name} is damaged ({error}); copy it again") from error
        if len(unpacked) != member.size or not unpacker.eof or unpacker.unused_data:
            raise BadCheckpoint(f"{self.path}: member {name} does not unpack to its {member.size:,} bytes")
        return unpacked


class _Guarded:
    """What zipfile reads of a file, but for a directory of an unreasonable size."""

    def __init__(self, file: BinaryIO, path: Path | str):
        self.seek, self.tell, self._read, self._path = file.seek, file.tell, file.read, path

    def read(self, count: int = -1) -> bytes:
        if count > MAX_DIRECTORY:
            raise LimitExceeded(f"{self._path}: its ZIP directory has {count:,} bytes, more than is read")
        return self._read(count)
