"""CG and GMRES preconditioned by the diagonal, against dense numpy."""

import numpy as np
import pytest
import torch
from helpers import dense_burgers, dense_heat, dense_laplacian, field, spd_matrices, statuses
from torch.autograd import gradcheck, gradgradcheck

import prdp_torch as prdp
from prdp_torch import _C, operators


def cg(max_iter, rtol=0.0):
    return prdp.CG(max_iter, rtol=rtol, preconditioner="diagonal")


def gmres(max_iter, rtol=0.0, restart=3):
    return prdp.GMRES(max_iter, rtol=rtol, restart=restart, preconditioner="diagonal")


def stretched(matrices):
    """S A S: the diagonal spans two orders of magnitude."""
    s = torch.logspace(-0.5, 0.5, matrices.shape[-1], dtype=matrices.dtype)
    return s[:, None] * matrices * s


MATRICES = stretched(spd_matrices(3, 6))
UNSYMMETRIC = MATRICES * (1 + 0.3 * torch.randn(3, 6, 6, generator=torch.Generator().manual_seed(5)).double().tril(-1))
K_TERMS = torch.logspace(-1, 1, 6, dtype=torch.float64)
WINDS = field((6,), 3, seed=1)


def function(k, **options):
    def matvec(v, k):
        return (1 + k) * v - 0.05 * (v.roll(1, -1) + v.roll(-1, -1))

    return operators.Function(matvec, tensors=(k,), diagonal=lambda k: 1 + k, **options)


def dense_function(k):
    eye = np.eye(len(k))
    return np.diag(1 + k.numpy()) - 0.05 * (np.roll(eye, 1, 0) + np.roll(eye, -1, 0))


# name: (operator out of its tensors, the tensors, shape of a right-hand side, dense matrices of the samples)
SYMMETRIC = {
    "heat": (lambda nu: operators.Heat((6,), nu, 1.0), (torch.tensor(2e-3, dtype=torch.float64),), (1, 6),
             [dense_heat((6,), 2e-3)] * 3),
    "poisson": (lambda: operators.Poisson((2, 3)), (), (1, 2, 3), [dense_laplacian((2, 3))] * 3),
    "dense": (operators.Matrix, (MATRICES[0],), (6,), [MATRICES[0].numpy()] * 3),
    "negative": (operators.Matrix, (-MATRICES,), (6,), list(-MATRICES.numpy())),
    "csr": (lambda m: operators.Matrix(m.to_sparse_csr()), (MATRICES,), (6,), list(MATRICES.numpy())),
    "function": (lambda k: function(k, symmetric=True), (K_TERMS,), (6,), [dense_function(K_TERMS)] * 3),
}  # fmt: skip
OTHERS = {
    "unsymmetric": (operators.Matrix, (UNSYMMETRIC,), (6,), list(UNSYMMETRIC.numpy())),
    "burgers": (lambda w: operators.Burgers(w, 2e-2, 0.2), (WINDS,), (1, 6),
                [dense_burgers(w.numpy(), 2e-2, 0.2) for w in WINDS]),
}  # fmt: skip
ALL = SYMMETRIC | OTHERS
CASES = [(name, cg) for name in SYMMETRIC] + [(name, gmres) for name in ALL]
IDS = [f"{solver.__name__}-{name}" for name, solver in CASES]
CSR_WARNS = pytest.mark.filterwarnings("ignore:linear_solve. the gradient of a sparse CSR tensor")


def rhs(shape, dtype=torch.float64):
    return torch.randn(3, *shape, dtype=torch.float64, generator=torch.Generator().manual_seed(4)).to(dtype)


def in_plain_tensors(a, b, solver):
    return _C.solve_with_tensors(
        b, a.tensors, a.kind, a.shape, a.parameters, False, solver.method, solver.max_iter, solver.rtol, solver.restart,
        preconditioner="diagonal",
    )  # fmt: skip


