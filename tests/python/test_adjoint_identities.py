"""Derivatives held against truths that share no code with them: the identities of a linear solve, autograd
through textbook loops, and torch.linalg. Random cases, then the kinds of faults that they found."""

import pytest
import torch
from helpers import field, golden, spd_matrices, statuses
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import grad

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64
METHODS = {
    "jacobi": prdp.Jacobi,
    "steepest_descent": prdp.SteepestDescent,
    "cg": prdp.CG,
    "gmres": lambda k, rtol: prdp.GMRES(k, rtol=rtol, restart=2),
    "direct": prdp.Direct,
}
modes = pytest.mark.parametrize("backward", ["implicit", "unrolled"])
methods = pytest.mark.parametrize("method", METHODS)


def jacobi(a, b, x, k):
    for _ in range(k):
        x = x + (b - a @ x) / a.diagonal()
    return x


def steepest_descent(a, b, x, k):
    for _ in range(k):
        r = b - a @ x
        x = x + r * (r @ r) / (r @ (a @ r))
    return x


def cg(a, b, x, k):
    r = p = b
    for _ in range(k):
        q = a @ p
        alpha = (r @ r) / (p @ q)
        x, before, r = x + alpha * p, r, r - alpha * q
        p = r + p * (r @ r) / (before @ before)
    return x


def gmres(a, b, x, k):
    """The least residual over span(r, A r), by its normal equations."""
    for _ in range(k):
        r = b - a @ x
        r = r / r.norm().detach()
        v = torch.stack([r, a @ r], 1)
        av = a @ v
        x = x + v @ torch.linalg.solve(av.T @ av, av.T @ (b - a @ x))
    return x


def direct(a, b, x, k):
    return torch.linalg.solve(a, b)


LOOPS = {loop.__name__: loop for loop in (jacobi, steepest_descent, cg, gmres, direct)}


def matrices(method, n, batch, seed, dtype=F64):
    """Well conditioned, and symmetric where the method asks for it."""
    a = spd_matrices(batch, n, seed)
    if method not in ("cg", "steepest_descent"):
        a = a + 0.3 * torch.randn(a.shape, dtype=F64, generator=torch.Generator().manual_seed(seed + 1)).triu(1)
    return a.to(dtype)


def random(*shape, seed, dtype=F64):
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed)).to(dtype)


def gradients(a, b, solver, g, create_graph=False, **options):
    """(A-bar, b-bar), u and the report."""
    a, b = a.detach().clone().requires_grad_(), b.detach().clone().requires_grad_()
    u, info = prdp.linear_solve(a, b, solver, **options)
    return grad(u, (a, b), g, create_graph=create_graph), u.detach(), info


def of_b_alone(a, b, solver, g, **options):
    b = b.detach().clone().requires_grad_()
    u, info = prdp.linear_solve(a, b, solver, **options)
    return grad(u, b, g)[0], info


def dots(x, y):
    return (x.double() * y.double()).flatten(1).sum(1)


cases = given(
    method=st.sampled_from(sorted(METHODS)),
    n=st.integers(3, 6),
    batch=st.integers(1, 3),
    k=st.integers(1, 12),
    rtol=st.sampled_from([0.0, 1e-6, 1e-2]),
    seed=st.integers(0, 10**6),
)


@settings(max_examples=60, deadline=None)
@cases
def test_unrolled_equals_autograd_through_a_textbook_loop(method, n, batch, k, rtol, seed):
    a, b, g = matrices(method, n, batch, seed), random(batch, n, seed=seed + 2), random(batch, n, seed=seed + 3)
    for create_graph in (False, True):
        (a_bar, b_bar), _, info = gradients(
            a, b, METHODS[method](k, rtol=rtol), g, create_graph, backward="unrolled", on_failure="return"
        )
        alone, _ = of_b_alone(a, b, METHODS[method](k, rtol=rtol), g, backward="unrolled", on_failure="return")
        _, before = prdp.linear_solve(a, b, METHODS[method](max(k - 1, 1), rtol=rtol), on_failure="return")
        for i in range(batch):
            mine = a[i].clone().requires_grad_(), b[i].clone().requires_grad_()
            residual = float(info.residual[i])
            solved = max(residual, float(before.residual[i])) < 3e-16 or info.status[i] == 2
            if not solved and residual < 1e-14:
                continue  # on the border between the two
            loop = LOOPS["direct" if solved else method]
            u = loop(*mine, torch.zeros_like(mine[1]), int(info.iterations[i]))
            expected = grad(u, mine, g[i], allow_unused=True)
            # Of what the last iteration starts from, rounding has taken that share.
            noise = 1e-10 if solved else 1e-11 + 1e-13 / residual
            # CG solves symmetric systems: other changes of A have a derivative of its own.
            both_ways = (lambda x: x + x.T) if method == "cg" and solved else (lambda x: x)
            for found, truth in (
                (both_ways(a_bar[i]), both_ways(expected[0])),
                (b_bar[i], expected[1]),
                (alone[i], expected[1]),
            ):
                assert (found - truth).norm() <= noise * truth.norm(), (method, create_graph, info)


