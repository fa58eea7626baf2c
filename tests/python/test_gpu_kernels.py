"""The kernels of a GPU, run as fibers on the CPU, beside the CPU's own loops: the same methods and verdicts."""

import pytest
import torch
from fibers import BACKWARD, SHUFFLED, Fibers, barriers

import prdp_torch as prdp
from prdp_torch import operators

F32, F64 = torch.float32, torch.float64
SHAPE = (6, 7)
OFFSETS = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
TEAMS = {"cells": 16}  # three blocks for a sample of SHAPE


def noise(*shape, seed=0, dtype=F64):
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed)).to(dtype)


def coefficients(dtype, rows=3):
    """Dominant, not symmetric, far from the order of one, one set for each sample."""
    c = noise(rows, 5, *SHAPE, seed=1)
    c[:, 0] = 5.0 + c[:, 0].abs()
    return (c * torch.tensor([1.0, 2.0**40, 2.0**-30])[:rows, None, None, None]).to(dtype)


def symmetric(dtype):
    return operators.Diffusion(noise(3, *SHAPE, seed=2, dtype=dtype).exp(), shift=50.0, boundary=("flux", "periodic"))


FAR = [(0, 0), (2, -1), (-1, 2)]


def far_stencil():
    return torch.stack([noise(*SHAPE).abs() + 4, noise(*SHAPE), noise(*SHAPE)])[None]


def sparse(matrices, dtype):
    """Dominant, a third of the entries, each matrix with as many but in other places; one row is its diagonal alone."""
    a = 9.0 * torch.eye(9, dtype=dtype).repeat(matrices, 1, 1)
    for m in range(matrices):
        places = torch.randperm(72, generator=torch.Generator().manual_seed(m))[:18]
        rows, cols = places // 8 + 1, places % 9
        keep = (rows < 9) & (rows != cols)
        a[m, rows[keep], cols[keep]] = noise(18, seed=m, dtype=dtype)[keep]
    stored = (a != 0).sum((1, 2))
    for m in range(matrices):  # as many in each
        free = (a[m, 1:] == 0).nonzero()[: int(stored.max() - stored[m])]
        a[m, free[:, 0] + 1, free[:, 1]] = 0.5
    return a


def nearly_singular():
    """In float32: GMRES damps its least squares."""
    left, right = (torch.linalg.qr(noise(4, 4, seed=seed))[0] for seed in (7, 8))
    return left @ torch.diag(torch.tensor([1.0, 0.7, 0.5, 4e-7], dtype=F64)) @ right


HOLDING = noise(3, 3, 4, seed=6).exp()  # h of a side, which holds u at a cell
HOLDING[:, 1, 2] = torch.inf

OPERATORS = {
    "heat 1D": lambda dtype: operators.Heat((11,), torch.tensor(0.03, dtype=dtype), 1.0),
    "heat 2D": lambda dtype: operators.Heat(SHAPE, torch.tensor(0.03, dtype=dtype), 1.0, length=(1.0, 2.0)),
    "poisson 3D": lambda dtype: operators.Poisson((3, 4, 5)),
    "diffusion": symmetric,
    "robin": lambda dtype: operators.Diffusion(
        noise(3, 3, 4, 5, seed=2, dtype=dtype).exp(),
        shift=20 + noise(1, 3, 4, 5, seed=4, dtype=dtype),
        boundary=("periodic", ("zero", ("robin", 3.0)), (("robin", HOLDING.to(dtype)), "flux")),
        length=(1.0, 2.0, 0.5),
        faces="arithmetic",
    ),
    "per axis": lambda dtype: operators.Diffusion(
        noise(3, 2, *SHAPE, seed=2, dtype=dtype).exp(),
        shift=20.0,
        boundary=("periodic", ("zero", ("robin", 3.0))),
        length=(1.0, 2.0),
        per_axis=True,
    ),
    "closed": lambda dtype: operators.Diffusion(noise(1, 8, seed=2, dtype=dtype).exp(), boundary="flux"),
    "stencil": lambda dtype: operators.Stencil(coefficients(dtype), OFFSETS, ("zero", "periodic")),
    "far stencil": lambda dtype: operators.Stencil(far_stencil().to(dtype), FAR, "zero"),
    "burgers": lambda dtype: operators.Burgers(noise(3, 2, *SHAPE, dtype=dtype), 0.05, 0.02),
    "burgers 1D": lambda dtype: operators.Burgers(noise(1, 1, 11, dtype=dtype), torch.tensor(0.05), 0.02),
    "navier-stokes": lambda dtype: operators.NavierStokes(noise(3, 3, *SHAPE, dtype=dtype), 0.05, 0.02),
    "two rows": lambda dtype: operators.NavierStokes(noise(1, 2, 2, 7, dtype=dtype), 0.05, 0.2),
    "sparse": lambda dtype: sparse(3, dtype)[0].to_sparse_csr(),
    "sparse matrices": lambda dtype: sparse(3, dtype).to_sparse_csr(),
    "matrix": lambda dtype: 9 * torch.eye(9, dtype=dtype) + noise(9, 9, dtype=dtype),
    "singular": lambda dtype: nearly_singular().to(dtype),
    "matrices": lambda dtype: 9 * torch.eye(9, dtype=dtype) + noise(3, 9, 9, dtype=dtype),
}  # fmt: skip
SYMMETRIC = ["heat 1D", "heat 2D", "poisson 3D", "diffusion", "robin", "per axis"]
ANY = prdp.Jacobi, prdp.BiCGStab, prdp.GMRES


