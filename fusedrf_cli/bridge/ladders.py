"""Ways to fuse a scene, from cheap to dear: flags of `fusedrf fuse` in the order in which they are tried."""

import itertools
import math
from collections.abc import Generator

Flags = tuple[str, ...]
Ladder = Generator[Flags, tuple[int, float] | None, None]
"""Gives flags, takes the bytes and the PSNR that came of them, or None where they are not to be had."""

SHRINK = 1.5  # a rung's --max-size over the next one's
SMALLEST = 50_000  # bytes, below which a bundle is mostly headers
PRECISIONS = ("int8", "float16", "int4")
RANKS = ((), ("--ranks", "8,24"), ("--ranks", "8,16"))
DEGREES = ("1", "0")
SPARSE_SIZES = ("1MB", "3MB", "8MB")
FINISHED = ("int8", "int4")  # what was finished at 16 bits is surpassed by twice the numbers at 8
VM_SIZES = ("25MB", "12MB", "6MB")
VM_BUDGETS = (("--time-budget", "5"), ("--time-budget", "15"), ("--time-budget", "45"), ())


def ladders(kind: str, least_psnr: float) -> dict[str, list[Ladder]]:
    """The ladders of a kind, in groups that take about as long; those that learn nothing come first."""
    if kind == "vm":
        return {"vm": [distilled()]}
    if kind == "sparse":
        return {"sparse": [bricks()]}
    plain = [("--precision", p, *m, "--no-rgb") for m, p in itertools.product(RANKS, PRECISIONS)]
    finished = [("--precision", p, *m) for m, p in itertools.product(RANKS, FINISHED)]
    groups = {kind: plain, f"{kind}, finished": finished}
    return {
        name: [shrinking(("--kind", kind, *flags), least_psnr) for flags in found]
        for name, found in groups.items()
    }


def shrinking(flags: Flags, least_psnr: float) -> Ladder:
    """The flags as they are, then under an ever smaller --max-size until the PSNR falls below least_psnr."""
    found, size = (yield flags), math.inf
    while found is not None and found[1] >= least_psnr and min(size, found[0]) > SMALLEST:
        size = readable_floor(min(size, found[0]) / SHRINK)
        found = yield (*flags, "--max-size", in_words(size))


def distilled() -> Ladder:
    """One tensor over the scene: the steps decide last, since that takes longest."""
    for budget, size, rgb in itertools.product(VM_BUDGETS, VM_SIZES, (("--no-rgb",), ())):
        yield ("--kind", "vm", "--max-size", size, *rgb, *budget)


def bricks() -> Ladder:
    """From few bricks to more, since many take minutes."""
    for rgb, size, degree in itertools.product((("--no-rgb",), ()), SPARSE_SIZES, DEGREES):
        yield ("--kind", "sparse", "--precision", "int8", "--sh-degree", degree, "--max-size", size, *rgb)


def readable_floor(size: float) -> int:
    """The largest number of two digits and zeros that is no more than size."""
    unit = 10 ** max(0, math.floor(math.log10(size)) - 1)
    return int(size // unit) * unit


def in_words(size: int) -> str:
    """Bytes as --max-size takes them: 12MB, 8.1MB or 950kB."""
    return f"{size / 1e6:g}MB" if size >= 1_000_000 else f"{size / 1e3:g}kB"