@settings(max_examples=100, deadline=None)
@cases
def test_unrolled_gradients_keep_the_identities_of_a_solve(method, n, batch, k, rtol, seed):
    """u is linear in b and of degree -1 in A, whatever the method and the number of its iterations."""
    for dtype in (torch.float32, F64):
        a, b = matrices(method, n, batch, seed, dtype), random(batch, n, seed=seed + 2, dtype=dtype)
        g = random(batch, n, seed=seed + 3, dtype=dtype)
        solver = METHODS[method](k, rtol=rtol)
        (a_bar, b_bar), u, info = gradients(a, b, solver, g, backward="unrolled", on_failure="return")
        alone, _ = of_b_alone(a, b, solver, g, backward="unrolled", on_failure="return")
        epsilon = torch.finfo(dtype).eps
        sizes = [x.double().flatten(1).norm(dim=1) for x in (a_bar, b_bar, g)]
        for found, size in (
            (dots(b_bar, b), sizes[1] * b.double().norm(dim=1)),
            (dots(alone, b), sizes[1] * b.double().norm(dim=1)),
            (-dots(a_bar, a), sizes[0] * a.double().flatten(1).norm(dim=1)),
        ):
            bound = 1e3 * epsilon * (size + sizes[2] * u.double().norm(dim=1))
            assert ((found - dots(g, u)).abs() <= bound).all(), (method, dtype, info)


@settings(max_examples=40, deadline=None)
@cases
def test_both_modes_are_exact_at_convergence(method, n, batch, k, rtol, seed):
    a, b, g = matrices(method, n, batch, seed), random(batch, n, seed=seed + 2), random(batch, n, seed=seed + 3)
    b_bar = torch.linalg.solve(a.mT, g)
    a_bar = -b_bar.unsqueeze(-1) * torch.linalg.solve(a, b).unsqueeze(-2)
    for backward in ("implicit", "unrolled"):
        solver = METHODS[method](400, rtol=1e-13)
        found, _, info = gradients(a, b, solver, g, backward=backward)
        assert (info.residual <= 1e-12).all()
        # CG solves symmetric systems, and its derivative for others is its own.
        both_ways = (lambda x: x + x.mT) if method == "cg" else (lambda x: x)
        largest = float(a_bar.abs().max())
        torch.testing.assert_close(both_ways(found[0]), both_ways(a_bar), rtol=1e-8, atol=1e-8 * largest)
        torch.testing.assert_close(found[1], b_bar, rtol=1e-8, atol=1e-8 * float(b_bar.abs().max()))


@settings(max_examples=60, deadline=None)
@given(
    method=st.sampled_from(sorted(METHODS)),
    backward=st.sampled_from(["implicit", "unrolled"]),
    create_graph=st.booleans(),
    k=st.integers(1, 12),
    batch=st.integers(1, 4),
    bad=st.sampled_from(["nan_cotangent", "inf_cotangent", "nan_b", "inf_a", "zero_b"]),
    seed=st.integers(0, 10**6),
    data=st.data(),
)
def test_a_bad_sample_anywhere_in_the_batch_is_named_and_stays_alone(
    method, backward, create_graph, k, batch, bad, seed, data
):
    n, where = 5, data.draw(st.integers(0, batch - 1))
    a, b, g = matrices(method, n, batch, seed), random(batch, n, seed=seed + 2), random(batch, n, seed=seed + 3)
    solver, value = METHODS[method](k, rtol=1e-6), float(bad[:3]) if bad != "zero_b" else 0.0
    if bad == "zero_b":
        b[where] = value
    else:
        {"cotangent": g, "b": b, "a": a}[bad.split("_")[1]][where, 3] = value
    options = {"backward": backward, "on_failure": "return"}
    (a_bar, b_bar), _, info = gradients(a, b, solver, g, create_graph, **options)
    for i in range(batch):
        if i == where:
            continue
        own, _, _ = gradients(a[i : i + 1], b[i : i + 1], solver, g[i : i + 1], create_graph, **options)
        if create_graph and backward == "unrolled":  # in plain tensor operations
            torch.testing.assert_close(own[0][0], a_bar[i], rtol=1e-9, atol=1e-12)
            torch.testing.assert_close(own[1][0], b_bar[i], rtol=1e-9, atol=1e-12)
        else:
            assert torch.equal(own[0][0], a_bar[i]) and torch.equal(own[1][0], b_bar[i])
    assert a_bar.isfinite().all() and b_bar.isfinite().all() and not a_bar[where].any()
    assert bool(b_bar[where].any()) == (bad == "zero_b")
    if bad.endswith("cotangent"):
        assert statuses(info.adjoint)[where] == "NONFINITE_INPUT"
        with pytest.raises(torch.linalg.LinAlgError, match=rf"adjoint solve: 1 of {batch} .* sample {where} NONFINITE"):
            gradients(a, b, solver, g, create_graph, backward=backward)


# ---- the faults that these would have found


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
    # b = e₀ is solved by one iteration, exactly: only others need all 14.
    torch.testing.assert_close(run(b + 1e-3, g), expected, rtol=1e-12, atol=0.0)


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


def refuted_cases(method):
    """Float32 systems on which the recursive residual claims convergence in vain before the end."""
    if method == "steepest_descent":
        case = golden("failures")
        yield (*(torch.tensor(case[f"B02_0__{x}"], dtype=torch.float32) for x in "Ab"), 1e-5)
        return
    for seed, n in ((1, 40), (1, 80), (4, 80)):
        q, _ = torch.linalg.qr(random(n, n, seed=seed))
        a = (q * torch.logspace(0, 3, n, dtype=F64)) @ q.T
        yield (0.5 * (a + a.T)).float(), random(n, seed=seed + 9).float(), 1e-4


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