def right_hand_sides(name, dtype):
    if name.startswith(("matri", "sparse")) or name == "singular":
        return noise(3, 4 if name == "singular" else 9, seed=3, dtype=dtype)
    shape = {
        "heat 1D": (11,),
        "burgers 1D": (11,),
        "poisson 3D": (3, 4, 5),
        "robin": (3, 4, 5),
        "closed": (8,),
        "two rows": (2, 7),
    }.get(name, SHAPE)
    channels = {"burgers": 2, "stencil": 2, "navier-stokes": 3, "two rows": 3}.get(name, 1)
    return noise(3, channels, *shape, seed=3, dtype=dtype)


def solver(method, **settings):
    settings = {"max_iter": 200, **settings}
    return method(restart=4, **settings) if method is prdp.GMRES else method(**settings)


def solve(a, b, solver, device=None, **options):
    """u and the report; on the fibers with the settings `device`."""
    if device is None:
        return prdp.linear_solve(a, b, solver=solver, on_failure="return", **options)
    with Fibers(**device):
        return prdp.linear_solve(a, b, solver=solver, on_failure="return", **options)


def agree(mine, other, dtype, slack=300.0, method=None):
    (u, info), (v, report) = mine, other
    assert info.status.tolist() == report.status.tolist()
    # The residual of BiCGStab is no smooth sequence, and where it crosses rtol depends on the order of sums.
    erratic = report.iterations.max() // 20 if method is prdp.BiCGStab else 0
    assert (info.iterations - report.iterations).abs().max() <= 1 + erratic
    scale = v.flatten(1).norm(dim=1).clamp(min=torch.finfo(dtype).tiny)
    assert ((u - v).flatten(1).norm(dim=1) <= slack * torch.finfo(dtype).eps * scale).all()


SADDLES = ["navier-stokes", "two rows"]  # zeros on the diagonal
CASES = [(name, method) for name in OPERATORS if name not in ("singular", "closed", *SADDLES) for method in ANY]
CASES += [(name, prdp.GMRES) for name in SADDLES]
CASES += [("closed", method) for method in (prdp.CG, prdp.MINRES, prdp.GMRES)]
CASES += [(name, method) for name in SYMMETRIC for method in (prdp.CG, prdp.MINRES, prdp.SteepestDescent)]
CASES += [("heat 1D", prdp.Chebyshev), ("heat 2D", prdp.Chebyshev)]


