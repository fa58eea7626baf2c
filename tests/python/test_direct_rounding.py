"""`Direct` where the residual of a regular system is all rounding, and where a system is singular to its dtype."""

import warnings

import pytest
import torch
from stand_in_device import StandIn

import prdp_torch as prdp
from prdp_torch import operators
from prdp_torch.operators import Matrix

F64 = torch.float64


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def constrained(stiffness=1e5, n=30, constraints=4):
    """A saddle point: a stiffness, and constraints whose numbers are of the order of one."""
    half = noise(n, n) / n**0.5
    coupling = noise(constraints, n, seed=1)
    top = torch.cat([(half @ half.T + torch.eye(n)) * stiffness, coupling.T], 1)
    return torch.cat([top, torch.cat([coupling, torch.zeros(constraints, constraints)], 1)])


@pytest.mark.filterwarnings("ignore:.* STAGNATED far above rtol", "ignore:.* with a large residual")
@pytest.mark.parametrize("form", ["dense", "csr", "device"])
@pytest.mark.parametrize("stiffness", [1e3, 1e5, 1e7])
def test_a_regular_system_is_solved_though_its_residual_is_rounding(stiffness, form):
    a = constrained(stiffness).float()
    b = torch.zeros(2, len(a))
    b[:, 30:] = 1e-3 * noise(2, 4, seed=2).float()
    expected = torch.linalg.solve(a.double(), b.double().T).T
    if form == "device":
        with StandIn() as device:
            u, _ = prdp.linear_solve(Matrix(device.send(a)), device.send(b), prdp.Direct())
            u = device.fetch(u)
    else:
        u, _ = prdp.linear_solve(Matrix(a if form == "dense" else a.to_sparse_csr()), b, prdp.Direct())
    u = u.double()
    assert ((u - expected)[:, :30].norm(dim=1) < 1e-4 * expected[:, :30].norm(dim=1)).all()


@pytest.mark.filterwarnings("ignore:.* STAGNATED far above rtol", "ignore:.* with a residual above")
@pytest.mark.parametrize("scale", [1e10, 1e20])
def test_one_row_of_another_size_is_no_singularity(scale):
    a, b = noise(6, 6), torch.ones(1, 6, dtype=F64)
    a[2] *= scale
    u, _ = prdp.linear_solve(a, b, prdp.Direct())
    torch.testing.assert_close(u[0], torch.linalg.solve(a, b[0]), rtol=1e-10, atol=0)


