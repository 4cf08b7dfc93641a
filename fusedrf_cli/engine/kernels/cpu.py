"""Loops on the CPU, and how a field's numbers come to them."""

from types import ModuleType

from fusedrf_cli.engine.kernels.field_free import adam, adam_lines, lens_rays, sums_of_rows, unbent
from fusedrf_cli.engine.kernels.specialise import Loops, loops_for

__all__ = [
    "Loops", "adam", "adam_lines", "lens_rays", "loops_for", "on_device", "on_host",
    "segments", "shared", "sums_of_rows", "unbent",
]  # fmt: skip


def shared(tensor):
    """A torch tensor's numbers as the loops take them, not copied."""
    return tensor.detach().numpy()


def on_device(arrays):
    """Arrays, or a tuple of them, where the loops read them fastest: here as they are."""
    return arrays


def on_host(array):
    """An array that loops filled, as numpy has it: here as it is."""
    return array


def segments() -> ModuleType:
    """The loops over rays of scenes of several instances."""
    from fusedrf_cli.engine.kernels import segments

    return segments
