"""No more than a scene needs: which of many ways to store a field is the best under a size, or the smallest
that reaches a PSNR.

What is tried is made, stored and read back, and its pictures are measured: nothing here is predicted.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache

from fusedrf_cli.engine.kinds.builder import EACH, StorageSetting
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


def flags(kind: str, storage: StorageSetting, limit: int) -> str:
    """The flags of `fuse` that take a way of a kind to a size (bytes)."""
    words = [f"--kind {kind}", *([f"--precision {storage.precision}"] if storage.precision != EACH else [])]
    words += [f"--ranks {storage.ranks[0]},{storage.ranks[1]}"] if storage.ranks is not None else []
    words += [f"--sh-degree {storage.sh_degree}"] if storage.sh_degree is not None else []
    return " ".join([*words, f"--max-size {limit}"])


@dataclass(frozen=True)
class Trial:
    """What a way gave at a size."""

    storage: StorageSetting
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

    def better(self, other: "Trial | None", target: float | None) -> bool:
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
        return {"flags": flags(kind, self.storage, self.limit), "bytes": self.bytes, "psnr": self.psnr}


Make = Callable[[StorageSetting, int, bool], Trial | None]
"""(way, bytes, finished) -> what it gave; None where not even the coarsest fits."""


class StorageSearch:
    """One search: remembers what it tried."""

    def __init__(self, make: Make, kind: str, note: Callable[[str], None]):
        self.kind, self.note, self.trials = kind, note, []
        self._plain: dict[tuple[StorageSetting, int], Trial | None] = {}
        self.make = cache(lambda storage, limit, finished: self._make_trial(make, storage, limit, finished))

    def _make_trial(self, make: Make, storage: StorageSetting, limit: int, finished: bool) -> Trial | None:
        if finished:
            plain = self._plain.get((storage, limit))
            trial = plain if plain is not None and plain.exact else make(storage, limit, True)
            if trial is not None:
                self.record(trial)
            return trial
        self._plain[storage, limit] = trial = make(storage, limit, False)
        return trial

    def record(self, trial: Trial) -> None:
        """Remember a finished try and tell of it."""
        self.trials.append(trial)
        measures = f"{trial.psnr:.2f} dB, {readable_size(trial.bytes)}"
        self.note(f"{flags(self.kind, trial.storage, trial.limit)}: {measures}")

    def first_reaching(self, tries: Iterable[Trial], target: float | None) -> Trial | None:
        """The first of finished tries, each made when it is its turn, that reaches a target (dB), or that
        there is where there is no target; None where none does."""
        for trial in tries:
            self.record(trial)
            if target is None or trial.psnr >= target:
                return trial
        return None

    def best_within(self, storage_settings: Iterable[StorageSetting], limit: int) -> Trial | None:
        """The highest PSNR under a size, None where nothing fits."""
        plain = [t for storage in storage_settings if (t := self.make(storage, limit, False)) is not None]
        plain.sort(key=lambda t: -t.psnr)
        trials = (self.make(t.storage, limit, True) for t in plain[: current(SearchConfig).finalists])
        return max((t for t in trials if t is not None), key=lambda t: t.psnr, default=None)

    def smallest_reaching(
        self, storage_settings: list[list[StorageSetting]], target: float, limit: int, gain: float
    ) -> Trial | None:
        """The fewest bytes at a PSNR of at least target (dB) under a size, None where nothing reaches it.

        Storage settings come in groups, the cheapest first; the first group in which one reaches the target
        decides. gain (dB): what finishing may add at most, to leave out one that is further away at its
        largest.
        """
        for group in storage_settings:
            best = None
            for storage in group:
                most = limit if best is None else int(best.bytes / current(SearchConfig).close)
                top = self.make(storage, most, False)
                if top is None or top.psnr + gain < target:
                    continue
                trial = self._smallest_of(storage, target, most, min(top.bytes, most), best is not None)
                best = trial if trial is not None else best
            if best is not None:
                return best
        return None

    def _smallest_of(
        self, storage: StorageSetting, target: float, most: int, top: int, contested: bool
    ) -> Trial | None:
        """The smallest size of one way that reaches the target. `contested`: another way reaches it at `most`
        already, so that this one has to show at once that it does too.
        """
        config = current(SearchConfig)
        size = most if contested else max(top // 4, 1)
        low, high = None, None
        for _ in range(config.tries):
            trial = self.make(storage, size, True)
            if trial is not None and trial.psnr >= target:
                high = trial
            elif size >= most or (trial is not None and trial.whole):
                break
            else:
                low = max(low or 0, size)
            if trial is None:  # not even the coarsest fits
                size = min(most, int(size * config.most_growth))
                continue
            if high is not None and low is not None and high.limit <= config.close * low:
                break
            size = self._next_size(trial, target, low, high, most)
        return high

    def _next_size(self, trial: Trial, target: float, low: int | None, high: Trial | None, most: int) -> int:
        """By the slope that PSNR usually has, between what is too small and what is enough."""
        config = current(SearchConfig)
        step = math.exp((target + config.overshoot - trial.psnr) / config.db_per_e_fold)
        start = min(trial.limit, trial.bytes) if trial.whole else trial.limit
        size = start * min(max(step, 1 / config.most_growth), config.most_growth)
        if low is not None and high is not None:
            size = min(max(size, low * config.close**0.5), min(high.limit, high.bytes) / config.close**0.5)
        elif high is not None:
            size = min(size, min(high.limit, high.bytes) / config.close**0.5)
        elif low is not None:
            size = max(size, low * config.close)
        return min(most, max(1, round(size)))

    def neighbours(self, chosen: Trial) -> dict[str, dict]:
        """The next larger choice that shows more and the next smaller one, with what they give."""
        config = current(SearchConfig)
        reports = {}
        for name, side in (("smaller", -1), ("larger", 1)):
            near = [
                t
                for t in self.trials
                if config.close**0.5 < (t.bytes / chosen.bytes) ** side < config.neighbour * config.close
                and (t.psnr - chosen.psnr) * side > 0
            ]
            if not near and not (chosen.whole and side > 0):
                trial = self.make(chosen.storage, round(chosen.bytes * config.neighbour**side), True)
                near = [trial] if trial is not None and trial.bytes != chosen.bytes else []
            if near:
                best = max(near, key=lambda t: (t.psnr - chosen.psnr) / abs(math.log(t.bytes / chosen.bytes)))
                reports[f"next_{name}"] = best.report(self.kind)
        return reports
