"""Random order without replacement, over and over, that can be saved and taken up again."""

import numpy as np
import torch


class Epochs:
    """The numbers 0 to count - 1 in random order, every one once before any comes again."""

    def __init__(self, count: int, generator: torch.Generator):
        self.count, self.generator = count, generator
        self.drawn_from: torch.Tensor | None = None
        """The generator's state before the present order was drawn; None before the first."""
        self.order, self.at = None, 0

    def draw(self, count: int) -> torch.Tensor:
        """The next `count` numbers (int64), or as many as there are; the last of an epoch come together with
        the first of the next."""
        count = min(count, self.count)
        if self.order is None:
            self._shuffle()
        chosen = self.order[self.at : self.at + count]
        self.at += len(chosen)
        if len(chosen) < count:
            self._shuffle()
            self.at = count - len(chosen)
            chosen = torch.cat([chosen, self.order[: self.at]])
        return chosen

    def _shuffle(self) -> None:
        self.drawn_from = self.generator.get_state()
        self.order, self.at = torch.randperm(self.count, generator=self.generator), 0

    def state(self) -> tuple[dict[str, np.ndarray], dict]:
        """Arrays and JSON-able state for `restore`."""
        arrays = {} if self.drawn_from is None else {"random_of_order": self.drawn_from.numpy()}
        return arrays, {"drawn": self.at}

    def restore(self, arrays: dict[str, np.ndarray], state: dict) -> None:
        """Inverse of `state`. The generator is left in some other state; set it afterwards."""
        if "random_of_order" in arrays:
            self.generator.set_state(torch.from_numpy(arrays["random_of_order"]))
            self._shuffle()
        self.at = state["drawn"]
