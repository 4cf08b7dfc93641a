"""The system calls by which outputs are written: to be watched, to fail, to be killed at."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import pytest

from formats import atomic

OS_CALLS = ("open", "close", "fsync", "replace", "chmod", "posix_fallocate", "mkdir", "unlink", "rmdir")


class File:
    """A file being written, whose every write and flush is a call."""

    def __init__(self, file, before: Callable):
        self.file, self.before = file, before
        self.name, self.fileno, self.tell = file.name, file.fileno, file.tell

    def write(self, data) -> int:
        self.before("write", self.file.fileno())
        half = len(data) // 2  # so that a kill at the next call finds half of the data written
        self.file.write(data[:half])
        self.file.flush()
        self.before("write", self.file.fileno())
        return half + self.file.write(data[half:])

    def flush(self) -> None:
        self.before("flush", self.file.fileno())
        self.file.flush()

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        self.file.close()


@contextmanager
def watched(before: Callable) -> Iterator[None]:
    """In this block `before(name, *arguments)` runs ahead of each call by which `formats.atomic` writes."""
    with pytest.MonkeyPatch.context() as patch:
        for name in filter(partial(hasattr, os), OS_CALLS):
            patch.setattr(os, name, _watched(name, getattr(os, name), before))
        patch.setattr(atomic, "_exchange", _watched("exchange", atomic._exchange, before))
        real = open

        def opened(*words, **options):
            before("open", *words)
            return File(real(*words, **options), before)

        patch.setattr(atomic, "open", opened, raising=False)
        yield


def _watched(name: str, call: Callable, before: Callable) -> Callable:
    def watched(*words, **options):
        before(name, *words)
        return call(*words, **options)

    return watched


class At:
    """A `before` that acts at the k-th call (from 1) and counts on."""

    def __init__(self, k: int, act: Callable[[], None]):
        self.k, self.act, self.count = k, act, 0

    def __call__(self, name: str, *arguments) -> None:
        self.count += 1
        if self.count == self.k:
            self.act()
