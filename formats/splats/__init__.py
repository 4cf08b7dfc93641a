"""Files of Gaussian splats. `reading.py` tells which of the formats a file is, and reads it."""
