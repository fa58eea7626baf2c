"""Derivatives in random cases, against identities of a solve, autograd through textbook loops, and torch.linalg."""

import pytest
import torch
from adjoints import F64, METHODS, gradients, matrices, of_b_alone
from helpers import random, statuses
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import grad

import prdp_torch as prdp


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
