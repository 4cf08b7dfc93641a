"""No more than a scene needs: which of many ways to store a field is the best under a size, or the smallest
that reaches a PSNR.

What is tried is made, stored and read back, and its pictures are measured: nothing here is predicted.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache

from fusedrf_cli.engine.kinds.student import Way
from fusedrf_cli.engine.settings import current
from fusedrf_cli.report import readable_size


@dataclass(frozen=True)
class SearchConfig:
    """How sizes and ways are searched for the best."""

    db_per_e_fold: float = 8.0
    """dB that PSNR gains about when the bytes grow by e: only the next guess rests on it."""
    close: float = 1.08
    """Between the smallest size that reaches the target and the largest that does not."""
    most_growth: float = 3.0
    """From one size that is tried to the next."""
    overshoot: float = 0.1
    """dB aimed above a target, so that the next try is likely to reach it."""
    neighbour: float = 1.3
    """Ratio of bytes at which the next larger and smaller choice is looked at."""
    tries: int = 8
    """Sizes of one way."""
    finalists: int = 3
    """Ways that are finished where a size is given; the others are judged as they are."""


def flags(kind: str, way: Way, limit: int) -> str:
    """The flags of `fuse` that take a way of a kind to a size (bytes)."""
    words = [f"--kind {kind}", f"--precision {way.precision}"]
    words += [f"--ranks {way.ranks[0]},{way.ranks[1]}"] if way.ranks is not None else []
    words += [f"--sh-degree {way.sh_degree}"] if way.sh_degree is not None else []
    return " ".join([*words, f"--max-size {limit}"])


@dataclass(frozen=True)
class Tried:
    """What a way gave at a size."""

    way: Way
    limit: int
    """Bytes that were allowed."""
    bytes: int
    psnr: float
    """dB, of the field as it will be read back."""
    before: float
    """PSNR before finishing on rays."""
    whole: bool
    """Whether more bytes would change nothing."""
    exact: bool = False
    """Whether there is nothing that finishing could teach it."""

    def better(self, other: "Tried | None", target: float | None) -> bool:
        """Whether it is to be preferred: what reaches the target with fewer bytes, else what shows more."""
        if other is None:
            return True
        if target is None or max(self.psnr, other.psnr) < target:
            return self.psnr > other.psnr
        if min(self.psnr, other.psnr) < target:
            return self.psnr >= target
        return self.bytes < other.bytes

    def report(self, kind: str) -> dict:
        """For a report."""
        return {"flags": flags(kind, self.way, self.limit), "bytes": self.bytes, "psnr": self.psnr}


Make = Callable[[Way, int, bool], Tried | None]
"""(way, bytes, finished) -> what it gave; None where not even the coarsest fits."""


class Choosing:
    """One search: remembers what it tried."""

    def __init__(self, make: Make, kind: str, note: Callable[[str], None]):
        self.kind, self.note, self.tried = kind, note, []
        self._plain: dict[tuple[Way, int], Tried | None] = {}
        self.make = cache(lambda way, limit, finished: self._made(make, way, limit, finished))

    def _made(self, make: Make, way: Way, limit: int, finished: bool) -> Tried | None:
        if finished:
            plain = self._plain.get((way, limit))
            found = plain if plain is not None and plain.exact else make(way, limit, True)
            if found is not None:
                self.record(found)
            return found
        self._plain[way, limit] = found = make(way, limit, False)
        return found

    def record(self, found: Tried) -> None:
        """Remember a finished try and tell of it."""
        self.tried.append(found)
        told = f"{found.psnr:.2f} dB, {readable_size(found.bytes)}"
        self.note(f"{flags(self.kind, found.way, found.limit)}: {told}")

    def first_reaching(self, tries: Iterable[Tried], target: float | None) -> Tried | None:
        """The first of finished tries, each made when it is its turn, that reaches a target (dB), or that
        there is where there is no target; None where none does."""
        for found in tries:
            self.record(found)
            if target is None or found.psnr >= target:
                return found
        return None

    def best_within(self, ways: Iterable[Way], limit: int) -> Tried | None:
        """The highest PSNR under a size, None where nothing fits."""
        plain = [t for way in ways if (t := self.make(way, limit, False)) is not None]
        plain.sort(key=lambda t: -t.psnr)
        made = (self.make(t.way, limit, True) for t in plain[: current(SearchConfig).finalists])
        return max((t for t in made if t is not None), key=lambda t: t.psnr, default=None)

    def smallest_reaching(
        self, ways: list[list[Way]], target: float, limit: int, gain: float
    ) -> Tried | None:
        """The fewest bytes at a PSNR of at least target (dB) under a size, None where nothing reaches it.

        ways come in groups, the cheapest first; the first group in which one reaches the target decides.
        gain (dB): what finishing may add at most, to leave out a way that is further away at its largest.
        """
        for group in ways:
            best = None
            for way in group:
                most = limit if best is None else int(best.bytes / current(SearchConfig).close)
                top = self.make(way, most, False)
                if top is None or top.psnr + gain < target:
                    continue
                found = self._smallest_of(way, target, most, min(top.bytes, most), best is not None)
                best = found if found is not None else best
            if best is not None:
                return best
        return None

    def _smallest_of(self, way: Way, target: float, most: int, top: int, contested: bool) -> Tried | None:
        """The smallest size of one way that reaches the target. `contested`: another way reaches it at `most`
        already, so that this one has to show at once that it does too.
        """
        config = current(SearchConfig)
        size = most if contested else max(top // 4, 1)
        low, high = None, None
        for _ in range(config.tries):
            found = self.make(way, size, True)
            if found is not None and found.psnr >= target:
                high = found
            elif size >= most or (found is not None and found.whole):
                break
            else:
                low = max(low or 0, size)
            if found is None:  # not even the coarsest fits
                size = min(most, int(size * config.most_growth))
                continue
            if high is not None and low is not None and high.limit <= config.close * low:
                break
            size = self._next_size(found, target, low, high, most)
        return high

    def _next_size(self, found: Tried, target: float, low: int | None, high: Tried | None, most: int) -> int:
        """By the slope that PSNR usually has, between what is too small and what is enough."""
        config = current(SearchConfig)
        step = math.exp((target + config.overshoot - found.psnr) / config.db_per_e_fold)
        start = min(found.limit, found.bytes) if found.whole else found.limit
        size = start * min(max(step, 1 / config.most_growth), config.most_growth)
        if low is not None and high is not None:
            size = min(max(size, low * config.close**0.5), min(high.limit, high.bytes) / config.close**0.5)
        elif high is not None:
            size = min(size, min(high.limit, high.bytes) / config.close**0.5)
        elif low is not None:
            size = max(size, low * config.close)
        return min(most, max(1, round(size)))

    def neighbours(self, chosen: Tried) -> dict[str, dict]:
        """The next larger choice that shows more and the next smaller one, with what they give."""
        config = current(SearchConfig)
        found = {}
        for name, side in (("smaller", -1), ("larger", 1)):
            near = [
                t
                for t in self.tried
                if config.close**0.5 < (t.bytes / chosen.bytes) ** side < config.neighbour * config.close
                and (t.psnr - chosen.psnr) * side > 0
            ]
            if not near and not (chosen.whole and side > 0):
                made = self.make(chosen.way, round(chosen.bytes * config.neighbour**side), True)
                near = [made] if made is not None and made.bytes != chosen.bytes else []
            if near:
                best = max(near, key=lambda t: (t.psnr - chosen.psnr) / abs(math.log(t.bytes / chosen.bytes)))
                found[f"next_{name}"] = best.report(self.kind)
        return found
