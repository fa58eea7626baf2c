"""Samples whose unrolled derivative would mislead get the implicit one; truncated iterations keep their own."""

import pytest
import torch
from helpers import field, random, statuses

import prdp_torch as prdp
from prdp_torch import operators


@pytest.mark.parametrize("form", ["loops", "tensors", "recorded", "A alone"])
@pytest.mark.parametrize(
    "solver", [prdp.CG(1000), prdp.BiCGStab(1000), prdp.GMRES(40, restart=10), prdp.SteepestDescent(20000)], ids=repr
)
def test_of_a_right_hand_side_of_few_eigenvectors_the_iterations_have_no_useful_derivative(solver, form):
    """A constant b and a layered medium: u is solved along one axis, and the cotangent points at one cell."""
    n = 10
    x = (torch.arange(n, dtype=torch.float64) + 0.5) / n
    kappa = (1 + 9 * (x > 0.5).double()).expand(1, n, n).contiguous().requires_grad_()
    diffusion = operators.Diffusion(kappa)
    a = operators.Function(lambda v, k: operators.Diffusion(k).apply(v), tensors=kappa, symmetric=True)
    b = torch.ones(2, 1, n, n, dtype=torch.float64)
    b[1] = field((n, n), 1)[0]  # of all eigenvectors
    b.requires_grad_(form != "A alone")
    inputs = [kappa] if form == "A alone" else [b, kappa]
    gradients = {}
    for backward in ("implicit", "unrolled"):
        u, info = prdp.linear_solve(a if form == "tensors" else diffusion, b, solver, backward=backward)
        assert info.solved.all()
        found = torch.autograd.grad(u[:, 0, 5, 7].sum(), inputs, create_graph=form == "recorded")
        gradients[backward] = [g.detach() for g in found]
    for implicit, unrolled in zip(gradients["implicit"], gradients["unrolled"], strict=True):
        assert (implicit - unrolled).norm() < 0.2 * implicit.norm()
    assert info.adjoint.residual[0] < 1e-5


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("solver", [prdp.CG(200, rtol=1e-3), prdp.MINRES(200, rtol=1e-3)], ids=repr)
def test_rounding_that_recurrences_amplify_is_no_gradient_of_a_solved_sample(solver, shared):
    """A κ of 32² cells and a rough b: the derivative of the iterations is off by factors of a million and more."""
    n, batch = 32, 2
    noise = torch.randn(batch + 2, 1, n, n, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    b, weights = noise[:batch], noise[-1]
    x = (torch.arange(n, dtype=torch.float64) + 0.5) / n
    kappa = torch.exp(0.5 * torch.sin(2 * torch.pi * x)[:, None] * torch.cos(torch.pi * x)).expand(batch, n, n)
    kappa = (kappa[:1] if shared else kappa).clone().requires_grad_()

    def gradient(solver, backward):
        u, info = prdp.linear_solve(operators.Diffusion(kappa), b, solver, backward=backward)
        (found,) = torch.autograd.grad((u * weights).sum(), kappa)
        return found, info

    truth, _ = gradient(prdp.Direct(2), "implicit")
    found, info = gradient(solver, "unrolled")
    assert info.solved.all() and (info.adjoint.residual < 1e-3).all()
    assert (found - truth).norm() < 0.1 * truth.norm()


@pytest.mark.parametrize("solver", [prdp.CG(50), prdp.MINRES(50)], ids=repr)
@pytest.mark.parametrize("kind", ["csr", "function"])
def test_a_gradient_of_rounding_is_found_beside_any_neighbour(kind, solver):
    """Each sample has its own values: one of them is off by 400 %, which a neighbour's larger gradient would hide."""
    generator = torch.Generator().manual_seed(17)
    size, n = 6, 10
    square = torch.randn(size, n, n, generator=generator, dtype=torch.float64) * 0.3 + 2 * torch.eye(n)
    matrices, b = square @ square.mT, torch.randn(size, n, generator=generator, dtype=torch.float64)

    def gradient(rows):
        values = matrices[rows].flatten(1).clone().requires_grad_()
        if kind == "csr":
            pattern = torch.arange(0, n * n + 1, n), torch.arange(n).repeat(n)
            a = operators.Matrix.csr(*pattern, values, (len(rows), n, n))
        else:
            a = operators.Function(lambda v, w: (w.unflatten(1, (n, n)) @ v[..., None])[..., 0], tensors=(values,))
        u, info = prdp.linear_solve(a, b[rows], solver, backward="unrolled")
        assert info.solved.all()
        return torch.autograd.grad(u.sin().sum(), values)[0]

    leaves = matrices.clone().requires_grad_()
    (truth,) = torch.autograd.grad(torch.linalg.solve(leaves, b).sin().sum(), leaves)
    for rows in ([0], [0, 5], list(range(size))):
        error = (gradient(rows) - truth[rows].flatten(1)).norm(dim=1)
        assert (error < 0.1 * truth[rows].flatten(1).norm(dim=1)).all()


def test_iterations_that_leave_little_give_the_gradient_of_the_solution():
    """The eighteenth iteration of CG finds the solution; the thirtieth is rounding, though its residual is not."""
    values = torch.linspace(1, 3, 16, dtype=torch.float64).repeat(2).requires_grad_()
    b, weights = torch.randn(2, 1, 32, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    a = operators.Function(lambda v, d: d * v, tensors=values, symmetric=True)
    for max_iter in (18, 24, 30):
        u, info = prdp.linear_solve(a, b, prdp.CG(max_iter, rtol=0.0), backward="unrolled")
        (found,) = torch.autograd.grad((u * weights).sum(), values)
        expected = -(b * weights / values.detach() ** 2)[0]
        assert statuses(info) == ["MAX_ITER"] and (found - expected).norm() < 1e-3 * expected.norm()


@pytest.mark.parametrize("method", [prdp.CG, prdp.MINRES, prdp.BiCGStab], ids=lambda method: method.__name__)
@pytest.mark.parametrize("needs_kappa", [True, False])
def test_few_iterations_on_a_weak_hold_keep_their_derivative_in_float32(method, needs_kappa):
    """b is almost the constant, which a small shift alone holds, so that u is large and its rounding as large as b."""
    generator = torch.Generator().manual_seed(0)
    kappa = (torch.rand(1, 32, generator=generator) + 0.5).requires_grad_(needs_kappa)
    b, along, weights = torch.randn(3, 1, 1, 32, generator=generator)
    b = (1 + 1e-4 * b).requires_grad_()

    def loss(b, dtype=torch.float32):
        a = operators.Diffusion(kappa.to(dtype), shift=1.0, boundary="flux")
        u, _ = prdp.linear_solve(a, b, method(3, rtol=0.0), backward="unrolled")
        return (u * weights.to(dtype)).sum()

    (found,) = torch.autograd.grad(loss(b), b)
    wide, step = b.detach().double(), 1e-6 * along.double()
    with torch.no_grad():
        expected = (loss(wide + step, torch.float64) - loss(wide - step, torch.float64)) / 2e-6
    assert abs((found.double() * along.double()).sum() - expected) < 1e-2 * abs(expected)


def test_a_start_that_is_accepted_has_no_derivative_beside_any_neighbour():
    diagonal = torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64)
    start = 1 / diagonal.expand(2, 4).clone()
    start[0, 0] += 1e-3  # accepted; the other sample's is not
    start[1] = 1
    gradients = []
    for rows in ([0], [0, 1]):
        b = torch.ones(len(rows), 4, dtype=torch.float64, requires_grad=True)
        u, info = prdp.linear_solve(torch.diag(diagonal), b, prdp.CG(50, rtol=1e-2), "unrolled", x0=start[rows])
        gradients.append(torch.autograd.grad(u.sum(), b)[0][0])
    assert info.iterations[0] == 0 < info.iterations[1]
    assert torch.equal(*gradients) and not gradients[0].any()


def test_a_recurrence_near_a_breakdown_gives_the_gradient_of_the_solution():
    """The residual of 3e-13 is right, and the derivative of the iterations was off by 10 to 40 %: no more than zero."""
    generator = torch.Generator().manual_seed(290)
    b = torch.randn(1, 1, 24, dtype=torch.float64, generator=generator).requires_grad_()
    coefficients = torch.tensor([1.0576, -3.0288, 2.9712], dtype=torch.float64)
    coefficients = coefficients[None, :, None].expand(1, 3, 24).clone().requires_grad_()
    a = operators.Stencil(coefficients, [(0,), (-1,), (1,)], "periodic")
    weights = torch.randn(8, 24, dtype=torch.float64, generator=generator.manual_seed(1))
    for w in weights:
        gradients = []
        for solver, backward in ((prdp.Direct(), "implicit"), (prdp.BiCGStab(500, rtol=1e-12), "unrolled")):
            u, info = prdp.linear_solve(a, b, solver, backward=backward)
            gradients.append(torch.autograd.grad((u * w).sum(), (b, coefficients)))
        assert statuses(info) == ["CONVERGED"]
        for truth, found in zip(*gradients, strict=True):
            assert (found - truth).norm() < 1e-2 * truth.norm()


@pytest.mark.parametrize(
    "method",
    [prdp.CG, prdp.MINRES, prdp.BiCGStab, prdp.SteepestDescent, lambda k, rtol: prdp.GMRES(k, rtol=rtol, restart=1)],
)
@pytest.mark.parametrize("rtol", [0.2, 0.05])
def test_a_loose_tolerance_leaves_the_derivative_of_the_iterations_that_ran(method, rtol):
    """Of one number, ν, that a sum over the field cancels in: it may be many times that of the solution."""
    off = 0.0
    for seed in range(40):
        b, w = random(2, 1, 1, 12, seed=seed)

        def solve(nu, solver, b=b):
            return prdp.linear_solve(operators.Heat((12,), nu, 0.3), b, solver, backward="unrolled")

        nu = torch.tensor(0.02, dtype=torch.float64, requires_grad=True)
        u, info = solve(nu, method(50, rtol))
        (found,) = torch.autograd.grad((u * w).sum(), nu)
        k = int(info.iterations)
        above, below = (solve(nu.detach() + d, method(k, 0.0))[0] for d in (1e-6, -1e-6))
        expected = float(((above - below) * w).sum()) / 2e-6
        assert statuses(info) == ["CONVERGED"] and abs(float(found) - expected) < 1e-5 * max(abs(expected), 0.1)
        (exact,) = torch.autograd.grad((solve(nu, prdp.Direct())[0] * w).sum(), nu)
        off = max(off, abs(float(found / exact)))
    assert off > 1.2


def test_truncated_iterations_keep_their_own_derivative():
    a, b = operators.Poisson((30,)), torch.ones(1, 1, 30, dtype=torch.float64, requires_grad=True)
    u, info = prdp.linear_solve(a, b, prdp.CG(3, rtol=0.0), backward="unrolled")
    u[0, 0, 3].backward()
    assert info.adjoint.residual.isnan().all() and statuses(info) == ["MAX_ITER"]


@pytest.mark.parametrize("solver", [prdp.BiCGStab(50, 1e-5), prdp.CG(50, 1e-5)], ids=repr)
def test_neighbours_that_share_a_tensor_do_not_decide_which_derivative_a_sample_gets(solver):
    """One of four right-hand sides is almost an eigenvector: one iteration solves it, and tells little of b̄."""
    kinds = set()
    shared = operators.Diffusion(torch.linspace(0.3, 1.7, 12, dtype=torch.float64).view(1, 12), shift=1.0)
    vectors = torch.linalg.eigh(shared.apply(torch.eye(12, dtype=torch.float64)[:, None])[:, 0])[1]
    for seed in range(10):
        b, w = random(2, 4, 1, 12, seed=seed)
        b[seed % 4] = vectors[:, seed] + 1e-6 * b[seed % 4]

        def gradient(samples, b=b, w=w):
            kappa = torch.linspace(0.3, 1.7, 12, dtype=torch.float64).view(1, 12).requires_grad_()
            some = b[samples].clone().requires_grad_()
            u, info = prdp.linear_solve(operators.Diffusion(kappa, shift=1.0), some, solver, "unrolled")
            (u * w[samples]).sum().backward()
            return some.grad, info.adjoint.residual.isfinite()  # NaN where iterations are differentiated

        together, implicit = gradient([0, 1, 2, 3])
        for i in range(4):
            alone, implicit_alone = gradient([i])
            assert torch.equal(together[i : i + 1], alone) and implicit[i] == implicit_alone[0]
            kinds.add(bool(implicit[i]))
    assert kinds == {False, True}
