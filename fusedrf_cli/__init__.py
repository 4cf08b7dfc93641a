"""fusedrf: fuse many radiance fields into one, and edit the result."""

__version__ = "0.1.0"
