"""torch.autocast: solves and their derivatives keep the dtype of their input, and take low precision for float32."""

import pytest
import torch
from helpers import field, spd_matrices

import prdp_torch as prdp
from prdp_torch import operators

LOW = [torch.bfloat16, torch.float16]
N = 48  # products in bfloat16 would be off by 1e-3


def autocast():
    return torch.autocast("cpu", dtype=torch.bfloat16)


def product(v, a):
    return v @ a.mT


def transposed(v, a):
    return v @ a


def by_matrix(a):
    return operators.Matrix(a)


def by_function(a):
    return operators.Function(product, transposed, (a,))


@pytest.mark.parametrize("operator", [by_matrix, by_function])
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("solver", [prdp.GMRES(3, restart=5, rtol=0.0), prdp.Direct()], ids=["gmres", "direct"])
def test_solves_and_gradients_are_those_without_autocast(operator, backward, solver):
    a, b = spd_matrices(1, N, dtype=torch.float32)[0], field((N,), dtype=torch.float32)[:, 0]

    def gradients():
        leaves = a.clone().requires_grad_(), b.clone().requires_grad_()
        u = prdp.linear_solve(operator(leaves[0]), leaves[1], solver, backward=backward)[0]
        return u, *torch.autograd.grad((u * b).sum(), leaves)

    expected = gradients()
    with autocast():
        found = gradients()
    for f, e in zip(found, expected, strict=True):
        assert f.dtype == torch.float32 and torch.equal(f, e)


@pytest.mark.parametrize("operator", [by_matrix, by_function])
def test_products_keep_their_dtype(operator):
    a, v = operator(spd_matrices(1, N, dtype=torch.float32)[0]), field((N,), dtype=torch.float32)[:, 0]
    expected = a.apply(v), a.apply_transpose(v)
    with autocast():
        found = a.apply(v), a.apply_transpose(v)
    for f, e in zip(found, expected, strict=True):
        assert f.dtype == torch.float32 and torch.equal(f, e)


STEPS = [
    (prdp.Heat, 1, (16,), prdp.CG(5)),
    (prdp.Burgers, 2, (8, 8), prdp.GMRES(3)),
    (prdp.NavierStokes, 3, (8, 8), prdp.GMRES(5, preconditioner="multigrid")),
]


@pytest.mark.parametrize("low", LOW)
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("way", ["step", "rollout"])
@pytest.mark.parametrize("stepper, channels, shape, solver", STEPS, ids=["heat", "burgers", "navier_stokes"])
def test_low_precision_is_taken_for_float32(stepper, channels, shape, solver, way, backward, low):
    step = stepper(shape, 1e-2, 0.01, solver, backward)
    take = step if way == "step" else lambda u: step.rollout(u, 2)
    u = field(shape, channels=channels).to(low)

    def gradient(u):
        u = u.requires_grad_()
        after = take(u)
        return after, *torch.autograd.grad(after[..., : max(channels - 1, 1), :, :].square().sum(), u)

    expected = gradient(u.float())
    with autocast():
        after, u_bar = gradient(u.clone())
    assert after.dtype == torch.float32 and torch.equal(after, expected[0])
    assert u_bar.dtype == low and torch.equal(u_bar, expected[1].to(low))
    with pytest.raises(TypeError, match="expected float32 or float64"):
        take(u)


def test_a_network_goes_straight_into_a_step():
    torch.manual_seed(0)
    network, heat = torch.nn.Linear(N, N), prdp.Heat((N,), 1e-3, 1.0, prdp.CG(20))
    u = field((N,), dtype=torch.float32)
    with autocast():
        output = network(u)
        loss = heat(output).square().mean()
        loss.backward()
    assert output.dtype == torch.bfloat16 and loss.dtype == torch.float32
    assert network.weight.grad.dtype == torch.float32 and network.weight.grad.any()


@pytest.mark.parametrize("low", LOW)
def test_operators_of_low_precision_are_taken_for_float32(low):
    winds, v = field((8, 8), channels=2).to(low), field((8, 8), channels=2, seed=1).to(low)
    matrix, rhs = spd_matrices(1, N)[0].to(low), field((N,))[:, 0].to(low)
    nu = torch.tensor(1e-2).to(low)
    expected = [
        operators.Burgers(winds.float(), nu.float(), 0.1).apply(v.float()),
        prdp.linear_solve(operators.Burgers(winds.float(), nu.float(), 0.1), v.float(), prdp.GMRES(3))[0],
        prdp.linear_solve(matrix.float(), rhs.float(), prdp.CG(3))[0],
        prdp.Heat((8,), nu.float(), 0.1, prdp.Jacobi(3))(v[:, :1, 0].float()),
    ]
    with autocast():
        found = [
            operators.Burgers(winds, nu, 0.1).apply(v),
            prdp.linear_solve(operators.Burgers(winds, nu, 0.1), v, prdp.GMRES(3))[0],
            prdp.linear_solve(matrix, rhs, prdp.CG(3))[0],
            prdp.Heat((8,), nu, 0.1, prdp.Jacobi(3))(v[:, :1, 0]),
        ]
    for f, e in zip(found, expected, strict=True):
        assert f.dtype == torch.float32 and torch.equal(f, e)


def test_double_precision_stays():
    heat, u = prdp.Heat((8,), 1e-2, 0.1, prdp.Jacobi(3)), field((8,))
    with autocast():
        found = heat(u)
    assert found.dtype == torch.float64 and torch.equal(found, heat(u))


def test_a_compiled_step_takes_low_precision_too():
    torch._dynamo.reset()
    heat, u = prdp.Heat((8,), 1e-2, 0.1, prdp.Jacobi(3)), field((8,)).bfloat16()
    step = torch.compile(heat, fullgraph=True, backend="aot_eager")
    with autocast():
        assert torch.equal(step(u), heat(u))
