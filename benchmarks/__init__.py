"""Benchmarks: cost beside accuracy, ours and others', on the same systems. `prdp bench` runs them."""
