"""Loops on the CPU, and how a field's numbers come to them."""

from fusedrf_cli.engine.kernels.plain import adam, adam_lines, lens_rays, sums_of_rows, unbent
from fusedrf_cli.engine.kernels.specialise import Loops, loops_for

__all__ = [
    "Loops", "adam", "adam_lines", "lens_rays", "loops_for", "on_device", "shared",
    "sums_of_rows", "unbent",
]  # fmt: skip


def shared(tensor):
    """A torch tensor's numbers as the loops take them, not copied."""
    return tensor.detach().numpy()


def on_device(arrays):
    """Arrays, or a tuple of them, where the loops read them fastest: here as they are."""
    return arrays