def test_what_is_singular_to_its_dtype_is_refused():
    """Of a hundred with an eigenvalue of zero, which rounding makes about 1e-8."""
    refused = 0
    for seed in range(100):
        q, _ = torch.linalg.qr(noise(12, 12, seed=seed))
        d = torch.logspace(0, -2, 12, dtype=F64)
        d[-1] = 0.0
        a, b = (q @ torch.diag(d) @ q.T).float(), noise(1, 12, seed=seed + 100).float()
        u, info = prdp.linear_solve(a, b, prdp.Direct(), on_failure="return")
        failed = info.status[0] == prdp.SolveStatus.BREAKDOWN
        assert not failed or not u.any()
        refused += int(failed)
    assert refused >= 95


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("nodes", [2, 3])
def test_a_few_unknowns_that_are_singular_are_found_wherever_they_stand(nodes, dtype):
    """A graph's Laplacian, in float32 with rounding in its row sums, among unknowns of which nothing is wrong."""
    weights = 0.1 + torch.rand(nodes, nodes, dtype=F64, generator=torch.Generator().manual_seed(0))
    weights = (weights + weights.T) / 3
    laplacian = torch.diag(weights.sum(1)) - weights
    for at in range(12):
        a = torch.eye(12 + nodes, dtype=F64)
        a[at : at + nodes, at : at + nodes] = laplacian
        b = noise(1, 12 + nodes, seed=at).to(dtype)
        u, info = prdp.linear_solve(a.to(dtype), b, prdp.Direct(), on_failure="return")
        assert not info.solved.any() and u.abs().max() < 1e3


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("n", [10, 50, 120])
def test_a_function_is_as_singular_as_its_matrix(n, dtype):
    """With a null vector that nobody named, and the constant pressure of a saddle point."""
    refused = 0
    for seed in range(6):
        q = torch.nn.functional.normalize(noise(n, seed=seed), dim=0)
        x, p = noise(n, n, seed=seed + 50), torch.eye(n, dtype=F64) - torch.outer(q, q)
        projected = p @ (x @ x.T / n + torch.eye(n, dtype=F64)) @ p
        saddle = constrained(1.0, n - n // 3, n // 3)
        saddle[n - n // 3 :] -= saddle[n - n // 3 :].mean(0)
        saddle[:, n - n // 3 :] -= saddle[:, n - n // 3 :].mean(1, keepdim=True)
        for a in (((projected + projected.T) / 2).to(dtype), saddle.to(dtype)):
            b = noise(1, n, seed=seed + 100).to(dtype)
            for product in (a, prdp.operators.Function(lambda v, a=a: v @ a, symmetric=True)):
                u, info = prdp.linear_solve(product, b, prdp.Direct(), on_failure="return")
                refused += int(info.failed)
                assert not info.failed or not u.any()
    assert refused == 24


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_a_function_with_rows_of_other_sizes_is_solved(dtype):
    a, b = noise(7, 7) + 3 * torch.eye(7, dtype=F64), noise(2, 7, seed=1)
    rows = torch.logspace(-9, 9, 7, dtype=F64)[:, None]
    u, info = prdp.linear_solve(
        prdp.operators.Function(lambda v: v @ (rows * a).to(dtype).T), b.to(dtype) * rows.T.to(dtype), prdp.Direct(),
        on_failure="return",
    )  # fmt: skip
    expected = torch.linalg.solve(a, b.T).T
    assert ((u - expected).norm(dim=1) < 300 * torch.finfo(dtype).eps * expected.norm(dim=1)).all(), info


@pytest.mark.filterwarnings("ignore:.* STAGNATED far above rtol", "ignore:.* with a residual above")
@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("shape", [(40,), (16, 12), (6, 7, 8)])
@pytest.mark.parametrize("held_by", ["shift", "side"])
def test_a_diffusion_that_loses_what_holds_u_in_its_factors_is_refused(dtype, shape, held_by):
    """Insulated but for a shift, or for one weak side: the mean of u follows from that of b."""
    refused = []
    for power in range(3, 16):
        kappa = torch.full((1, *shape), 10.0**power, dtype=dtype)
        kappa[..., shape[-1] // 2 :] *= 1e3
        b = torch.ones(1, 1, *shape, dtype=dtype)
        b[..., 0] = 2.0
        sides = "flux" if held_by == "shift" else [*["flux"] * (len(shape) - 1), (("robin", 1.0), "flux")]
        a = operators.Diffusion(kappa, 1.0 if held_by == "shift" else 0.0, sides)
        u, info = prdp.linear_solve(a, b, prdp.Direct(), on_failure="return", backward="none")
        refused.append(bool(info.failed))
        out = u.double().mean() if held_by == "shift" else u.double()[..., 0].mean()  # of cells at the side, κ >> h dx
        assert refused[-1] or not info.solved or abs(out / b.double().mean() - 1) < 3e-3, (power, out)
    assert refused == sorted(refused) and refused[-1] and not refused[2]
    with pytest.raises(torch.linalg.LinAlgError, match=r"Direct on Diffusion: (the shift and the sides|A is singular)"):
        prdp.linear_solve(a, b, prdp.Direct())


@pytest.mark.filterwarnings("ignore:.* STAGNATED far above rtol", "ignore:.* with a residual above")
def test_on_a_fine_grid_in_float32_it_is_solved_as_well_as_the_dtype_allows():
    """Its sums over 1,023 points leave some ten roundings of a product."""
    b = noise(1, 1, 1023, 1023)
    poisson = prdp.Poisson((1023, 1023), prdp.Direct())
    u = poisson(b.float())
    assert poisson.info.solved.all() and poisson.info.floor[0] < poisson.info.residual[0] < 32 * poisson.info.floor[0]
    exact = poisson(b)
    assert (u - exact).norm() < 1e-5 * exact.norm()


@pytest.mark.filterwarnings("ignore:.* STAGNATED far above rtol", "ignore:.* with a residual above")
@pytest.mark.parametrize("n", [3500, 20000])
def test_a_smooth_load_on_many_points_of_a_line_is_solved_though_its_residual_is_above_b(n):
    """What float32 leaves of the residual grows by n², the error of u by n alone: the factors are those of float64."""
    exact = torch.sin(torch.pi * torch.arange(1, n + 1, dtype=F64) / (n + 1)).float()
    poisson, heat = prdp.Poisson((n,), prdp.Direct()), prdp.Heat((n,), 1.0, 1e6, prdp.Direct())
    for step, scale in ((poisson, torch.pi**2), (heat, 1 + 1e6 * torch.pi**2)):
        u = step(scale * exact.view(1, 1, n))[0, 0]
        assert step.info.status.item() == prdp.SolveStatus.STAGNATED and step.info.solved.all()
        torch.testing.assert_close(u, exact, rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("jitter", [1e-2, 1e-3, 1e-4])
def test_refining_never_hands_out_a_worse_solution(jitter):
    """Of a kernel matrix in float32 the first solve, whose factors are in float64, is the most accurate."""
    x = torch.linspace(0, 1, 100)
    kernel = torch.exp(-((x[:, None] - x) ** 2) / 0.08) + jitter * torch.eye(100)
    y = torch.sin(6 * x) + 0.1 * noise(100).float()
    exact = torch.linalg.solve(kernel.double(), y.double())
    first, *refined = (prdp.linear_solve(kernel, y, prdp.Direct(max_iter=m)) for m in (1, 2, 5))
    assert (first[0] - exact).norm() < 1e-6 * exact.norm()
    for u, info in refined:
        assert info.residual <= first[1].residual and info.solved
        assert (u - exact).norm() < 1e-6 * exact.norm() or info.residual < first[1].residual


def test_a_large_residual_of_a_direct_solve_is_told(always):
    """A shift of 1e-10 holds the mean, which the factors lose in part; refined they lose less."""
    u = torch.rand(1, 1, 32, 32, dtype=F64, generator=torch.Generator().manual_seed(0))
    a = operators.Diffusion(torch.ones(1, 32, 32, dtype=F64), shift=1e-10, boundary="flux")
    with pytest.warns(
        UserWarning, match="max_iter = 1, with a large residual: sample 0 at .* or refine it by a larger"
    ):
        _, info = prdp.linear_solve(a, 1e-10 * u, prdp.Direct())
    _, refined = prdp.linear_solve(a, 1e-10 * u, prdp.Direct(3, rtol=0.0))
    assert not info.solved and 0.01 < info.residual < 0.5 and refined.residual < 0.5 * info.residual
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        prdp.linear_solve(a, 1e-10 * u, prdp.Direct(rtol=0.0))  # nothing was asked for
        prdp.linear_solve(a, 1e-10 * u, prdp.Direct(0))
