"""Ways to fuse a scene that a chart tries, from cheap to dear."""

import itertools
import math
from collections.abc import Generator
from dataclasses import dataclass, replace

from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class SweepConfig:
    """Which sizes and times a chart tries."""

    shrink: float = 1.5
    """A rung's bytes over the next one's."""
    smallest: int = 50_000
    """Bytes, below which a bundle is mostly headers."""
    sizes: tuple[int, ...] = (25_000_000, 12_000_000, 6_000_000)
    seconds: tuple[float | None, ...] = (5.0, 15.0, 45.0, None)


@dataclass(frozen=True)
class SweepPoint:
    """Keywords of `fuse` besides the kind; None is left to it."""

    precision: str | None = None
    ranks: tuple[int, int] | None = None
    sh_degree: int | None = None
    max_size: int | None = None
    finetune: bool = True
    """Whether to finish on rendered rays."""
    time_budget: float | None = None


Sweep = Generator[SweepPoint, tuple[int, float] | None, None]
"""Gives rungs, takes the bytes and the PSNR that came of them, or None where nothing did."""


def shrinking(point: SweepPoint, least_psnr: float) -> Sweep:
    """The rung as it is, then with ever fewer bytes until the PSNR falls below least_psnr."""
    config = current(SweepConfig)
    outcome, size = (yield point), math.inf
    while outcome is not None and outcome[1] >= least_psnr and min(size, outcome[0]) > config.smallest:
        size = readable_floor(min(size, outcome[0]) / config.shrink)
        outcome = yield replace(point, max_size=size)


def by_sizes() -> Sweep:
    """Few sizes; the seconds decide last, since that takes longest."""
    config = current(SweepConfig)
    for seconds, size, finetune in itertools.product(config.seconds, config.sizes, (False, True)):
        yield SweepPoint(max_size=size, finetune=finetune, time_budget=seconds)


def readable_floor(size: float) -> int:
    """The largest number of two digits and zeros that is no more than size."""
    unit = 10 ** max(0, math.floor(math.log10(size)) - 1)
    return int(size // unit) * unit
