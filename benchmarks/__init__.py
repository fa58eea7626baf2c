"""Benchmarks: cost beside accuracy, ours and others', on the same systems. `python -m benchmarks` runs them."""
