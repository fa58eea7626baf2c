"""Derivatives where faults were found or would hide: growth, overflow, rounding, restarts, and empty problems."""

import pytest
import torch
from adjoints import F64, METHODS, gradients, matrices, of_b_alone
from helpers import field, golden, modes, random, statuses
from torch.autograd import grad

import prdp_torch as prdp
from prdp_torch import operators

methods = pytest.mark.parametrize("method", METHODS)


@pytest.mark.parametrize("needs_a", [False, True])
def test_sweeps_that_grow_are_no_solve(needs_a):
    """The derivative of 14 iterations is 14 transposed iterations, of the size of 1e13 here."""
    n = 16
    a = torch.eye(n, dtype=F64) - 10 * torch.diag(torch.ones(n - 1, dtype=F64), 1)
    b, g = torch.zeros(n, dtype=F64), torch.zeros(n, dtype=F64)
    b[0], g[0] = 1.0, 1.0
    solver = prdp.Jacobi(14, rtol=0.0)
    run = lambda b, g: gradients(a, b, solver, g, backward="unrolled")[0][1] if needs_a else of_b_alone(  # noqa: E731
        a, b, solver, g, backward="unrolled")[0]  # fmt: skip
    expected = torch.tensor([10.0**i if i < 14 else 0.0 for i in range(n)], dtype=F64)
    # b = e₀ is solved by one iteration, exactly: only others need all 14. With much more than that, no iterate would be
    # better than zero.
    torch.testing.assert_close(run(b + 1e-15, g), expected, rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("needs_a", [False, True])
def test_a_reverse_that_leaves_the_range_of_the_dtype_fails_in_words(needs_a):
    n = 40
    a = torch.eye(n) - 10 * torch.diag(torch.ones(n - 1), 1)
    bad, good = torch.zeros(n), torch.zeros(n)
    bad[0], good[n - 3] = 1.0, 1.0
    b = torch.zeros(2, n)
    b[:, 0] = 1.0  # u = b, while the way back grows by 10 an iteration from there
    run = gradients if needs_a else of_b_alone
    solver = prdp.Jacobi(40, rtol=0.0)
    alone = run(a, b[1:], solver, good[None], backward="unrolled")[0]
    g = torch.stack([bad, good])
    with pytest.raises(torch.linalg.LinAlgError, match="adjoint solve: 1 of 2 samples failed: sample 0 OVERFLOW"):
        run(a, b, solver, g, backward="unrolled")
    both, *_, info = run(a, b, solver, g, backward="unrolled", on_failure="return")
    assert statuses(info.adjoint)[0] == "OVERFLOW"
    for one, two in zip(*((both, alone) if needs_a else ((both,), (alone,))), strict=True):
        assert torch.equal(one[1:] if one.shape != a.shape else one, two) and two.any()
    assert not (both[1] if needs_a else both)[0].any()


def ill_conditioned(n, seed):
    q, _ = torch.linalg.qr(random(n, n, seed=seed))
    a = (q * torch.logspace(0, 3, n, dtype=F64)) @ q.T
    return (0.5 * (a + a.T)).float(), random(n, seed=seed + 9).float()


def refuted_cases(method):
    """Float32 systems on which the recursive residual claims convergence in vain before the end."""
    if method == "steepest_descent":
        case = golden("failures")
        yield (*(torch.tensor(case[f"B02_0__{x}"], dtype=torch.float32) for x in "Ab"), 1e-5)
        return
    cases = (ill_conditioned(n, seed) for n, seed in ((40, 1), (80, 1), (80, 4)))
    yield from ((a, b, 1e-4) for a, b in cases)
    for seed in range(1, 200):  # which of them has a claim in vain depends on the rounding of a processor
        a, b = ill_conditioned(120, seed)
        info = prdp.linear_solve(a, b, prdp.CG(3000, rtol=1e-4), on_failure="return")[1]
        if int(info.operator_applications) > int(info.iterations) + 1:
            yield a, b, 1e-4
            return


@pytest.mark.parametrize("create_graph", [False, True])
@pytest.mark.parametrize("method", ["steepest_descent", "cg"])
def test_going_on_from_the_true_residual_is_part_of_the_map(method, create_graph):
    found = 0
    for a, b, rtol in refuted_cases(method):
        g = random(*b.shape, seed=21).float()
        (a_bar, b_bar), u, info = gradients(
            a, b, METHODS[method](3000, rtol=rtol), g, create_graph, backward="unrolled", on_failure="return"
        )
        if not create_graph:
            # Besides those of the iterations: one for the claim at the end, one for each in vain.
            found += int(info.operator_applications) > int(info.iterations) + 1
            (checkpointed, _), *_ = gradients(
                a, b, METHODS[method](3000, rtol=rtol), g, backward="unrolled", on_failure="return", checkpoint_every=7
            )
            assert torch.equal(checkpointed, a_bar)
        of_u = float(g.double() @ u.double())
        assert abs(float(b_bar.detach().double() @ b.double()) - of_u) < 1.2e-5 * float(
            b_bar.detach().norm() * b.norm()
        )
        assert abs(float((a_bar.detach().double() * a.double()).sum()) + of_u) < 2e-5 * abs(of_u)
    assert create_graph or found > 0


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("rtol", [0.0, 1e-5])
@pytest.mark.parametrize("create_graph", [False, True])
@methods
def test_a_sample_solved_to_rounding_has_the_implicit_derivative(method, dtype, rtol, create_graph):
    """The branch that ran has another one for A: it leaves out steps for want of a residual."""
    n = 6
    a = torch.eye(n, dtype=dtype).repeat(3, 1, 1)
    a[1] = 4 * a[1]
    if method != "steepest_descent":
        a[2, 2:, 2:] *= 3  # two eigenvalues
    b, g = random(3, n, seed=0, dtype=dtype), random(3, n, seed=1, dtype=dtype)
    b_bar = torch.linalg.solve(a.mT, g)
    a_bar = -b_bar.unsqueeze(-1) * torch.linalg.solve(a, b).unsqueeze(-2)
    solver = METHODS[method](60, rtol=rtol)
    (found, other), _, info = gradients(a, b, solver, g, create_graph, backward="unrolled")
    close = {"rtol": 0.0, "atol": 50 * torch.finfo(dtype).eps}
    torch.testing.assert_close(found.detach(), a_bar, **close)
    torch.testing.assert_close(other.detach(), b_bar, **close)
    if method != "jacobi" or rtol > 0:  # else sweeps, which are smooth
        assert (info.adjoint.residual < 10 * torch.finfo(dtype).eps).all()


@modes
@methods
def test_no_iterations_and_no_samples_have_zeros_for_a_derivative(method, backward):
    a, b = matrices(method, 4, 2, 0), random(2, 4, seed=1)
    for create_graph in (False, True):
        cases = [
            (a, b, METHODS[method](0, rtol=1e-5)),
            (a[:0], b[:0], METHODS[method](3, rtol=1e-5)),
            (a[0], b[:0], METHODS[method](3, rtol=1e-5)),
            (a, b * float("nan"), METHODS[method](3, rtol=1e-5)),
        ]
        for matrix, rhs, solver in cases:
            g = torch.ones_like(rhs)
            found, *_ = gradients(matrix, rhs, solver, g, create_graph, backward=backward, on_failure="return")
            for one, like in zip(found, (matrix, rhs), strict=True):
                assert one is not None and one.shape == like.shape and not one.any()
        heat = prdp.Heat((5,), torch.tensor(1e-2, requires_grad=True), 1.0, METHODS[method](0, rtol=0.0), backward)
        u = field((5,)).requires_grad_()
        states = heat.rollout(u, 2)
        assert not grad(states[:, 1:].sum(), u, create_graph=create_graph)[0].any()


def test_a_small_consistent_part_is_solved():
    """A share of 1e-10 beside the null space is no rounding in float64."""
    shape, generator = (4, 3), torch.Generator().manual_seed(0)
    w = torch.randn(1, 3, *shape, dtype=F64, generator=generator)
    a = operators.NavierStokes(w, 1e-2, 0.1)
    b = 1e-10 * a.apply(torch.randn(1, 3, *shape, dtype=F64, generator=generator))
    small, _ = prdp.linear_solve(a, b, prdp.GMRES(9, restart=36, rtol=1e-12))
    b[0, 2] += 1.0  # a pressure's mean: outside the range
    u, info = prdp.linear_solve(a, b, prdp.GMRES(9, restart=36, rtol=1e-12), on_failure="return")
    assert statuses(info) == ["INCONSISTENT"]
    assert (u - small).norm() < 1e-4 * small.norm()  # b lost digits beside 1


@modes
@pytest.mark.parametrize("method", [m for m in METHODS if m != "direct"])
@pytest.mark.parametrize("exponent", [-66, -60, -50, 50, 60])
def test_operators_far_from_the_order_of_one(method, backward, exponent):
    """A power of two in A is one in the results; a number out of range fails in words."""
    a, b, g = (x.float() for x in (matrices(method, 5, 1, 4)[0], 1e-6 * random(5, seed=5), random(5, seed=6)))
    solver, factor = METHODS[method](3, rtol=0.0), 2.0**exponent
    (a_bar, b_bar), u, _ = gradients(a, b, solver, g, backward=backward)
    for size in (1.0, 2.0**20):  # of b
        (found, other), v, info = gradients(a * factor, b * size, solver, g, backward=backward, on_failure="return")
        expected = a_bar.double() / factor**2 * size
        if expected.abs().max() >= torch.finfo(torch.float32).max:
            assert statuses(info.adjoint) == ["OVERFLOW"] and not found.any() and not other.any()
        elif statuses(info) == ["MAX_ITER"]:
            # Squares of the products are subnormal beyond 1e-19, in the solve itself.
            close = {"rtol": 0.0 if abs(exponent) <= 50 else 1e-3, "atol": 1e-38}
            torch.testing.assert_close(v, u / factor * size, **close)
            torch.testing.assert_close(other, b_bar / factor, **close)
            torch.testing.assert_close(found, expected.float(), **close)
        else:
            assert statuses(info)[0] in ("OVERFLOW", "BREAKDOWN") and abs(exponent) >= 60


@modes
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_no_gradient_is_nonfinite_with_a_positive_status(dtype, backward):
    half = torch.tensor(1e-3, dtype=torch.float16)
    makers = {
        "winds": (lambda w: operators.Burgers(w, 1e-2, 1e-2), 1e20 * field((8,), 1, 3, dtype)),
        "dt": (lambda nu: operators.Heat((8,), nu, 1e300), half.double()),
        "half": (lambda nu: operators.Heat((8,), nu, 1.0), half),
    }
    overflowed = 0
    for make, tensor in makers.values():
        for method in ("jacobi", "steepest_descent", "cg", "gmres"):
            for seed in range(3):
                b, t = 3e3 * field((8,), 2, seed, dtype).requires_grad_(), tensor.clone().requires_grad_()
                u, info = prdp.linear_solve(
                    make(t), b, METHODS[method](5, rtol=1e-6), backward=backward, on_failure="return"
                )
                found = grad(u, (b, t), torch.ones_like(u))
                assert u.isfinite().all() and all(x.isfinite().all() for x in found)
                overflowed += statuses(info.adjoint).count("OVERFLOW")
    assert overflowed > 0


@pytest.mark.parametrize("kind", ["heat_1d", "heat_2d", "dense", "csr", "burgers"])
def test_direct_gives_the_same_bits_in_any_company(kind):
    batch, seeds = 7, torch.Generator().manual_seed(2)
    shape = {"heat_1d": (1, 9), "heat_2d": (1, 5, 6), "burgers": (1, 6)}.get(kind, (9,))
    b, g = (torch.randn(batch, *shape, dtype=F64, generator=seeds) for _ in range(2))
    many = matrices("direct", 9, batch, 1) if kind in ("dense", "csr") else field((6,), batch, 1)
    make = {
        "heat_1d": lambda rows: operators.Heat((9,), 1e-2, 1.0),
        "heat_2d": lambda rows: operators.Heat((5, 6), 1e-2, 1.0),
        "dense": lambda rows: operators.Matrix(many[rows]),
        "csr": lambda rows: operators.Matrix(many[rows].to_sparse_csr()),
        "burgers": lambda rows: operators.Burgers(many[rows], 1e-2, 0.2),
    }[kind]
    for k in (1, 2):

        def b_bar(rows, k=k):
            x = b[rows].clone().requires_grad_()
            u, _ = prdp.linear_solve(make(rows), x, prdp.Direct(k), backward="unrolled")
            return grad(u, x, g[rows])[0]

        together, order = b_bar(torch.arange(batch)), torch.randperm(batch, generator=seeds)
        assert torch.equal(b_bar(order), together[order])
        for i in range(batch):
            assert torch.equal(b_bar(torch.tensor([i])), together[i : i + 1])


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_a_gradient_of_the_operator_that_overflows_fails_in_words(backward):
    kappa, b = (random(1, 16, seed=1).exp().float(), (1e21 * random(2, 1, 16, seed=2)).float())  # fmt: skip
    kappa, b = kappa.requires_grad_(), b.requires_grad_()
    a = operators.Diffusion(kappa, shift=1.0)
    u, info = prdp.linear_solve(a, b, prdp.Direct(), backward=backward)
    with pytest.raises(torch.linalg.LinAlgError, match="adjoint solve: 2 of 2 samples failed: sample 0 OVERFLOW"):
        grad(u.square().sum(), (b, kappa))
    assert statuses(info.adjoint) == ["OVERFLOW"] * 2


def test_the_report_of_an_unrolled_derivative_says_that_it_has_no_residual():
    u, info = prdp.linear_solve(
        operators.Heat((9,), 1e-3, 1.0), field((9,)).requires_grad_(), prdp.Jacobi(3), backward="unrolled"
    )
    u.sum().backward()
    assert "residual not measured, " in repr(info.adjoint)
