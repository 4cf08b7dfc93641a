"""What tests of CUDA loops share: they run on a GPU where there is one, and always in numba's simulator."""

import os
import subprocess
import sys

import numba
import pytest
import torch

SIMULATED = bool(numba.config.ENABLE_CUDASIM)
HERE = SIMULATED or torch.cuda.is_available()
on_a_device = pytest.mark.skipif(not HERE, reason="needs a GPU, or the simulator's own process")
beside_the_simulator = pytest.mark.skipif(SIMULATED, reason="this is the simulator's process")
EXACT = dict(rtol=1e-9, atol=1e-11)


def run_simulated(file: str) -> None:
    """All cases of a test file once more, in a process of their own where numba simulates the GPU."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", file]
    done = subprocess.run(
        command, env=os.environ | {"NUMBA_ENABLE_CUDASIM": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0 and " passed" in done.stdout and "1 skipped" in done.stdout, done.stdout
