"""Adam over a field's flat parameters, with per-part gradients and no work on entries that no sample
touched."""

from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.fields import large_pages
from fusedrf_cli.engine.fields.computed import Batch, ComputedField
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class AdamConfig:
    """Adam's numbers: TensoRF's but for eps."""

    beta1: float = 0.9
    beta2: float = 0.99
    eps: float = 1e-15
    """A gradient here can be tiny, which it must not damp."""


def alike(array: np.ndarray, expected: torch.Tensor | np.ndarray, name: str) -> np.ndarray:
    """A saved array. Raises ValueError where it is not of the shape and type of a run's own."""
    kind = str(expected.dtype).removeprefix("torch.")
    if array.shape != tuple(expected.shape) or array.dtype.name != kind:
        raise ValueError(f"{name} is {array.dtype} {array.shape}, expected {kind} {tuple(expected.shape)}")
    return array


@dataclass
class Adam:
    """Moments and gradient parts of one field."""

    field: ComputedField
    parts: int
    beta1: float | None = None
    """How much of the moves before each step goes on; with 0 no first moment is kept. None: as `AdamConfig`
    has it."""

    def __post_init__(self):
        params = self.field.params
        self.beta1 = current(AdamConfig).beta1 if self.beta1 is None else self.beta1
        # Rows start on a cache line, so that a run of numbers touches no more lines than it must.
        count, kind = len(params), (params.dtype, params.device)
        self.gradient = large_pages.zeros(self.parts * count, *kind).view(self.parts, count)
        self.moments = large_pages.zeros(count if self.beta1 else 0, *kind), large_pages.zeros(count, *kind)
        shared = self.field.device_loops.shared
        self.grads, self.moment1, self.moment2 = shared(self.gradient), *map(shared, self.moments)
        self.steps = 0

    @classmethod
    def of(cls, field: ComputedField, beta1: float | None = None) -> "Adam":
        """An optimiser with as many rows of gradients as the field's loops add to."""
        return cls(field, field.gradient_rows, beta1)

    def numbers(self) -> list[torch.Tensor]:
        """What steps change: the field's numbers and both moments."""
        return [self.field.params, *self.moments]

    def state(self) -> dict[str, np.ndarray]:
        """The moments that are kept, for `restore`."""
        return {name: moment.cpu().numpy() for name, moment in self._kept()}

    def restore(self, arrays: dict[str, np.ndarray], steps: int) -> None:
        """Take up saved moments after so many steps. Raises ValueError where they are others' moments."""
        for name, moment in self._kept():
            moment.copy_(torch.from_numpy(alike(arrays[name], moment, name)))
        self.steps = steps

    def _kept(self) -> list[tuple[str, torch.Tensor]]:
        moments = zip(("moment1", "moment2"), self.moments, strict=True)
        return [(name, moment) for name, moment in moments if len(moment)]

    def learn_rays(self, batch: Batch) -> np.ndarray:
        """Add the gradients of a batch of rays; the sums (3,) of its losses and samples, as
        `ComputedField.train_rays` gives them."""
        sums = np.zeros((self.parts, 3))
        self.field.train_rays(batch, self.grads, sums)
        return sums.sum(0)

    def step(self, rate: float) -> None:
        """Apply and clear the gradients: each group of numbers at `rate` times its own."""
        config = current(AdamConfig)
        self.steps += 1
        correction1, correction2 = 1 / (1 - self.beta1**self.steps), 1 / (1 - config.beta2**self.steps)
        rest = [np.float32(x) for x in (self.beta1, config.beta2, config.eps, correction1, correction2)]
        moved = self.field.arrays.params, self.grads, self.moment1, self.moment2
        for group in self.field.groups():
            group_rate = np.float32(rate * group.rate)
            if group.lines is None:
                self.field.device_loops.adam(*moved, group_rate, group.low, group.high, *rest)
            else:
                self.field.device_loops.adam_lines(*moved, group_rate, group.lines, *rest)
        self.field.settle()

    def fade(self, share: float) -> None:
        """Take a share of the numbers of groups that fade away, whatever their gradients are: weight decay
        beside Adam (Loshchilov and Hutter 2019, "Decoupled weight decay regularization", algorithm 2)."""
        for group in self.field.groups():
            if group.fades:
                self.field.params[group.low : group.high].mul_(1 - share)

    def sound(self) -> bool:
        """Whether the gradients are finite, judged by those of the slowest groups, some thousand numbers that
        all samples share, or by all where a field has none; those of which a step looks at few lines only are
        left out.

        Every shaded sample adds to its colour basis what it sends back, times its features: a gradient or a
        colour factor that is not finite shows there. What only a density factor could hide, an infinite σ, is
        left to the guard's look at all numbers.
        """
        groups = [group for group in self.field.groups() if group.lines is None]
        slowest = min((group.rate for group in groups), default=1.0)
        looked_at = [group for group in groups if group.rate == slowest]
        parts = [row[group.low : group.high] for group in looked_at for row in self.gradient]
        return all(bool(torch.dot(part, part).isfinite()) for part in parts)

    def clear(self) -> None:
        """Forget the gradients without a step."""
        self.gradient.zero_()
