"""Spaces: what a ray is in the coordinates that a field's numbers and its occupancy grid lie in."""
