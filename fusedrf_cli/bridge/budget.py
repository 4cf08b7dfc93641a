"""`--time-budget`: seconds of learning, shared out over all that one command tries."""

import contextlib
from collections.abc import Iterator

from fusedrf_cli.engine.kernels import working_time


class Budget:
    """The seconds that one command may learn; the time of compiling kernels does not count."""

    def __init__(self, seconds: float | None):
        """None: as long as it takes."""
        self.seconds, self.spent = seconds, 0.0

    def part(self, tries: int = 1) -> float | None:
        """What the first of so many tries that may come may take; None: as long as it takes."""
        return None if self.seconds is None else max(0.0, self.seconds - self.spent) / tries

    @property
    def over(self) -> bool:
        """Whether there is no time left to learn in."""
        least = 1e-3  # seconds, less of which are not worth a beginning
        return self.seconds is not None and self.seconds - self.spent < least

    @contextlib.contextmanager
    def learning(self) -> Iterator[None]:
        """What is done in here takes from it."""
        started = working_time()
        try:
            yield
        finally:
            self.spent += working_time() - started
