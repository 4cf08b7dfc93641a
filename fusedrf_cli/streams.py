"""Standard streams that the caller closed: their numbers are taken, so that no file gets them, and what
belongs there is not lost in silence."""

import contextlib
import errno
import io
import os
import sys


class Closed(io.TextIOBase):
    """Standard output that is closed: writing to it fails with a sentence."""

    encoding = "utf-8"

    def write(self, text: str) -> int:
        if text:
            raise OSError(errno.EBADF, "standard output is closed, and the result goes there")
        return 0

    def fileno(self) -> int:
        return 1


def hold() -> None:
    """Put something in the place of every standard stream that is closed: nothing to read, a loss of what is
    said on stderr, an error for what is printed."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, which is this one
            os.set_inheritable(number, True)
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)  # noqa: SIM115  (for as long as the process lives)
    if sys.stdout is None:
        sys.stdout = Closed()
    if sys.stderr is None:
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115


def nowhere() -> bool:
    """Whether nobody can get what is printed."""
    return isinstance(sys.stdout, Closed)


def seal() -> None:
    """Keep the interpreter's last flush from failing again, which would print an error and exit with 120."""
    for number, stream in ((1, sys.stdout), (2, sys.stderr)):
        try:
            stream.flush()
        except OSError:
            with contextlib.suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), number)
        except (AttributeError, ValueError):
            pass  # there is none, or it was closed
