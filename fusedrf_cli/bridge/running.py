"""What every engine command does around its work: device, threads, and failures turned into sentences."""

import contextlib
import importlib.util
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open

from formats.atomic import atomic_writer
from fusedrf_cli.bridge.memory import available, peak
from fusedrf_cli.engine.rendering.volume import is_out_of_memory
from fusedrf_cli.errors import InvalidInput, NumericFailure, ResourceProblem
from fusedrf_cli.report import readable_size

Saved = tuple[dict[str, np.ndarray], dict]
"""Arrays and JSON-able state of an interrupted run."""
SAVED_EVERY = 150.0
"""Seconds of a run that a kill can lose."""
FIRST_USE = "first use: compiling kernels, which takes up to two minutes and is kept for later runs"


def place_for(device: str) -> str:
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
    place = place_for(device)
    count, before = threads or available_cores(), torch.get_num_threads()
    from fusedrf_cli.engine import kernels

    torch.set_num_threads(count)
    kernels.set_threads(count)
    try:
        with kernels.telling_of_compilation(lambda: progress.tell(FIRST_USE), progress.warn):
            yield place
    except FloatingPointError as error:
        raise NumericFailure(
            f"the optimisation diverged: {error}; try another --seed or a lower resolution"
        ) from error
    except Exception as error:
        if is_out_of_memory(error):
            where = " of the GPU" if place == "cuda" and not isinstance(error, MemoryError) else ""
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
    Every SAVED_EVERY seconds it is saved after a step in any case, for runs that are killed.
    """

    def __init__(self, save: Callable[[], object]):
        self.torn, self.waiting, self.previous = False, None, {}
        self.save, self.due = save, time.monotonic() + SAVED_EVERY

    def __call__(self) -> "Uninterrupted":
        return self

    def __enter__(self) -> "Uninterrupted":
        if threading.current_thread() is threading.main_thread():
            found = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
            self.previous = {number: handler for number, handler in found.items() if callable(handler)}
        for number in self.previous:
            signal.signal(number, self._arrived)
        return self

    def _arrived(self, number: int, frame: object) -> None:
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
            self.save()
            self.due = time.monotonic() + SAVED_EVERY


@contextlib.contextmanager
def resumable(output: str, checkpoint) -> Iterator[Uninterrupted]:
    """Run steps inside the `Uninterrupted` that this gives; an interrupt leaves `checkpoint()` beside the
    output and goes on its way, saying so, and every few minutes one is left there unasked."""
    steps = Uninterrupted(lambda: save_checkpoint(output, *checkpoint()))
    try:
        yield steps
    except KeyboardInterrupt as interrupt:
        if not steps.torn:
            path = save_checkpoint(output, *checkpoint())
            interrupt.sentence = f"interrupted; go on with --resume, the state is in {path}"
        raise


def available_cores() -> int:
    """Cores this process may run on (the system's own count where it cannot be asked), or as many as
    OMP_NUM_THREADS allows where that says fewer: more threads than cores wait for each other."""
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return min(own, int(asked)) if asked.isdecimal() and int(asked) > 0 else own


def checkpoint_path(output: str) -> Path:
    """Where an interrupted run towards `output` leaves its state."""
    return Path(f"{output}.checkpoint")


def save_checkpoint(output: str, arrays: dict[str, np.ndarray], state: dict) -> Path:
    """Write a run's state beside its output, whole or not at all."""
    path = checkpoint_path(output)
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    size = sum(array.nbytes for array in arrays.values())
    with atomic_writer(path, reserve=size) as file:
        file.write(checkpoint_header(arrays, {"fusedrf": json.dumps(state, sort_keys=True)}))
        for array in arrays.values():
            file.write(array.reshape(-1).view(np.uint8).data)
    return path


def checkpoint_header(arrays: dict[str, np.ndarray], metadata: dict[str, str]) -> bytes:
    """What a safetensors file begins with that holds arrays one after the other. The library would make bytes
    of all of them first, twice: of a place's field and moments 0.6 GB."""
    told, end = {"__metadata__": metadata}, 0
    for name, array in arrays.items():
        start, end = end, end + array.nbytes
        dtype = array.dtype.kind.upper() + str(8 * array.dtype.itemsize)
        told[name] = {"dtype": dtype, "shape": list(array.shape), "data_offsets": [start, end]}
    text = json.dumps(told).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text


def load_checkpoint(output: str, command: str) -> tuple[dict[str, np.ndarray], dict]:
    """The state that `save_checkpoint` left for an output; InvalidInput when there is none or it is another
    command's.
    """
    path = checkpoint_path(output)
    if not path.exists():
        raise InvalidInput(f"{path}: no checkpoint to resume from; run without --resume")
    try:
        with safe_open(path, "numpy") as file:
            state = json.loads((file.metadata() or {}).get("fusedrf", "{}"))
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  (no mapping)
        if not isinstance(state, dict):
            raise ValueError("its state is no object")
    except Exception as error:
        raise InvalidInput(
            f"{path}: not a readable checkpoint ({error}); delete it and run without --resume"
        ) from error
    if state.get("command") != command:
        raise InvalidInput(
            f"{path}: a checkpoint of '{state.get('command')}', not of '{command}'; delete it or choose "
            "another output"
        )
    return arrays, state


def checkpoint_mismatch(output: str) -> InvalidInput:
    """The error of a checkpoint that was made with other settings."""
    return InvalidInput(
        f"{checkpoint_path(output)}: made with other settings; repeat them, or run without --resume"
    )
