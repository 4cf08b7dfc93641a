"""fusedrf: fuse many radiance fields into one, and edit the result."""

import os

__version__ = "0.2.0"

# Torch's threads spin for milliseconds. Where other work shares the cores, the one that is waited for cannot
# run meanwhile: two trainings at a time got through less than half the steps, while one alone loses nothing.
# It is read when torch is loaded.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")  # turns, before a thread that waits sleeps
