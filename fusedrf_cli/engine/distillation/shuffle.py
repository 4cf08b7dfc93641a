"""Random order without replacement, over and over, that can be saved and taken up again."""

import numpy as np
import torch

from fusedrf_cli.engine.kernels.pixel_rays import ROUNDS, shuffled


class Shuffle:
    """The numbers 0 to count - 1 in random order, every one once before any comes again. No order is kept:
    each number of it is computed when it is drawn, so that pixels of a gigabyte of photos take no other."""

    def __init__(self, count: int, generator: torch.Generator):
        self.count, self.generator = count, generator
        self.keys: np.ndarray | None = None
        """(ROUNDS,) int64, which tell the present order; None before the first."""
        self.at = 0

    def draw(self, count: int) -> torch.Tensor:
        """The next `count` numbers (int64), or as many as there are; the last of an epoch come together with
        the first of the next."""
        count = min(count, self.count)
        chosen = np.empty(count, np.int64)
        done = 0
        while done < count:
            if self.keys is None or self.at >= self.count:
                self.keys, self.at = self._new_keys(), 0
            part = chosen[done : done + self.count - self.at]
            shuffled(self.at, self.count, self.keys, part)
            self.at += len(part)
            done += len(part)
        return torch.from_numpy(chosen)

    def _new_keys(self) -> np.ndarray:
        return torch.randint(1 << 62, (ROUNDS,), generator=self.generator).numpy()

    def state(self) -> tuple[dict[str, np.ndarray], dict]:
        """Arrays and JSON-able state for `restore`."""
        return {} if self.keys is None else {"keys_of_order": self.keys}, {"drawn": self.at}

    def restore(self, arrays: dict[str, np.ndarray], state: dict) -> None:
        """Inverse of `state`. Raises ValueError for what is no place in an order."""
        keys, at = arrays.get("keys_of_order"), state["drawn"]
        if (
            not 0 <= at <= self.count
            or keys is not None
            and (keys.shape, keys.dtype) != ((ROUNDS,), np.int64)
        ):
            raise ValueError(f"place {at} of {self.count} numbers, in an order by {keys}")
        self.keys, self.at = keys, at