@pytest.mark.parametrize("name, method, dtype", [(*case, (F32, F64)[n % 2]) for n, case in enumerate(CASES)])
def test_methods_and_operators_are_those_of_the_cpu(name, method, dtype):
    if method is prdp.Jacobi and name == "far stencil":
        method = prdp.GMRES
    a, b = OPERATORS[name](dtype), right_hand_sides(name, dtype)
    rtol = 1e-5 if dtype == F32 else 1e-12
    mine, other = (solve(a, b, solver(method, rtol=rtol), device) for device in ({}, None))
    agree(mine, other, dtype, slack=5 * rtol / torch.finfo(dtype).eps, method=method)
    if dtype == F64:  # with a team of blocks, after as many iterations as are asked for
        few = solver(method, rtol=0.0, max_iter=3)
        agree(solve(a, b, few, TEAMS), solve(a, b, few), dtype, slack=1e4)


DIVIDED = [(name, method) for name in ("diffusion", "robin") for method in (prdp.CG, prdp.MINRES)]
DIVIDED += [(name, method) for name in ("diffusion", "stencil", "matrices") for method in (prdp.GMRES, prdp.BiCGStab)]


@pytest.mark.parametrize(("name", "method", "dtype"), [(*case, (F64, F32)[n % 2]) for n, case in enumerate(DIVIDED)])
def test_the_diagonal_as_preconditioner_is_that_of_the_cpu(name, method, dtype):
    a, b = OPERATORS[name](dtype), right_hand_sides(name, dtype)
    rtol = 1e-5 if dtype == F32 else 1e-12
    divided = solver(method, rtol=rtol, preconditioner="diagonal")
    mine, other = (solve(a, b, divided, device) for device in ({}, None))
    agree(mine, other, dtype, slack=5 * rtol / torch.finfo(dtype).eps)
    assert mine[1].way == "kernel" and mine[1].solved.all()


SWAP, ONES = torch.tensor([[0.0, 1.0], [1.0, 0.0]]), torch.tensor([1.0, 0.0])
FIRST_TWICE_SECOND = torch.tensor([[1.0, 2.0], [2.0, 1.0]])  # Jacobi doubles its error
ENDS = [  # the status of one sample, what it is made of, and a method
    ("BREAKDOWN", SWAP, ONES, prdp.CG(9)),
    ("BREAKDOWN", SWAP, ONES, prdp.SteepestDescent(9)),
    ("BREAKDOWN", SWAP, ONES, prdp.BiCGStab(9)),
    ("STAGNATED", SWAP, ONES, prdp.GMRES(40, restart=1)),
    ("CONVERGED_BREAKDOWN", SWAP, ONES, prdp.GMRES(9, restart=2)),
    ("DIVERGED", FIRST_TWICE_SECOND, ONES, prdp.Jacobi(99)),
    ("OVERFLOW", 1e-20 * torch.eye(2), 1e30 * ONES, prdp.CG(9)),
    ("OVERFLOW", 1e-20 * torch.eye(2), 1e30 * ONES, prdp.GMRES(9, restart=2)),
]


@pytest.mark.parametrize(("status", "a", "b", "method"), ENDS)
def test_each_end_of_a_sample_is_that_of_the_cpu(status, a, b, method):
    """Small whole numbers, so not a bit differs; beside a sample of which nothing is wrong."""
    matrices, right = torch.stack([a, torch.diag(torch.tensor([2.0, 4.0]))]), torch.stack([b, torch.ones(2)])
    (u, info), (v, report) = (solve(matrices, right, method, device) for device in ({}, None))
    assert prdp.SolveStatus(int(info.status[0])).name == status and info.way == "kernel"
    assert info.status.tolist() == report.status.tolist() and torch.equal(u[0], v[0])
    torch.testing.assert_close(u[1], v[1])
    for mine, other in zip(info, report, strict=True):
        assert not isinstance(mine, torch.Tensor) or torch.equal(mine[0], other[0])


BITS = [("heat 2D", prdp.Jacobi), ("heat 2D", prdp.CG), ("diffusion", prdp.GMRES)]


@pytest.mark.parametrize(("name", "method"), BITS)
def test_bits_depend_neither_on_the_order_of_threads_nor_on_neighbours(name, method):
    a, b = OPERATORS[name](F32), right_hand_sides(name, F32)
    for device in ({}, TEAMS, {"block_memory": 2 * 4 * 42}):  # a few vectors in the block, the others beyond
        wanted, report = solve(a, b, solver(method), device)
        for order in (BACKWARD, SHUFFLED):
            u, info = solve(a, b, solver(method), {**device, "order": order})
            assert torch.equal(u, wanted) and torch.equal(info.residual, report.residual)
        alone, _ = (
            solve(OPERATORS["heat 2D"](F32), b[1:2], solver(method), device) if name == "heat 2D" else (None, None)
        )
        assert alone is None or torch.equal(alone[0], wanted[1])


