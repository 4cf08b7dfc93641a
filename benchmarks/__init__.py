"""What the claims rest on; each module is a command: python -m benchmarks.filled DATA."""
