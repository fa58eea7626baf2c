"""The solvers, one file each, behind one small interface.

A flow solver is made for a `Box`. It has

- `offsets`: where each component of its state is (see `fields`); tasks sample their fields there
- `rollout(steps)`: compile what takes `steps` steps and return it, a function of the initial state (NumPy arrays)
- `gradient(steps)`: the same for sum((rollout(u0) - target)²) and its gradient for u0, a function of (u0, target)
- `mean_drag(cylinder)`, where it can: the drag of `tasks.design` and its gradient, a function of the inflow profile

A conduction solver is made for a `tasks.conduction.Plate`. It has

- `compliance(rho)`: the compliance and its gradient, both in float64
- `temperatures(rho)`, `misfit(rho, observed)`: the unknowns, and sum((T - observed)²) with its gradient

What a solver cannot do is a reason in words in its `CANNOT`. The records and tables list it.
"""

import importlib
import importlib.util
from typing import NamedTuple


class Box(NamedTuple):
    """A flow problem on [0, length]^d: "periodic", or in 2D a "channel", with walls at both ends of y."""

    shape: tuple
    nu: float
    dt: float
    length: float = 6.283185307179586
    boundary: str = "periodic"
    obstacle: object = None  # bool (*shape), True in solid cells
    double: bool = False

    @property
    def rtol(self):
        """Of the iterative solves inside a step."""
        return 1e-10 if self.double else 1e-5


class Entry(NamedTuple):
    module: str
    cls: str
    needs: str  # the package, as it is imported
    label: str
    tasks: tuple = None  # those that it is for, all where this is None


FLOWS = {
    "ours": Entry("ours", "Ours", "prdp_torch", "prdp_torch, CG and multigrid"),
    "ours_direct": Entry("ours", "Direct", "prdp_torch", "prdp_torch, FFT", ("forward", "cost", "gradient")),
    "ours_recomputed": Entry("ours", "Recomputed", "prdp_torch", "prdp_torch, FFT, recomputed", ("cost", "gradient")),
    "jax_cfd": Entry("jax_cfd_projection", "VanLeer", "jax_cfd", "JAX-CFD, FFT, van Leer"),
    "jax_cfd_central": Entry("jax_cfd_projection", "Central", "jax_cfd", "JAX-CFD, FFT, central"),
    "jax_cfd_cg": Entry(
        "jax_cfd_projection", "CentralCG", "jax_cfd", "JAX-CFD, CG, central", ("forward", "cost", "gradient")
    ),
    "phiflow": Entry("phiflow_projection", "SemiLagrangian", "phi", "PhiFlow, CG, semi-Lagrangian"),
    "phiflow_central": Entry("phiflow_projection", "Central", "phi", "PhiFlow, CG, central"),
    "exponax": Entry("exponax_spectral", "Spectral", "exponax", "Exponax, spectral"),
    "exponax_stored": Entry("exponax_spectral", "Stored", "exponax", "Exponax, spectral, not recomputed", ("cost",)),
}
CONDUCTION = {
    "ours": Entry("ours_conduction", "Ours", "prdp_torch", "prdp_torch, CG on Stencil"),
    "torch_fem": Entry("torch_fem_heat", "Elements", "torchfem", "torch-fem, bilinear elements"),
    "scipy": Entry("scipy_volumes", "Volumes", "scipy", "SciPy, sparse LU"),
}


def load(family, name):
    """The class of a solver. ImportError if what it needs is not installed."""
    entry = family[name]
    if importlib.util.find_spec(entry.needs) is None:
        raise ImportError(f"{entry.needs} is not installed")
    return getattr(importlib.import_module(f"benchmarks.mosaic.solvers.{entry.module}"), entry.cls)