STENCIL = {"singular": 4.0, "indefinite": 1.0, "definite": 4.3}


def periodic(centre, dtype, **options):
    c = -torch.ones(4, 5, *SHAPE, dtype=dtype)
    c[:, 0] = centre
    return operators.Stencil(c, OFFSETS, "periodic", **options)


FAILING = [prdp.Jacobi, prdp.SteepestDescent, prdp.CG, prdp.MINRES, prdp.BiCGStab, prdp.GMRES]


@pytest.mark.parametrize(("kind", "method"), [(kind, method) for kind in STENCIL for method in FAILING])
def test_what_fails_is_told_as_on_the_cpu(kind, method):
    dtype = F32 if (list(STENCIL).index(kind) + FAILING.index(method)) % 2 else F64
    a = periodic(STENCIL[kind], dtype)
    b = noise(4, 1, *SHAPE, dtype=dtype)
    b[0], b[1, 0, 2, 2], b[2] = 0.0, torch.nan, b[2] * 1e-30
    few = solver(method, rtol=0.0, max_iter=12)
    assert solve(a, b, few, {})[1].status.tolist() == solve(a, b, few)[1].status.tolist()
    # Where iterations grow, rounding decides how they fail. What is said of u must be true.
    (u, info), (_, report) = (solve(a, b, solver(method, rtol=1e-4), device) for device in ({}, None))
    assert (info.solved == report.solved).all() and u.isfinite().all()
    left = (b - a.apply(u)).flatten(1).norm(dim=1) / b.flatten(1).norm(dim=1)
    told = info.residual[3].item()
    assert abs(left[3].item() - told) <= 1e-2 * told + 100 * torch.finfo(dtype).eps or info.status[3] == -7


@pytest.mark.parametrize("method", [prdp.CG, prdp.GMRES, prdp.BiCGStab])
def test_null_spaces_and_starts(method):
    basis = torch.ones(1, *SHAPE, dtype=F64)
    b = noise(4, 1, *SHAPE)
    b -= b.mean((-2, -1), keepdim=True)
    b[3] += 1.0  # outside of the range
    for named in ("constant", basis):
        a = periodic(4.0, F64, nullspace=named)
        mine, other = (solve(a, b, solver(method, rtol=1e-10), device) for device in (TEAMS, None))
        agree(mine, other, F64, slack=1e7)
        x0 = other[0] + 1e-3 * noise(4, 1, *SHAPE, seed=5)
        mine, other = (solve(a, b, solver(method, rtol=1e-10), device, x0=x0) for device in ({}, None))
        agree(mine, other, F64, slack=1e7)


@pytest.mark.parametrize("count", [8, 20, 60])
def test_an_iterate_above_b_is_handed_out_where_a_is_surely_definite(count):
    """Of a jump of 1e6 in float32, whose energy is less than the rounding of A would be."""
    kappa = torch.ones(1, 12, 12)
    kappa[:, 4:8, 4:8] = 1e6
    a, b = operators.Diffusion(kappa), torch.ones(1, 1, 12, 12)
    (u, info), (v, report) = (solve(a, b, prdp.CG(count, rtol=0.0), device) for device in ({}, None))
    for each in (info, report):
        assert each.status.tolist() == [prdp.SolveStatus.MAX_ITER] and each.iterations.tolist() == [count]
    assert report.residual > 1 and (u - v).norm() < 1e-3 * v.norm()


