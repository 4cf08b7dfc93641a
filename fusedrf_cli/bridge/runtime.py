"""What every engine command does around its work: device, threads, and failures turned into sentences."""

import contextlib
import importlib.util
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from formats.atomic import check_writable
from formats.checkpoints import Saved, read_checkpoint, write_checkpoint
from formats.errors import OutputExists, ResourceError
from fusedrf_cli import signals
from fusedrf_cli.bridge.memory import available, peak
from fusedrf_cli.engine.rendering.volume import is_out_of_memory
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import InvalidInput, NumericFailure, ResourceProblem
from fusedrf_cli.report import readable_size


@dataclass(frozen=True)
class RuntimeConfig:
    """How often a run is saved."""

    saved_every: float = 90.0
    """Seconds from the end of one saving of a run to the next: with what saving takes, a kill loses less than
    two minutes."""


def device_for(device: str) -> str:
    """Where to compute, "cpu" or "cuda", when "auto", "cpu" or "cuda" was asked for; ResourceProblem where
    there is no such place."""
    if device == "cpu":
        return "cpu"
    if not torch.cuda.is_available():
        missing = "torch finds no GPU"
    elif importlib.util.find_spec("numba_cuda") is None:
        missing = "the compiler for GPUs is not installed (pip install 'fusedrf[gpu]')"
    else:
        return "cuda"
    if device == "cuda":
        raise ResourceProblem(f"--device cuda: {missing}; use --device cpu")
    return "cpu"


@contextlib.contextmanager
def engine(device: str, threads: int | None, progress) -> Iterator[str]:
    """Run engine work on the asked device and threads, and yield where that is, "cpu" or "cuda"; numeric and
    memory failures become sentences with an exit code.
    """
    torch_device = device_for(device)
    count, before = threads or available_cores(), torch.get_num_threads()
    signals.remains = None
    from fusedrf_cli.engine import kernels

    torch.set_num_threads(count)
    kernels.set_threads(count)
    try:
        sentence = "first use: compiling kernels, which takes up to two minutes and is kept for later runs"
        with kernels.report_compilation(lambda: progress.tell(sentence), progress.warn):
            yield torch_device
    except FloatingPointError as error:
        raise NumericFailure(
            f"the optimisation diverged: {error}; try another --seed or a lower resolution"
        ) from error
    except Exception as error:
        if is_out_of_memory(error):
            where = " of the GPU" if torch_device == "cuda" and not isinstance(error, MemoryError) else ""
            raise ResourceProblem(
                f"not enough memory{where}: {error}; {readable_size(peak())} were taken, "
                f"{readable_size(available())} are free; try a smaller --max-size or --size"
            ) from error
        raise
    finally:
        torch.set_num_threads(before)


class Uninterrupted:
    """A context to go through once per step, in which an interrupt waits for the step's end: what is saved
    then is no half of one. A second interrupt does not wait, and `torn` tells that there is nothing to save.
    Every `saved_every` seconds it is saved after a step in any case, for runs that are killed; where that
    fails, it is tried again as much later, and `failed` is called once with a sentence.
    """

    def __init__(self, save: Callable[[], object], failed: Callable[[str], None]):
        config = current(RuntimeConfig)
        self.torn, self.waiting, self.previous = False, None, {}
        self.save, self.due, self.failed = save, time.monotonic() + config.saved_every, failed

    def __call__(self) -> "Uninterrupted":
        return self

    def __enter__(self) -> "Uninterrupted":
        if threading.current_thread() is threading.main_thread():
            handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
            self.previous = {number: handler for number, handler in handlers.items() if callable(handler)}
        for number in self.previous:
            signal.signal(number, self._arrived)
        return self

    def _arrived(self, number: int, frame: object) -> None:
        if self.waiting is not None and signals.obeying():
            return
        self.torn = self.waiting is not None
        self.waiting = number
        if self.torn:
            self.previous[number](number, frame)

    def __exit__(self, kind, error, trace) -> None:
        for number, handler in self.previous.items():
            signal.signal(number, handler)
        if self.waiting is not None and kind is None:
            self.previous[self.waiting](self.waiting, None)
        if kind is None and time.monotonic() >= self.due:
            self.meanwhile()

    def meanwhile(self) -> None:
        """Save the run, which goes on whether that succeeds or not."""
        try:
            self.save()
        except (OSError, ResourceError) as error:
            self.failed(f"{error}; learning goes on, and saving its state is tried again")
            self.failed = lambda sentence: None
        self.due = time.monotonic() + current(RuntimeConfig).saved_every


@contextlib.contextmanager
def resumable(
    output: str,
    checkpoint: Callable[[], Saved],
    last_state: Callable[[], Saved | None],
    progress,
    learnt: Callable[[], bool] = bool,
) -> Iterator[Uninterrupted]:
    """Run steps inside the `Uninterrupted` that this gives; an interrupt leaves `checkpoint()` beside the
    output, or `last_state()` where a step takes too long to be waited for, and goes on its way, saying so,
    and every few minutes one is left there unasked. So is one at the end, where `learnt()`: what comes then
    may be interrupted, too."""
    steps = Uninterrupted(lambda: save_checkpoint(output, *checkpoint()), progress.warn)

    def last() -> None:
        if (saved := last_state()) is not None:
            signals.remains = saved_somewhere(output, *saved)

    signals.last = last
    try:
        yield steps
        if learnt():
            steps.meanwhile()
    except KeyboardInterrupt as interrupt:
        if not steps.torn:
            interrupt.sentence = saved_somewhere(output, *checkpoint())
        raise
    finally:
        signals.last = None


