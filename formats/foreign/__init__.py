"""Checkpoint files of other systems, read to plain containers of numbers without running code."""
