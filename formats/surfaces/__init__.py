"""Readers of meshes: each file's surfaces, as their format says, with notes on all that is not honoured."""
