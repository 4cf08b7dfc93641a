"""The paper's experiments, and those that it leaves out: python -m benchmarks.paper (or make bench-paper)."""
