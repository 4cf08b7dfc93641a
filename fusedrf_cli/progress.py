"""A command's progress on stderr: a live line on a terminal, one final line anywhere else."""

import contextlib
import sys
import time

import click

from formats.errors import printable


class NullProgress:
    """Shows nothing, but keeps the warnings; for use as a library."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def phase(self, name: str, total: float | None = None) -> None:
        """Begin a phase, which ends the one before. `total` is what `advance` counts up to; None: unknown."""

    def advance(self, done: float, **figures: float) -> None:
        """`done` of the phase's total (absolute, not a step); `figures`, such as psnr=31.2, go beside it."""

    def warn(self, text: str) -> None:
        """One line that people should see; the JSON report carries it as well."""
        self.warnings.append(text)

    def tell(self, text: str) -> None:
        """One line that explains why the command waits."""

    def note(self, text: str) -> None:
        """One line for those who asked for more (-v)."""

    def close(self) -> None:
        """End the last phase. Closing twice is closing once."""

    def __enter__(self) -> "NullProgress":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class Progress(NullProgress):
    """Progress on stderr. `live` draws a bar with the time left, on a terminal; None: where stderr is one."""

    def __init__(self, *, quiet: bool = False, verbose: bool = False, live: bool | None = None):
        super().__init__()
        self._quiet, self._verbose = quiet, verbose
        self._live = not quiet and (sys.stderr.isatty() if live is None else live)
        self._bar = self._task = None
        self._started: list[tuple[str, float]] = []

    def phase(self, name: str, total: float | None = None) -> None:
        self._started.append((name, time.monotonic()))
        if self._live:
            self._draw(name, total)

    def advance(self, done: float, **figures: float) -> None:
        if self._bar is not None:
            shown = "  ".join(f"{key} {value:.4g}" for key, value in figures.items())
            self._bar.update(self._task, completed=done, figures=shown)

    def warn(self, text: str) -> None:
        super().warn(text)
        self._say(f"Warning: {text}")

    def tell(self, text: str) -> None:
        if not self._quiet:
            self._say(text)

    def note(self, text: str) -> None:
        if self._verbose:
            self._say(text)

    def close(self) -> None:
        self._stop()
        if self._started and not self._quiet:
            self._say(self._summary())
        self._started = []

    def __exit__(self, kind: object, *exception: object) -> None:
        if kind is not None:  # an error follows, so the command is not done
            self._started = []
        self.close()

    def _say(self, text: str) -> None:
        if self._bar is not None:
            self._bar.console.print(printable(text), markup=False, highlight=False, soft_wrap=True)
        else:
            with contextlib.suppress(OSError):  # a full or closed stderr is no reason to lose the work
                click.echo(printable(text), err=True)

    def _summary(self) -> str:
        names, starts = zip(*self._started, strict=True)
        seconds: dict[str, float] = {}
        for name, start, end in zip(names, starts, (*starts[1:], time.monotonic()), strict=True):
            seconds[name] = seconds.get(name, 0.0) + end - start
        parts = ", ".join(f"{name} {spent:.1f} s" for name, spent in seconds.items())
        return f"done in {sum(seconds.values()):.1f} s ({parts})"

    def _draw(self, name: str, total: float | None) -> None:
        if self._bar is None:
            self._bar = _bar()
            self._bar.start()
        if self._task is not None:
            self._bar.remove_task(self._task)
        self._task = self._bar.add_task(printable(name), total=total, figures="")

    def _stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
        self._bar = self._task = None


def _bar():
    """A rich bar; rich is imported here because a pipe or `--help` never needs it."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=30),
        TaskProgressColumn(),
        TimeRemainingColumn(compact=True),
        TextColumn("{task.fields[figures]}", markup=False),
        console=Console(stderr=True),
        refresh_per_second=4,
        transient=True,
    )
