"""Settings in force: frozen dataclasses, one for each noun, with their defaults and the reasons for them.

What a caller chooses is a parameter. Numbers that a method rests on, which no caller in between has a say in,
are fields of such a dataclass; a verb's `settings`, or `using`, puts others in force for a block.
"""

import contextlib
import functools
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from types import MappingProxyType
from typing import Any, TypeVar

Settings = TypeVar("Settings")

_in_force: ContextVar[Mapping[type, Any]] = ContextVar("settings", default=MappingProxyType({}))


def current(kind: type[Settings]) -> Settings:
    """The settings of a dataclass that are in force: its defaults where nothing else was said."""
    return _in_force.get().get(kind) or _defaults(kind)


@functools.cache
def _defaults(kind: type[Settings]) -> Settings:
    return kind()


@contextlib.contextmanager
def using(*settings: Any) -> Iterator[None]:
    """A block in which these settings, at most one of each dataclass, are in force beside those before."""
    token = _in_force.set({**_in_force.get(), **{type(one): one for one in settings}})
    try:
        yield
    finally:
        _in_force.reset(token)
