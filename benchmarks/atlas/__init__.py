"""The failure atlas: maps of where methods work and where they break, measured and drawn by
`python -m benchmarks.atlas`.

`problems` makes operators and right-hand sides; `solves`, `coarse_grids` and `gradients` measure maps; `pictures` draws
them.
"""

from benchmarks.atlas.maps import MAPS, Map, run

__all__ = ["MAPS", "Map", "run"]
