"""Files that a mesh names: found beside it, as people's exporters write their names, and nowhere else."""

import os
import re
from pathlib import Path
from urllib.parse import unquote

from formats.errors import FormatError, LimitExceeded, MissingFile, OutsideFolder
from formats.names import folded
from formats.safe_input import MAX_BYTES, read_input
from formats.surfaces.lines import western, without_comment

SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")
"""One letter alone is a drive of Windows."""
LOCAL = re.compile(r"file:(?=/)", re.IGNORECASE)
ABSOLUTE = re.compile(r"[A-Za-z]:|/|\\")
MAX_NAME = 1024


class Beside:
    """Opens what a mesh or a file of splats names. Nothing above the parent of its folder is opened, links
    resolved; no absolute path, no address."""

    def __init__(self, path: Path | str):
        self.named_by, self.folder = Path(path).name, Path(path).parent
        self.root = os.path.realpath(self.folder / os.pardir)
        self.bytes_read = 0

    def read(self, name: str, *, uri: bool = False) -> tuple[bytes, str]:
        """The bytes of a named file and the name that it has.

        A `uri` is percent-decoded. Where the path is not there, its last part is looked for in the mesh's own
        folder, since paths are often those of another computer; letters may be in another case. Raises
        MissingFile, OutsideFolder, and what `read_input` raises.
        """
        path = self.find(name, uri=uri)
        data = read_input(path)
        self.bytes_read += len(data)
        if self.bytes_read > 2 * MAX_BYTES:
            raise LimitExceeded(
                f"{name}: the files that the mesh names have more than {2 * MAX_BYTES:,} bytes"
            )
        return data, path.name

    def find(self, name: str, *, uri: bool = False) -> Path:
        if len(name) > MAX_NAME:
            raise MissingFile(f"{name[:80]}…: no such file beside {self.named_by}")
        name = LOCAL.sub("", name)
        if SCHEME.match(name):
            raise OutsideFolder(
                f"{name}: an address, and only files beside {self.named_by} are read; put it there"
            )
        if uri:
            spellings = dict.fromkeys([unquote(name), name, unquote(re.split("[?#]", name)[0])])
        else:
            spellings = dict.fromkeys([name, western(name), without_comment(name)])
        refused = None
        for spelling in spellings:
            parts = [part for part in re.split(r"[\\/]+", spelling) if part not in ("", ".")]
            if not parts or any("\0" in part for part in parts):
                continue
            tries = [parts[-1:]] if ABSOLUTE.match(spelling) else [parts, parts[-1:]]
            for attempt in tries:
                try:
                    path = self._match(attempt)
                except FormatError as error:
                    refused = error
                    continue
                if path is not None:
                    return path
        raise refused or MissingFile(
            f"{name}: no such file beside {self.named_by}; put it into {self.folder}"
        )

    def _match(self, parts: list[str]) -> Path | None:
        """The file of a path relative to the folder, each part exact or else in another case."""
        where = self.folder
        for part in parts:
            there = where / part
            if part == os.pardir:
                where = there
                self._check(where)
                continue
            if not os.path.lexists(there):
                same = [entry for entry in _entries(where) if folded(entry) == folded(part)]
                if not same:
                    return None
                there = where / min(same)
            where = there
        self._check(where)
        return where

    def _check(self, path: Path) -> None:
        real = os.path.realpath(path)
        if os.path.commonpath([real, self.root]) != self.root:
            raise OutsideFolder(f"{path}: lies outside of {self.root}; put it beside {self.named_by}")


def _entries(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError:
        return []