@contextlib.contextmanager
def without_interrupts(output: str) -> Iterator[None]:
    """A block that writes the output, in which an interrupt waits for its end; later ones say that the output
    is there."""
    with signals.unhurried(), Uninterrupted(lambda: None, lambda sentence: None):
        yield
        signals.remains = f"interrupted, but {output} is written whole"


def saved_somewhere(output: str, arrays: dict[str, np.ndarray], state: dict) -> str:
    """Save the state of an interrupted run beside its output, or, where that fails, in a folder for temporary
    files; what to tell of it."""
    try:
        return going_on(save_checkpoint(output, arrays, state))
    except (OSError, ResourceError) as error:
        why = error
    try:
        folder = tempfile.mkdtemp(prefix="fusedrf-saved-")
        path = save_checkpoint(os.path.join(folder, Path(output).name), arrays, state)
    except (OSError, ResourceError):
        return f"interrupted; the state of the run is lost, since {why}"
    return (
        f"interrupted; the state is in {path}, since {why}; to go on with --resume move it to "
        f"{checkpoint_path(output)}"
    )


def going_on(path: Path) -> str:
    """The sentence of an interrupted run whose state is in a file."""
    return f"interrupted; go on with --resume, the state is in {path}"


def written_somewhere(output: str, write: Callable[[str], int]) -> int:
    """What `write(path)` gives for the output. Where that cannot be written, it is written to a folder for
    temporary files, and ResourceProblem says where: what took long to learn is not lost for it."""
    try:
        return write(output)
    except (OSError, ResourceError, OutputExists) as error:
        why = error
    try:
        path = os.path.join(tempfile.mkdtemp(prefix="fusedrf-saved-"), Path(output).name)
        write(path)
    except (OSError, ResourceError):
        raise why from None
    raise ResourceProblem(f"{why}; what was made is in {path}") from why


def available_cores() -> int:
    """Cores this process may run on (the system's own count where it cannot be asked), or as many as
    OMP_NUM_THREADS allows where that says fewer: more threads than cores wait for each other."""
    n_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    requested = os.environ.get("OMP_NUM_THREADS", "")
    return min(n_cores, int(requested)) if requested.isdecimal() and int(requested) > 0 else n_cores


def checkpoint_path(output: str) -> Path:
    """Where an interrupted run towards `output` leaves its state."""
    return Path(f"{output}.checkpoint")


def check_checkpoint(output: str, resume: bool, overwrite: bool) -> None:
    """Before any work: no earlier run's checkpoint is overwritten unasked. Raises OutputExists,
    ResourceError."""
    path = checkpoint_path(output)
    if not resume and not overwrite and os.path.lexists(path):
        raise OutputExists(
            f"{path}: an interrupted run left it; go on from it with --resume, or give -w/--overwrite to "
            "begin anew"
        )
    if os.path.lexists(path):
        check_writable(path, overwrite=True)


def save_checkpoint(output: str, arrays: dict[str, np.ndarray], state: dict) -> Path:
    """Write a run's state beside its output, whole or not at all."""
    path = checkpoint_path(output)
    with signals.unhurried():
        write_checkpoint(path, arrays, state)
    signals.remains = going_on(path)
    return path


def load_checkpoint(output: str, command: str) -> Saved:
    """The state that `save_checkpoint` left for an output; InvalidInput when it is another command's. Raises
    as `read_checkpoint`."""
    path = checkpoint_path(output)
    arrays, state = read_checkpoint(path)
    if state.get("command") != command:
        raise InvalidInput(
            f"{path}: a checkpoint of '{state.get('command')}', not of '{command}'; delete it or choose "
            "another output"
        )
    return arrays, state


def take_up(run, saved: Saved, output: str) -> None:
    """Have a run go on from a saved state; InvalidInput where that is not of such a run."""
    try:
        check_alike(saved[1], run.checkpoint()[1], "its state")
        run.restore(*saved)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError) as error:
        if is_out_of_memory(error):
            raise
        raise checkpoint_mismatch(output) from error


def check_alike(saved: object, current: object, where: str) -> None:
    """Raise ValueError where a saved value is not of the kind that a run's `current` is: a word, a yes or no,
    a count, a number, a list, or an object that has all of its keys. What is not known yet in a run (None)
    may be a number. Fields check themselves (`from_state`)."""
    if isinstance(current, dict):
        alike = isinstance(saved, dict) and current.keys() <= saved.keys()
        for key in current.keys() - {"field"} if alike else ():
            check_alike(saved[key], current[key], f"{where}.{key}")
    elif isinstance(current, list | str | bool):
        alike = type(saved) is type(current)
    elif type(saved) is int:
        alike = abs(saved) <= 2**53 and not (isinstance(current, int) and saved < 0)
    else:
        alike = type(saved) is float and not isinstance(current, int) or current is None and saved is None
    if not alike:
        raise ValueError(f"{where} is {str(saved)[:40]!r}, expected the like of {str(current)[:40]!r}")


def checkpoint_mismatch(output: str) -> InvalidInput:
    """The error of a checkpoint that was made with other settings."""
    return InvalidInput(
        f"{checkpoint_path(output)}: made with other settings; repeat them, or run without --resume"
    )
