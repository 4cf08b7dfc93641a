"""What a distillation is asked for."""

from dataclasses import dataclass

from fusedrf_cli.engine.kinds.vm.field import VMShape


@dataclass(frozen=True)
class DistillSettings:
    """What a distillation is asked for."""

    shape: VMShape = VMShape(16, 24, 2)
    max_numbers: int = 12_000_000
    """Numbers the student may have; its resolution follows."""
    rays: int = 800_000
    steps: int = 800
    rgb_steps: int = 600
    rgb_samples: int = 1 << 15
    time_budget: float | None = None
    """Seconds of learning, half for points and half for rays where there is an RGB phase. None: the steps
    decide, and equal seeds give equal bytes.
    """
    seed: int = 0
    views: int = 4
    view_size: int = 160
