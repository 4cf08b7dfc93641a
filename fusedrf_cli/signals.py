"""SIGINT and SIGTERM: raised in the main thread as `Interrupted`; and where that thread does not come to its
end, since a compiled loop or a library has it, the process is ended within seconds all the same."""

import contextlib
import os
import select
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from formats.atomic import remove_unfinished
from formats.errors import printable
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import Interrupted


@dataclass(frozen=True)
class SignalConfig:
    """How long a process may take to end."""

    patience: float = 2.5
    """Seconds that it may take by itself."""
    echo: float = 0.3
    """Seconds in which a second signal is the same one: `timeout` sends to a process and then to its
    group."""


_obeying = False
_raised: int | None = None
"""The signal that was raised in the main thread."""
_saving = 0
"""How many are in `unhurried` now."""
_said = False
"""Whether the sentence about the interrupt is out."""
last: Callable[[], object] | None = None
"""What saves the work where the main thread cannot. It is called from another thread, while compiled code may
run, and so must not run any."""
_calm = 0.0
"""When the last saving ended."""
remains: str | None = None
"""The sentence of an interrupt that says nothing itself: what it leaves."""


def obey() -> None:
    """Have SIGINT and SIGTERM end this process, but for one that its caller ignores (as under nohup)."""
    global _obeying
    _obeying = True
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, interrupt)
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(reader, current(SignalConfig)), daemon=True).start()


def interrupt(number: int, frame: object) -> None:
    """The handler of both signals."""
    global _raised
    if not (_obeying and _raised):
        _raised = number
        raise Interrupted(number)


def raised() -> Interrupted | None:
    """The interrupt of this process, if there was one. A library that it broke off, such as a compiler, may
    end with an error of its own."""
    return Interrupted(_raised) if _raised else None


def obeying() -> bool:
    """Whether a second signal needs nobody's doing: it ends this process, or is an echo."""
    return _obeying


def leave() -> None:
    """The command is over: from here on a signal ends the process as it does by default, but where one has
    done so already."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is interrupt:
            signal.signal(number, signal.SIG_IGN if _raised else signal.SIG_DFL)


@contextlib.contextmanager
def unhurried() -> Iterator[None]:
    """In this block what was learnt is being saved: a first signal does not end the process before its end, a
    second one does."""
    global _saving, _calm
    _saving += 1
    try:
        yield
    finally:
        _saving -= 1
        _calm = time.monotonic()


def said() -> None:
    """The sentence about an interrupt is on its way, and needs no other one."""
    global _said
    _said = True


def _watch(reader: int, config: SignalConfig) -> None:
    """Wait for a signal, and then for the process's end, a second signal or the end of patience."""
    number = _next(reader, None)
    first = time.monotonic()
    while True:
        left = max(first + config.patience, _calm + 1) - time.monotonic()
        if _next(reader, max(left, 0.1)) is None:
            if left <= 0 and not _saving:
                break
        elif time.monotonic() - first > config.echo:
            break
    _end(number)


def _next(reader: int, seconds: float | None) -> int | None:
    """The number of the next signal of ours that comes within some seconds."""
    while select.select([reader], [], [], seconds)[0]:
        number = os.read(reader, 1)[0]
        if number in (signal.SIGINT, signal.SIGTERM):
            return number
    return None


def _end(number: int) -> None:
    """End the process as it is, without the temporary files that it was writing."""
    remove_unfinished()
    if last is not None:
        with contextlib.suppress(Exception):
            last()
    if not _said:
        with contextlib.suppress(OSError):
            os.write(2, f"Error: {printable(remains or 'interrupted')}\n".encode())
    os._exit(128 + number)
