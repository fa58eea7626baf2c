"""Singular operators of one's own whose null space nobody named: right-hand sides and cotangents with a constant part
raise, with every method; nothing else does."""

import pytest
import torch
from helpers import statuses

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64
OFFSETS = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)]
METHODS = {
    "cg": lambda k, rtol: prdp.CG(k, rtol),
    "cg diagonal": lambda k, rtol: prdp.CG(k, rtol, preconditioner="diagonal"),
    "cg multigrid": lambda k, rtol: prdp.CG(k, rtol, preconditioner="multigrid"),
    "gmres": lambda k, rtol: prdp.GMRES(k, rtol),
    "gmres multigrid": lambda k, rtol: prdp.GMRES(k, rtol, preconditioner="multigrid"),
    "bicgstab": lambda k, rtol: prdp.BiCGStab(k, rtol),
    "bicgstab multigrid": lambda k, rtol: prdp.BiCGStab(k, rtol, preconditioner="multigrid"),
    "steepest descent": lambda k, rtol: prdp.SteepestDescent(k, rtol),
    "jacobi": lambda k, rtol: prdp.Jacobi(k, rtol),
    "multigrid": lambda k, rtol: prdp.Multigrid(k, rtol),
    "direct": lambda k, rtol: prdp.Direct(),
}


