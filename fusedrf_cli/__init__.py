"""fusedrf: fuse many radiance fields into one, and edit the result."""

import os

__version__ = "0.1.0"

# Torch's threads wait for each other by spinning, for milliseconds. Where other work shares the cores, the
# one that is waited for cannot run meanwhile: of two fits at a time each got through 277 steps in 67 seconds,
# and with this, which costs a fit alone nothing, through 662 in 46. It is read when torch is loaded.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")
