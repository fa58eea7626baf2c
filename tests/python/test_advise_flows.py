"""What `prdp.advise` says of whole steps: those of a `Flow`, and the error that a residual leaves."""

import pytest
import torch
from test_advise import rows

import prdp_torch as prdp
from prdp_torch import operators, solver_trials


@pytest.mark.parametrize("options", [{}, {"boundary": ("wall", "open"), "inflow": (1.0, 0.0)}])
def test_a_flow_is_timed_by_whole_steps(options):
    """Its solves together: beside those of a step that is called by hand."""
    flow = prdp.Flow((12, 16), nu=1e-2, dt=1e-2, **options)
    with torch.no_grad():
        u = flow.project(0.1 * torch.randn(3, 2, 12, 16, generator=torch.Generator().manual_seed(0)))
    advice = prdp.advise(flow, u, seconds=0.3, network=torch.nn.Conv2d(2, 2, 3, padding=1))
    assert {row.name for row in advice.rows} == {"CG", "CG(diagonal)", "CG(multigrid)", "Multigrid", "Direct"}
    same = prdp.Flow((12, 16), nu=1e-2, dt=1e-2, **options, solver=prdp.CG(1000, rtol=1e-5))
    same(u)
    assert rows(advice, "CG", torch.float32)[1e-5].forward.products == int(same.info.operator_applications.max())
    assert "of an update" in advice.recommendation and "start" not in str(advice)
    assert {row.dtype for row in advice.rows} == {torch.float32, torch.float64}


def test_a_flow_with_an_obstacle_of_many_cells_has_no_factorisation():
    obstacle = torch.zeros(256, 256, dtype=torch.bool)
    obstacle[100:120, 100:120] = True
    flow = prdp.Flow((256, 256), nu=1e-3, dt=1e-3, obstacle=obstacle)
    trial = solver_trials.Trial(flow, torch.zeros(1, 2, 256, 256), torch.zeros(1, 2, 256, 256), renewed=False)
    with pytest.raises(ValueError, match="65536 unknowns are too many to factorise within the limit; at most 32768"):
        solver_trials._check_direct(trial, 1.0)


def test_a_small_residual_with_a_large_error_is_told():
    """A field between high values at the sides: most of b does not change u. The errors are those of LAPACK."""
    generator = torch.Generator().manual_seed(0)
    kappa = torch.exp(2.5 * torch.randn(1, 24, 24, generator=generator, dtype=torch.float64))
    A = operators.Diffusion(kappa, boundary=["flux", "zero"])
    b = A.boundary_rhs(values=[(0.0, 0.0), (100.0, 101.0)])
    step = prdp.ImplicitStep(A, lambda u: b, prdp.GMRES(1))
    advice = prdp.advise(step, torch.zeros(1, 1, 24, 24, dtype=torch.float64), seconds=0.5)
    exact = torch.linalg.solve(A.dense(), b.flatten())
    row = rows(advice, "CG(diagonal)", torch.float64)[1e-2]
    u = prdp.linear_solve(A, b, prdp.CG(row.forward.iterations, rtol=1e-2, preconditioner="diagonal"))[0].flatten()
    assert row.error == pytest.approx(float((u - exact).norm() / exact.norm()), rel=1e-6) and row.error > 0.1
    assert "CG(diagonal)" in next(note for note in advice.notes if "leave u off by up to" in note)
    assert "multigrid" in advice.recommendation or "Direct" in advice.recommendation