def insulated(n, dtype, leak=0.0):
    """-∇·(κ ∇u) + leak u on n × n cells, through whose sides no flux passes."""
    kappa = torch.exp(torch.randn(n, n, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
    up, left = torch.zeros_like(kappa), torch.zeros_like(kappa)
    up[1:], left[:, 1:] = 2 / (1 / kappa[1:] + 1 / kappa[:-1]), 2 / (1 / kappa[:, 1:] + 1 / kappa[:, :-1])
    down, right = up.roll(-1, 0), left.roll(-1, 1)
    sides = [side.to(dtype) for side in (up, down, left, right)]
    return operators.Stencil(torch.stack([sum(sides) + leak, *(-side for side in sides)])[None], OFFSETS)


def point(n, dtype):
    b = torch.zeros(1, 1, n, n, dtype=dtype)
    b[0, 0, n // 3, n // 2] = 1.0
    return b


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [16, 33, 64])
@pytest.mark.parametrize("method", METHODS)
def test_a_constant_part_of_b_raises(method, n, dtype):
    solver = METHODS[method](500, 1e-6)
    with pytest.raises(torch.linalg.LinAlgError, match='give nullspace="constant"'):
        prdp.linear_solve(insulated(n, dtype), point(n, dtype), solver)


@pytest.mark.parametrize("dtype, scale", [(torch.float32, 1e-35), (torch.float64, 1e-200), (torch.float64, 1e-300)])
def test_so_does_one_whose_squares_underflow(dtype, scale):
    b = scale * point(16, dtype)
    with pytest.raises(torch.linalg.LinAlgError, match=r'INCONSISTENT.*give nullspace="constant"'):
        prdp.linear_solve(insulated(16, dtype), b, METHODS["gmres"](500, 1e-6))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("method", METHODS)
def test_a_constant_part_of_a_cotangent_raises(method, dtype):
    """A loss of one value: its cotangent has a mean, though b has none."""
    n = 32
    b = torch.randn(1, 1, n, n, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    b = (b - b.mean()).to(dtype).requires_grad_()
    with pytest.raises(torch.linalg.LinAlgError, match='give nullspace="constant"'):
        u, _ = prdp.linear_solve(insulated(n, dtype), b, METHODS[method](500, 1e-3))
        torch.autograd.grad(u[0, 0, 3, 4], b)


def winds(n):
    """Upwind transport around a ring, whose rows and columns sum to zero."""
    return torch.eye(n) - torch.eye(n).roll(1, 0)


KINDS = {
    "matrix": lambda: operators.Matrix(winds(12)),
    "csr": lambda: operators.Matrix(winds(12).to_sparse_csr()),
    "function": lambda: operators.Function(lambda v: v - v.roll(1, -1), transpose=lambda v: v - v.roll(-1, -1)),
    "symmetric function": lambda: operators.Function(lambda v: 2 * v - v.roll(1, -1) - v.roll(-1, -1), symmetric=True),
}


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_says_so_of_the_sample_alone(kind):
    b = torch.randn(3, 12, generator=torch.Generator().manual_seed(2))
    b = b - b.mean(1, keepdim=True)
    b[1] += 0.5
    # Two vectors a cycle do not solve it, so that every sample ends unsolved.
    _, info = prdp.linear_solve(KINDS[kind](), b, prdp.GMRES(12, 1e-6, restart=2), on_failure="return")
    assert statuses(info)[1] == "INCONSISTENT"
    assert "INCONSISTENT" not in (statuses(info)[0], statuses(info)[2])


def test_a_few_iterations_are_left_alone():
    """They are truncated, as any others, and rounding has not grown yet."""
    n = 32
    _, info = prdp.linear_solve(insulated(n, torch.float32), point(n, torch.float32), prdp.CG(5, 1e-6))
    assert statuses(info) == ["MAX_ITER"]


@pytest.mark.parametrize("k", [1, 5, 20, 40, 200])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_worse_than_zero_raises_after_any_number_of_iterations(k, dtype):
    """CG on a periodic Laplacian grows the constant part of b, and hands out nothing of it where it says so."""
    a = torch.tensor([4.0, -1, -1, -1, -1], dtype=dtype).view(1, 5, 1, 1).expand(1, 5, 16, 16) * 256
    stencil = operators.Stencil(a, [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)], boundary="periodic")
    b = 1 + torch.randn(4, 1, 16, 16, generator=torch.Generator().manual_seed(3), dtype=dtype)
    u, info = prdp.linear_solve(stencil, b, prdp.CG(k), on_failure="return")
    left = (b - stencil.apply(u)).flatten(1).norm(dim=1) / b.flatten(1).norm(dim=1)
    assert info.failed.all() or bool((left <= 1 + 1e-4).all())
    diverged = info.status == int(prdp.SolveStatus.DIVERGED)
    assert bool((left[diverged] <= 1 + 1e-4).all())


@pytest.mark.parametrize("method", ["bicgstab", "cg multigrid", "gmres"])
def test_no_sample_is_both_solved_and_failed(method):
    """As large as u becomes, what its rounding leaves is no excuse."""
    n, dtype = 16, torch.float64
    kappa = torch.full((n, n), float(n * n), dtype=dtype)
    sides = [kappa.clone() for _ in OFFSETS[1:]]
    sides[0][0], sides[1][-1], sides[2][:, 0], sides[3][:, -1] = 0, 0, 0, 0
    a = operators.Stencil(torch.stack([sum(sides), *(-side for side in sides)])[None], OFFSETS, "zero")
    b = torch.randn(60, 1, n, n, dtype=dtype, generator=torch.Generator().manual_seed(1))
    _, info = prdp.linear_solve(a, b, METHODS[method](300, 1e-5), on_failure="return")
    assert info.failed.any() and not (info.solved & info.failed).any()
    assert info.floor[info.failed].eq(0).all()


@pytest.mark.parametrize("leak", [1e-4, 1e-2])
def test_regular_operators_may_end_at_max_iter(leak):
    n = 64
    for b in (point(n, torch.float32), torch.ones(1, 1, n, n)):
        _, info = prdp.linear_solve(insulated(n, torch.float32, leak), b, prdp.CG(40, 1e-6), on_failure="return")
        assert statuses(info)[0] in ("MAX_ITER", "STAGNATED")  # at the rounding of its dtype


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("method", METHODS)
def test_a_tolerance_above_that_part_is_reached_or_raises(method, dtype):
    n = 64
    b = point(n, dtype)  # its constant part is 1/64
    u, info = prdp.linear_solve(insulated(n, dtype), b, METHODS[method](500, 0.1), on_failure="return")
    left = b - insulated(n, dtype).apply(u)
    if info.status.item() >= -2:
        assert statuses(info) == ["CONVERGED"] and left.norm() <= 0.1 * b.norm()


@pytest.mark.parametrize(
    "solver", [prdp.GMRES(5, restart=30), prdp.GMRES(50, restart=20), prdp.BiCGStab(200), prdp.CG(200), prdp.Direct()]
)
def test_what_a_second_null_vector_makes_large_is_not_solved(solver):
    """Two insulated bars. The constant is named, one per bar is not, and b has a small part along the other."""
    n, generator = 15, torch.Generator().manual_seed(0)
    ones = torch.ones(n, dtype=torch.float64)
    bar = torch.diag(2 * ones) - torch.diag(ones[1:], 1) - torch.diag(ones[1:], -1)
    bar[0, 0] = bar[-1, -1] = 1
    bars, other = torch.block_diag(bar, bar), torch.cat([ones, -ones])
    b = bars @ torch.randn(2 * n, generator=generator, dtype=torch.float64)
    b = b / b.norm() + 0.005 * other / other.norm()
    a = operators.Matrix(bars, nullspace="constant")
    u, info = prdp.linear_solve(a, b[None], solver, on_failure="return")
    truth = torch.linalg.pinv(bars, rtol=1e-10) @ b
    assert (u - truth).norm() < truth.norm() or not info.solved.any(), info


def test_a_constraint_given_twice_with_two_values_is_not_solved():
    """A saddle point without a solution. MINRES comes near one, and then u grows along the null vector."""
    solved = 0
    for seed in range(20):
        generator = torch.Generator().manual_seed(seed)
        half = torch.randn(8, 8, generator=generator, dtype=torch.float64)
        h = half @ half.T / 8 + torch.eye(8, dtype=torch.float64)
        c = torch.randn(2, 8, generator=generator, dtype=torch.float64)
        c = torch.cat([c, c[:1]])
        a = torch.cat([torch.cat([h, c.T], 1), torch.cat([c, torch.zeros(3, 3, dtype=torch.float64)], 1)])
        b = torch.randn(1, 11, generator=generator, dtype=torch.float64)
        b[0, -1] = b[0, -3] + 0.1
        u, info = prdp.linear_solve(operators.Matrix(a), b, prdp.MINRES(20), on_failure="return")
        truth = torch.linalg.pinv(a, rtol=1e-10) @ b[0]
        solved += bool(info.solved) and bool((u - truth).norm() > truth.norm())
    assert solved == 0


def with_penalty(penalty, low, high, n=200):
    a = 2 * torch.eye(n, dtype=F64) + low * torch.diag(torch.ones(n - 1, dtype=F64), -1)
    a += high * torch.diag(torch.ones(n - 1, dtype=F64), 1)
    a[0, 0] += penalty
    a[-1, -1] += penalty
    return a


@pytest.mark.parametrize("penalty", [1e4, 1e12, 1e14])
@pytest.mark.parametrize(
    "solver, low, high",
    [(prdp.MINRES(30, 1e-8, preconditioner="diagonal"), -1, -1),
     (prdp.BiCGStab(30, 1e-8, preconditioner="diagonal"), -1.05, -0.95)],
    ids=["minres", "bicgstab"],
)  # fmt: skip
def test_a_u_beside_large_rows_has_not_grown(solver, low, high, penalty):
    b = torch.zeros(1, 200, dtype=F64)
    b[0, 66] = 1
    u, info = prdp.linear_solve(with_penalty(penalty, low, high), b, solver)
    assert info.status.item() == prdp.SolveStatus.MAX_ITER and info.residual.item() < 0.3 and u.norm() > 1


def test_gmres_that_stagnates_beside_a_large_row_keeps_its_u():
    shift = torch.eye(20, dtype=F64).roll(1, 0)
    a = torch.block_diag(torch.tensor([[1e12]], dtype=F64), torch.eye(10, dtype=F64), shift)
    b = torch.cat([torch.zeros(1), torch.ones(10), torch.tensor([0.1]), torch.zeros(19)]).to(F64)[None]
    u, info = prdp.linear_solve(a, b, prdp.GMRES(500, 1e-10, restart=5), on_failure="return")
    assert info.status.item() == prdp.SolveStatus.STAGNATED and info.residual.item() < 0.1
    torch.testing.assert_close(u[0, 1:11], torch.ones(10, dtype=F64), rtol=0, atol=0.1)


@pytest.mark.parametrize("k", [40, 60, 150])
def test_a_mean_of_b_is_told_whether_u_has_grown_or_not(k):
    n = 40
    a = torch.diag(torch.tensor([1.0, *[2.0] * (n - 2), 1.0])).to(F64)
    a -= torch.diag(torch.ones(n - 1, dtype=F64), 1) + torch.diag(torch.ones(n - 1, dtype=F64), -1)
    b = torch.randn(1, n, dtype=F64, generator=torch.Generator().manual_seed(0))
    _, info = prdp.linear_solve(a, b, prdp.BiCGStab(k, 1e-8), on_failure="return")
    assert info.status.item() == prdp.SolveStatus.INCONSISTENT


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("shape", [(3, 3), (6, 3), (4, 4, 4)])
@pytest.mark.parametrize("share", [1e-2, 1.0])
def test_a_constant_that_grows_within_few_products_is_told(shape, share, dtype):
    # Few distinct eigenvalues: CG is through after five products, and stagnates after some twenty.
    axes = torch.eye(len(shape), dtype=torch.long)
    offsets = [(0,) * len(shape), *map(tuple, torch.cat([-axes, axes]).tolist())]
    values = torch.full((1, len(offsets), *shape), -1.0, dtype=dtype)
    values[:, 0] = len(offsets) - 1
    a = operators.Stencil(values, offsets, boundary="periodic")
    for seed in range(10):
        b = torch.randn(1, 1, *shape, dtype=F64, generator=torch.Generator().manual_seed(seed))
        b = (b - b.mean() + share).to(dtype)
        u, info = prdp.linear_solve(a, b, prdp.CG(2000), on_failure="return")
        assert bool(info.failed.all()), (seed, info, float(u.norm()))


def test_bicgstab_on_a_markov_generator_is_told_of_both_null_spaces():
    rates = torch.rand(50, 50, dtype=F64, generator=torch.Generator().manual_seed(0)).fill_diagonal_(0)
    a = torch.diag(rates.sum(1)) - rates
    b = torch.randn(1, 50, dtype=F64, generator=torch.Generator().manual_seed(1))
    with pytest.warns(UserWarning, match="A maps the constant to zero, so it is singular; name both null spaces"):
        _, info = prdp.linear_solve(a, b, prdp.BiCGStab(500))
    assert float(info.residual) > 1e-2
