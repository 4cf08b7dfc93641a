"""Arrays in large pages of memory: a field's numbers are read in random order, and with pages of 4 kB most
reads would have to look for their page first. They go back to the system as soon as they are let go."""

import mmap

import torch

LARGE = 1 << 20  # bytes from which an array gets them
ADVICE = getattr(mmap, "MADV_HUGEPAGE", None)  # of Linux


def zeros(
    count: int,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
    advice: int | None = ADVICE,
) -> torch.Tensor:
    """(count,) zeros; large arrays of the CPU lie in large pages by `advice`, if there is any. In private
    memory: most systems keep what processes could share, which is Python's default, in small pages."""
    size = count * dtype.itemsize
    if advice is None or size < LARGE or torch.device(device).type != "cpu":
        return torch.zeros(count, dtype=dtype, device=device)
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    try:
        memory.madvise(advice)
    except OSError:  # a system that was built without them
        return torch.zeros(count, dtype=dtype)
    return torch.frombuffer(memory, dtype=dtype, count=count)