def textbook_cg(a, b, iterations):
    """Saad, Iterative methods for sparse linear systems, algorithm 9.1, with M the diagonal."""
    x, r = np.zeros_like(b), b.copy()
    z = p = r / np.diag(a)
    for _ in range(iterations):
        alpha = (r @ z) / (a @ p @ p)
        x = x + alpha * p
        after = r - alpha * (a @ p)
        z_after = after / np.diag(a)
        p = z_after + (after @ z_after) / (r @ z) * p
        r, z = after, z_after
    return x


def textbook_gmres(a, b, cycles, restart):
    """x += argmin ‖r - A M⁻¹ V y‖ over the Krylov space of A M⁻¹, by least squares."""
    x = np.zeros_like(b)
    for _ in range(cycles):
        r = b - a @ x
        krylov = [r / np.linalg.norm(r)]
        for _ in range(restart - 1):
            krylov.append(a @ (krylov[-1] / np.diag(a)))
            krylov[-1] = krylov[-1] / np.linalg.norm(krylov[-1])
        basis = np.linalg.qr(np.stack(krylov, -1))[0] / np.diag(a)[:, None]
        x = x + basis @ np.linalg.lstsq(a @ basis, r, rcond=None)[0]
    return x


@pytest.mark.parametrize("name, solver", CASES, ids=IDS)
def test_iterates_are_those_of_the_textbook(name, solver):
    make, tensors, shape, matrices = ALL[name]
    b, a = rhs(shape), make(*tensors)
    for k in (1, 2, 3):
        u, info = prdp.linear_solve(a, b, solver(k))
        for i, matrix in enumerate(matrices):
            flat = b[i].flatten().numpy()
            expected = textbook_cg(matrix, flat, k) if solver is cg else textbook_gmres(matrix, flat, k, 3)
            np.testing.assert_allclose(u[i].flatten(), expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max())
            true = np.linalg.norm(flat - matrix @ u[i].flatten().numpy()) / np.linalg.norm(flat)
            assert float(info.residual[i]) == pytest.approx(true, rel=1e-6, abs=1e-14)


