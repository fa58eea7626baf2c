"""The fluid and conduction tasks of Mosaic (arXiv 2606.27895), defined anew from their parameters, and the solvers
that run them side by side: `python -m benchmarks.mosaic`."""
