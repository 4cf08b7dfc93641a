"""Adam over a VM field's flat parameters, with per-part gradients and no work on entries that no sample
touched."""

from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.kinds.vm.field import VMField

BETA1, BETA2, EPS = 0.9, 0.99, 1e-15  # TensoRF's; a gradient here can be tiny, so eps must not damp it
BASIS_RATE_RATIO = 0.05  # TensoRF: 1e-3 for the colour basis where factors learn at 2e-2


@dataclass
class Adam:
    """Moments and gradient parts of one field."""

    field: VMField
    parts: int

    def __post_init__(self):
        params = self.field.params
        # torch's memory starts on a cache line, so that a run of numbers touches no more lines than it must
        self.gradient = params.new_zeros(self.parts, len(params))
        self.moments = torch.zeros_like(params), torch.zeros_like(params)
        shared = self.field.loops.shared
        self.grads, self.moment1, self.moment2 = shared(self.gradient), *map(shared, self.moments)
        self.steps = 0

    @classmethod
    def of(cls, field: VMField) -> "Adam":
        """An optimiser with a row of gradients for each thread of the CPU; a GPU's threads share one."""
        return cls(field, torch.get_num_threads() if field.params.device.type == "cpu" else 1)

    def numbers(self) -> list[torch.Tensor]:
        """What steps change: the field's numbers and both moments."""
        return [self.field.params, *self.moments]

    def state(self) -> dict[str, np.ndarray]:
        """The moments, for `restore`."""
        return {f"moment{i + 1}": moment.cpu().numpy() for i, moment in enumerate(self.moments)}

    def restore(self, arrays: dict[str, np.ndarray], steps: int) -> None:
        """Take up saved moments after so many steps."""
        for i, moment in enumerate(self.moments):
            moment.copy_(torch.from_numpy(arrays[f"moment{i + 1}"]))
        self.steps = steps

    def step(self, rate: float) -> None:
        """Apply and clear the gradients: rate for factors, BASIS_RATE_RATIO of it for colour bases."""
        self.steps += 1
        correction1, correction2 = 1 / (1 - BETA1**self.steps), 1 / (1 - BETA2**self.steps)
        params = self.field.arrays.params
        for low, high, is_basis in self.field.parameter_groups():
            self.field.loops.adam(
                params,
                self.grads,
                self.moment1,
                self.moment2,
                np.float32(rate * (BASIS_RATE_RATIO if is_basis else 1)),
                low,
                high,
                np.float32(BETA1),
                np.float32(BETA2),
                np.float32(EPS),
                np.float32(correction1),
                np.float32(correction2),
            )
        if hasattr(self.field, "settle"):  # some of its numbers follow from others
            self.field.settle()

    def sound(self) -> bool:
        """Whether the gradients are finite, judged by those of the colour bases (some thousand numbers), or
        by all where a field has none.

        Every shaded sample adds to its basis what it sends back, times its features: a gradient or a colour
        factor that is not finite shows there. What only a density factor could hide, an infinite σ, is left
        to the guard's look at all numbers.
        """
        groups = self.field.parameter_groups()
        looked_at = [g for g in groups if g[2]] or groups
        parts = [row[low:high] for low, high, _ in looked_at for row in self.gradient]
        return all(bool(torch.dot(part, part).isfinite()) for part in parts)

    def clear(self) -> None:
        """Forget the gradients without a step."""
        self.gradient.zero_()
