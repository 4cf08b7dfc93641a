"""When a phase of learning slows down, and when it ends."""

from fusedrf_cli.engine.kinds.distil_config import DistilConfig


class Schedule:
    """The rate while a held-out PSNR rises, then a fall to `rate_decay` of it, then the end.

    Time is the share of the phase that is done, of its steps or of its seconds. The fall begins `cooling`
    before the end, or as soon as `patience` looks and `patient_share` of the phase have brought no more than
    `least_gain`, and then takes as much less time as it begins earlier: it is `cooling` of all that was done
    in either case.
    """

    def __init__(self, config: DistilConfig):
        self.config = config
        self.best, self.looks_since, self.best_at = float("-inf"), 0, 0.0
        self.cooling_from = 1 - config.cooling

    def observe(self, share: float, psnr: float) -> None:
        """Take note of the held-out PSNR at a share of the phase."""
        if psnr > self.best + self.config.least_gain:
            self.best, self.looks_since, self.best_at = psnr, 0, share
            return
        self.looks_since += 1
        late = share - self.best_at >= self.config.patient_share
        if late and self.looks_since >= self.config.patience:
            self.cooling_from = min(self.cooling_from, share)

    @property
    def end(self) -> float:
        """The share at which the phase is over."""
        return self.cooling_from / (1 - self.config.cooling)

    def factor(self, share: float) -> float:
        """What the phase's first rate is multiplied by at a share of it."""
        fallen = (share - self.cooling_from) / (self.end - self.cooling_from)
        return self.config.rate_decay ** min(max(fallen, 0.0), 1.0)

    def state(self) -> dict:
        """JSON-able state for `restore`."""
        best = None if self.best == float("-inf") else self.best
        return {
            "best": best,
            "looks_since": self.looks_since,
            "best_at": self.best_at,
            "cooling_from": self.cooling_from,
        }

    def restore(self, state: dict) -> None:
        """Inverse of `state`."""
        self.best = float("-inf") if state["best"] is None else state["best"]
        self.looks_since, self.best_at = state["looks_since"], state["best_at"]
        self.cooling_from = state["cooling_from"]
