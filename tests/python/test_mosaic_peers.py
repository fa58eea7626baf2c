"""The adapters of other libraries: that each solves the equations, with the right gradient. They run where these are
installed: `.venv-peers/bin/python -m pytest tests/python/test_mosaic_peers.py`."""

import numpy as np
import pytest

from benchmarks.mosaic import solvers
from benchmarks.mosaic.tasks import conduction, forward, gradient
from benchmarks.mosaic.tasks.design import Cylinder

pytestmark = pytest.mark.filterwarnings("default")

# The largest errors of the solution: the decaying vortices, and the random field beside the spectral reference. The
# order of a method is what sets them: first for semi-Lagrangian steps and where a limiter acts.
ERRORS = {
    "jax_cfd": (2e-3, 2e-2, 2e-2),
    "jax_cfd_central": (1e-4, 2e-4, 1e-2),
    "jax_cfd_cg": (1e-4, 2e-4, 1e-2),
    "phiflow": (3e-2, 5e-2, 1e-1),
    "phiflow_central": (1e-4, 2e-4, 1e-2),
    "exponax": (1e-5, 1e-5, 1e-5),
}


@pytest.fixture(params=ERRORS)
def peer(request):
    try:
        return request.param, solvers.load(solvers.FLOWS, request.param)
    except ImportError as error:
        pytest.skip(str(error))


def test_a_peer_solves_the_equations(peer):
    name, solver = peer
    of_vortex, of_beltrami, of_random = ERRORS[name]
    for case, limit in (
        ({"field": "taylor_green", "n": 32, "nu": 0.05, "dt": 0.01, "steps": 20}, of_vortex),
        ({"field": "beltrami", "n": 16, "nu": 0.05, "dt": 0.01, "steps": 20}, of_beltrami),
        ({"field": "random", "n": 32, "nu": 1e-3, "dt": 0.05, "steps": 20}, of_random),
    ):
        found = forward.run(solver, case)
        assert found["error"] < limit and found["divergence"] < 1e-5, (case, found)


@pytest.mark.parametrize("dim", (2, 3))
def test_the_gradient_of_a_peer_is_that_of_differences(peer, dim):
    _, solver = peer
    compared = gradient.run(solver, {"dim": dim, "n": 8, "steps": 3})
    assert compared["finite"] and compared["cosine"] > 0.9999 and compared["median_error"] < 1e-3


def test_a_peer_runs_the_design_or_says_why_not(peer):
    _, solver = peer
    cylinder = Cylinder(n=32, steps=6)
    if "design" in solver.CANNOT:
        with pytest.raises((NotImplementedError, ValueError)):
            solver(cylinder.box())
        return
    mean_drag, flat = solver(cylinder.box()).mean_drag(cylinder), np.full(32, cylinder.speed)
    direction = np.random.default_rng(0).standard_normal(32)
    slope = (mean_drag(flat + 0.01 * direction)[0] - mean_drag(flat - 0.01 * direction)[0]) / 0.02
    assert mean_drag(flat)[1] @ direction == pytest.approx(slope, rel=1e-2)


@pytest.mark.parametrize("name", ("torch_fem", "scipy"))
def test_conduction_of_a_peer(name):
    try:
        solver = solvers.load(solvers.CONDUCTION, name)
    except ImportError as error:
        pytest.skip(str(error))
    assert max(conduction.run(solver, {"what": "exact", "nx": 8}).values()) < 1e-9
    plate = conduction.Plate(8)
    made, rho = solver(plate), plate.random()
    direction = np.random.default_rng(0).standard_normal(rho.shape)
    for value_and_gradient in (made.compliance, lambda r: made.misfit(r, made.temperatures(plate.two_gaussians()))):
        slope = (value_and_gradient(rho + 1e-6 * direction)[0] - value_and_gradient(rho - 1e-6 * direction)[0]) / 2e-6
        assert (value_and_gradient(rho)[1] * direction).sum() == pytest.approx(slope, rel=1e-5)