@pytest.mark.parametrize("name, solver", CASES, ids=IDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_it_solves_in_the_loops_and_in_plain_tensors(name, solver, dtype):
    make, tensors, shape, matrices = ALL[name]
    b, a = rhs(shape, dtype), make(*(t.to(dtype if t.dim() else torch.float64) for t in tensors))
    rtol = 1e-5 if dtype == torch.float32 else 1e-11
    method = solver(60, rtol)
    u, info = prdp.linear_solve(a, b, method)
    v, report = in_plain_tensors(a, b, method)
    assert statuses(info) == ["CONVERGED"] * 3 and bool((info.residual <= rtol).all())
    assert bool((report[2] == 1).all()) and bool(((report[0] - info.iterations).abs() <= 1).all())
    for found in (u, v):
        for i, matrix in enumerate(matrices):
            flat = b[i].flatten().double().numpy()
            r = flat - matrix @ found[i].flatten().double().numpy()
            assert np.linalg.norm(r) <= 2 * rtol * np.linalg.norm(flat)


@pytest.mark.parametrize("name, solver", CASES, ids=IDS)
def test_plain_tensors_take_the_same_iterations(name, solver):
    make, tensors, shape, _ = ALL[name]
    b, a = rhs(shape), make(*tensors)
    for k in (0, 1, 3):
        method = solver(k)
        u, info = prdp.linear_solve(a, b, method)
        v, report = in_plain_tensors(a, b, method)
        torch.testing.assert_close(u, v, rtol=1e-8, atol=1e-10 * float(u.abs().max()))
        torch.testing.assert_close(info.operator_applications, report[3])


@CSR_WARNS
@pytest.mark.parametrize("name, solver", CASES, ids=IDS)
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_derivatives(name, solver, backward):
    make, tensors, shape, _ = ALL[name]
    symmetric = solver is cg and name in ("dense", "negative", "csr")
    method = solver(3) if backward == "unrolled" else solver(80, 1e-13)

    def solve(b, *tensors):
        # CG's iterates are defined for symmetric A: finite differences stay among those.
        kept = tuple((t + t.mT) / 2 for t in tensors) if symmetric else tensors
        return prdp.linear_solve(make(*kept), b, method, backward=backward, on_failure="return")[0]

    inputs = [t.clone().requires_grad_() for t in (rhs(shape), *tensors)]
    assert gradcheck(solve, inputs, rtol=1e-4, atol=1e-7)
    if name in ("heat", "dense", "function", "burgers"):
        assert gradgradcheck(solve, inputs, rtol=1e-3, atol=1e-6)


@CSR_WARNS
@pytest.mark.parametrize("name, solver", CASES, ids=IDS)
def test_replayed_iterations_equal_the_recorded_ones(name, solver):
    make, tensors, shape, _ = ALL[name]
    found = []
    for options in ({}, {"create_graph": True}, {"every": 2}):
        inputs = [t.clone().requires_grad_() for t in (rhs(shape), *tensors)]
        u, _ = prdp.linear_solve(
            make(*inputs[1:]), inputs[0], solver(3), backward="unrolled", checkpoint_every=options.pop("every", None)
        )
        found.append(torch.autograd.grad(u, inputs, torch.ones_like(u), **options))
    for one, two, three in zip(*found, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-9, atol=1e-11 * float(two.detach().abs().max()))
        assert torch.equal(one, three)


@pytest.mark.parametrize("solver", [cg, gmres])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_samples_do_not_touch_each_other_and_scaling_is_exact(solver, dtype):
    a, b = MATRICES.to(dtype), rhs((6,), dtype)
    u, info = prdp.linear_solve(a, b, solver(40, 1e-5))
    for i in range(3):
        alone, one = prdp.linear_solve(a[i : i + 1], b[i : i + 1], solver(40, 1e-5))
        assert torch.equal(alone[0], u[i]) and one.iterations[0] == info.iterations[i]
    for k in (-30, 12):
        scaled, _ = prdp.linear_solve(a, 2.0**k * b, solver(40, 1e-5))
        assert torch.equal(scaled, 2.0**k * u)
        scaled, _ = prdp.linear_solve(2.0**k * a, b, solver(40, 1e-5))
        assert torch.equal(scaled, 2.0**-k * u)


@pytest.mark.parametrize("solver", [cg, gmres])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("plain", [False, True])
def test_a_diagonal_matrix_takes_one_iteration_however_its_entries_spread(solver, dtype, plain):
    d = torch.tensor([1e-12, 1.0, -1.0, 1e12], dtype=dtype)
    if solver is cg:
        d = d.abs()
    b, status = torch.ones(1, 4, dtype=dtype), "CONVERGED" if solver is cg else "CONVERGED_BREAKDOWN"
    if plain:
        a = operators.Matrix(d.diag())
        u, report = in_plain_tensors(a, b, solver(1, 1e-5))
        assert prdp.SolveStatus(report[2].item()).name == status
    else:
        u, info = prdp.linear_solve(d.diag(), b, solver(1, 1e-5))
        assert statuses(info) == [status] and int(info.iterations) == 1
    torch.testing.assert_close(u, b / d, rtol=1e-5, atol=0.0)


def diffusion(kappa):
    """-∇·(κ ∇) with harmonic means on the faces, as a sparse matrix; κ (n, n)."""
    n = len(kappa)
    index = np.arange(n * n).reshape(n, n)
    rows, columns, values = [], [], []
    diagonal = np.zeros(n * n)
    for one, two, first, second in (
        (kappa[:-1], kappa[1:], index[:-1], index[1:]),
        (kappa[:, :-1], kappa[:, 1:], index[:, :-1], index[:, 1:]),
    ):
        face = (2 * one * two / (one + two)).ravel()
        first, second = first.ravel(), second.ravel()
        rows += [first, second]
        columns += [second, first]
        values += [-face, -face]
        np.add.at(diagonal, first, face)
        np.add.at(diagonal, second, face)
    for edge in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        np.add.at(diagonal, index[edge], 2 * kappa[edge])
    coo = torch.sparse_coo_tensor(
        np.stack([np.concatenate([*rows, index.ravel()]), np.concatenate([*columns, index.ravel()])]),
        np.concatenate([*values, diagonal]),
        check_invariants=True,
    )
    return coo.to_sparse_csr()


def test_a_diffusivity_of_large_contrast_takes_a_third_of_the_iterations():
    kappa = np.exp(2 * np.random.default_rng(0).standard_normal((64, 64)))
    a, b = diffusion(kappa), field((64 * 64,), batch=1)[:, 0]
    _, plain = prdp.linear_solve(a, b, prdp.CG(4000, rtol=1e-6))
    u, info = prdp.linear_solve(a, b, cg(4000, 1e-6))
    assert statuses(plain) == statuses(info) == ["CONVERGED"]
    assert 3 * int(info.iterations) <= int(plain.iterations)
    assert float((b[0] - a @ u[0]).norm() / b.norm()) <= 1e-6


def test_on_a_constant_diagonal_nothing_changes():
    b = field((20,))
    for with_it, without in ((cg(6), prdp.CG(6, rtol=0.0)), (gmres(2), prdp.GMRES(2, rtol=0.0, restart=3))):
        heat = operators.Heat((20,), 1e-3, 1.0)
        u, v = (prdp.linear_solve(heat, b, solver)[0] for solver in (with_it, without))
        torch.testing.assert_close(u, v, rtol=1e-9, atol=1e-12)


def test_steps_and_their_controller_take_it():
    step = prdp.Heat((16,), 1e-3, 1.0, solver=cg(2, 1e-5))
    u = field((16,)).requires_grad_()
    step.rollout(u, 3).sum().backward()
    assert u.grad.isfinite().all() and "preconditioner='diagonal'" in repr(step)
    step.max_iter = 5
    assert step(u).isfinite().all()


def one_per_sample():
    generator = torch.Generator().manual_seed(0)
    a = 0.2 * torch.randn(3, 6, 6, dtype=torch.float64, generator=generator) + 4 * torch.eye(6, dtype=torch.float64)
    return a, torch.linalg.inv(a) + 0.01 * torch.randn(a.shape, dtype=torch.float64, generator=generator), generator


@pytest.mark.parametrize("mapped", ["b", "M", "b M", "b A M"])
def test_one_matrix_per_sample_under_vmap(mapped):
    a, m, generator = one_per_sample()
    given = {"b": torch.randn(3, 6, dtype=torch.float64, generator=generator), "A": a, "M": m}
    for name in mapped.split():
        given[name] = torch.stack([given[name] * (1 + 0.1 * i) for i in range(4)])

    def solve(b, a, m):
        return prdp.linear_solve(a, b, prdp.GMRES(1, restart=4, rtol=0.0, preconditioner=prdp.operators.Matrix(m)))[0]

    dims = tuple(0 if name in mapped.split() else None for name in given)
    found = torch.func.vmap(solve, in_dims=dims)(*given.values())
    for i in range(4):
        one = [t if dim is None else t[i] for t, dim in zip(given.values(), dims, strict=True)]
        assert torch.equal(found[i], solve(*one))


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_one_matrix_per_sample_beside_a_zero(backward):
    """The gradient of the others is what they have alone."""
    a, m, generator = one_per_sample()
    b = torch.randn(3, 6, dtype=torch.float64, generator=generator)
    b[1] = 0.0

    def gradient(index):
        leaf = b[index].clone().requires_grad_()
        solver = prdp.GMRES(1, restart=4, rtol=0.0, preconditioner=prdp.operators.Matrix(m[index]))
        u, _ = prdp.linear_solve(a[index], leaf, solver, backward=backward)
        return torch.autograd.grad(u.square().sum(), leaf)[0]

    torch.testing.assert_close(gradient([0, 1, 2])[[0, 2]], gradient([0, 2]))
