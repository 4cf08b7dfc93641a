"""Whether loops over items run on one thread, as they are compiled."""

import os

import numba

ONE_THREAD = numba.config.NUMBA_NUM_THREADS == 1 and "NUMBA_CACHE_DIR" not in os.environ
"""A loop for several threads takes half as long again to compile, and one thread gains nothing by it. Numba
keeps both under one name, so that they need caches of their own: not where the cache is another's choice."""
