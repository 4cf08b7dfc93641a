"""What keeps one bad step, or many, from spoiling a run: skip, count, go back, slow down."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class NanGuardConfig:
    """When bad steps are taken back."""

    window: int = 100
    """Steps over which bad ones are counted."""
    allowed: int = 10
    """Bad steps in a window before the last good state is taken up again."""
    kept_every: int = 200
    """Steps between two copies of a good state: a copy costs about a fifth of a step."""
    rate_cut: float = 1 / 3
    most_roll_backs: int = 3


class NanGuard:
    """Skips steps whose loss or gradient is not finite, and goes back to a copy of the last good numbers, at
    a third of the rate, where they come too often."""

    def __init__(self, numbers: Callable[[], list[torch.Tensor]]):
        """numbers() are what steps change: parameters and moments, to copy back into."""
        self.numbers = numbers
        self.rate = 1.0
        """What the learning rate is to be multiplied by."""
        self.skipped, self.roll_backs = 0, 0
        self.recent: deque[bool] = deque(maxlen=current(NanGuardConfig).window)
        self.kept: list[torch.Tensor] = []
        self.age = 0

    def accepts(self, sums: np.ndarray, optimiser: Adam) -> bool:
        """Whether a step whose losses sum to `sums` may be made; if not, its gradients are cleared."""
        sound = bool(np.isfinite(sums).all()) and optimiser.sound()
        self.recent.append(not sound)
        if not sound:
            optimiser.clear()
            self.skipped += 1
            if sum(self.recent) > current(NanGuardConfig).allowed:
                self.roll_back()
        return sound

    def step(self, sums: np.ndarray, optimiser: Adam, rate: float) -> None:
        """Make a step at `rate` times the guard's own, where it may be made."""
        if self.accepts(sums, optimiser):
            optimiser.step(rate * self.rate)

    def keep(self) -> None:
        """Before every step: copy the numbers when that is due, or go back where they are not finite."""
        if not self.kept or self.age >= current(NanGuardConfig).kept_every:
            self.check()
            if len(self.kept) != len(now := self.numbers()):
                self.kept = [torch.empty_like(values) for values in now]
            for copy, values in zip(self.kept, now, strict=True):
                copy.copy_(values)
            self.age = 0
        self.age += 1

    def check(self) -> None:
        """Go back where a number is not finite."""
        if not all(torch.dot(values.flatten(), values.flatten()).isfinite() for values in self.numbers()):
            self.roll_back()

    def renew(self) -> None:
        """The numbers have other shapes now: what was kept cannot be taken up again."""
        self.kept = []

    def roll_back(self) -> None:
        """Take up the last good numbers, at a third of the rate. Raises FloatingPointError when that has not
        helped before, or nothing good is known."""
        config = current(NanGuardConfig)
        if self.roll_backs == config.most_roll_backs or not self.kept:
            raise FloatingPointError(
                f"{self.skipped} steps were not finite, after {self.roll_backs} returns to the last good "
                "state at a third of the rate"
            )
        for copy, values in zip(self.kept, self.numbers(), strict=True):
            values.copy_(copy)
        self.roll_backs += 1
        self.rate *= config.rate_cut
        self.recent.clear()
        self.age = 0

    def figures(self) -> dict[str, int]:
        """What a report says of it: nothing where nothing happened."""
        figures = {"skipped_steps": self.skipped, "roll_backs": self.roll_backs}
        return figures if any(figures.values()) else {}

    def state(self) -> dict:
        """JSON-able state for `restore`; the kept numbers are not part of it."""
        return {
            "rate": self.rate,
            "skipped": self.skipped,
            "roll_backs": self.roll_backs,
            "recent": list(self.recent),
        }

    def restore(self, state: dict) -> None:
        """Inverse of `state`; the numbers to go back to are those of the first step from here."""
        self.rate, self.skipped = state["rate"], state["skipped"]
        self.roll_backs = state["roll_backs"]
        self.recent.extend(map(bool, state["recent"]))