def test_zero_on_the_diagonal_and_infinite_entries():
    c = coefficients(F64)
    c[1, 0, 2, 3], c[2, 1, 0, 0] = 0.0, torch.inf
    a, b = operators.Stencil(c, OFFSETS, "zero"), noise(3, 1, *SHAPE)
    for method in (prdp.Jacobi, prdp.GMRES):
        mine, other = (solve(a, b, solver(method), device) for device in ({}, None))
        assert mine[1].status.tolist() == other[1].status.tolist()
    preconditioned = prdp.BiCGStab(max_iter=50, preconditioner="diagonal")
    mine, other = (solve(a, b, preconditioned, device) for device in ({}, None))
    agree(mine, other, F64, slack=1e11)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_a_gradient_beyond_the_range_of_its_dtype_is_zero_and_named(dtype):
    b = noise(3, 1, *SHAPE).to(dtype)
    b[1] *= 1e25 if dtype == F32 else 1e200
    c = periodic(4.3, dtype).tensors[0][:1].clone().requires_grad_()
    b.requires_grad_()
    with Fibers():
        a = operators.Stencil(c.expand(3, -1, -1, -1), OFFSETS, "periodic")
        u, info = prdp.linear_solve(a, b, solver=prdp.CG(9, 0.0), on_failure="zero_grad")
        gradients = torch.autograd.grad(u.square().sum(), (c, b))
        status = info.adjoint.status.tolist()
    assert all(t.isfinite().all() for t in gradients) and (gradients[1][1] == 0).all()
    assert [prdp.SolveStatus(s).name for s in status] == ["MAX_ITER", "OVERFLOW", "MAX_ITER"]


PATTERN = sparse(1, F64)[0].to_sparse_csr()
FIELDS = {  # made of one tensor, which gets a gradient
    "diffusion": (lambda t: operators.Diffusion(t, shift=1.0), lambda: noise(3, *SHAPE, seed=2).exp(), prdp.CG),
    "stencil": (lambda t: operators.Stencil(t, OFFSETS, "zero"), lambda: coefficients(F64, rows=1), prdp.BiCGStab),
    "burgers": (lambda t: operators.Burgers(t, 0.05, 0.02), lambda: noise(3, 2, *SHAPE), prdp.GMRES),
    "navier-stokes": (lambda t: operators.NavierStokes(t, 0.05, 0.02), lambda: noise(3, 2, *SHAPE), prdp.GMRES),
    "sparse": (
        lambda t: operators.Matrix.csr(PATTERN.crow_indices(), PATTERN.col_indices(), t, 9),
        lambda: PATTERN.values().clone(),
        prdp.BiCGStab,
    ),
}


@pytest.mark.parametrize("name", FIELDS)
def test_gradients_are_those_of_finite_differences(name):
    make, field, method = FIELDS[name]
    b = right_hand_sides(name, F64)

    def u(t, rhs):
        if name != "navier-stokes":
            return prdp.linear_solve(make(t), rhs, solver=solver(method, rtol=1e-13))[0]
        rhs = rhs - rhs.mean((-2, -1), keepdim=True) * torch.tensor([0.0, 0.0, 1.0]).view(3, 1, 1)  # of the pressure
        return prdp.linear_solve(make(t), rhs, solver=prdp.GMRES(40, 1e-13, restart=40))[0][:, :2]

    with Fibers(threads=32):
        inputs = (field().requires_grad_(), b.requires_grad_())
        assert torch.autograd.gradcheck(u, inputs, fast_mode=True, atol=1e-6)


def outcomes(left_out):
    """What methods give with this barrier left out, on one block and on teams, in three orders."""
    found = []
    cases = [("heat 2D", prdp.CG), ("diffusion", prdp.GMRES), ("heat 2D", prdp.Chebyshev), ("singular", prdp.GMRES)]
    for name, method in cases:
        a, b = OPERATORS[name](F32), right_hand_sides(name, F32)
        for device in ({"block_memory": 0}, TEAMS):
            for order in (BACKWARD, SHUFFLED):
                try:
                    u, info = solve(
                        a, b, solver(method, rtol=0.0, max_iter=4), {**device, "order": order, "left_out": left_out}
                    )
                except RuntimeError:
                    found.append("irregular")
                    continue
                found.append((u.nan_to_num(7.0).flatten().tolist(), info.residual.nan_to_num(7.0).tolist()))
    return found


def test_every_barrier_is_needed():
    wanted = outcomes(left_out=0)
    unnoticed = [line for line in barriers() if outcomes(line) == wanted]
    assert not unnoticed
