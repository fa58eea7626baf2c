"""Domains of other lengths, and nu as a Parameter, a buffer or a number."""

import copy
import math
import pickle

import numpy as np
import pytest
import torch
from helpers import dense_laplacian, field, statuses

import prdp_torch as prdp
from prdp_torch import fields, operators
from prdp_torch.solvers import packed_options

SHAPE, LENGTH = (5, 7), (2.0, 0.5)


def stretched_laplacian(periodic):
    """Of two axes of lengths LENGTH, by Kronecker sums."""
    total = np.zeros((1, 1))
    for n, length in zip(SHAPE, LENGTH, strict=True):
        one = dense_laplacian((n,)) / (n + 1) ** 2
        if periodic:
            one[0, -1] = one[-1, 0] = 1.0
        one /= (length / (n if periodic else n + 1)) ** 2
        total = np.kron(total, np.eye(n)) + np.kron(np.eye(len(total)), one)
    return total


@pytest.mark.parametrize("length, scale", [(LENGTH, None), (3.0, 3.0), ((3.0, 3.0), 3.0), (1.0, 1.0), ((1, 1), 1.0)])
def test_the_laplacians_of_heat_and_poisson(length, scale):
    laplacian = stretched_laplacian(False) if scale is None else dense_laplacian(SHAPE) / scale**2
    np.testing.assert_allclose(operators.Poisson(SHAPE, length).dense(), laplacian, rtol=1e-13)
    heat = np.eye(len(laplacian)) - 2e-3 * laplacian
    np.testing.assert_allclose(operators.Heat(SHAPE, 1e-2, 0.2, length=length).dense(), heat, rtol=1e-13)


def test_the_diffusion_and_the_winds_of_burgers():
    nu, dt, n = 1e-2, 0.2, math.prod(SHAPE)
    at_rest = torch.zeros(1, 2, *SHAPE, dtype=torch.float64)
    block = np.eye(n) - nu * dt * stretched_laplacian(True)
    found = operators.Burgers(at_rest, nu, dt, LENGTH).dense()
    np.testing.assert_allclose(found.squeeze(0), np.kron(np.eye(2), block), atol=1e-13)
    wind = torch.full((1, 2, *SHAPE), 0.0, dtype=torch.float64)
    wind[:, 0] = 0.7  # along x, the last axis
    shift = np.eye(7) - np.roll(np.eye(7), -1, axis=1)  # backward difference, periodic
    block = np.eye(n) + dt * 0.7 / (LENGTH[1] / 7) * np.kron(np.eye(5), shift)
    found = operators.Burgers(wind, 0.0, dt, LENGTH).dense()
    np.testing.assert_allclose(found.squeeze(0), np.kron(np.eye(2), block), atol=1e-12)


def steppers(length, scale, nu, **options):
    """Steps that are the same flow up to a factor where velocities and lengths are scaled, nu by its square."""
    nu = nu * scale**2
    yield prdp.Heat(SHAPE, nu, 0.2, length=length, **options), 1, 1.0
    yield prdp.Burgers(SHAPE, nu, 0.2, length=length, **options), 2, scale
    yield prdp.NavierStokes(SHAPE, nu, 0.2, length=length, **options), 3, scale


SOLVERS = {
    "gmres": lambda: prdp.GMRES(400, restart=12, rtol=1e-11),
    "direct": lambda: prdp.Direct(),
    "multigrid": lambda: prdp.GMRES(200, rtol=1e-13, preconditioner="multigrid"),
}


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_scaled_domain_has_the_scaled_flow_and_gradient(solver, backward):
    side = 2 * math.pi
    results = []
    for length, scale in ((1.0, 1.0), (side, side)):
        nu = torch.tensor(1e-3, dtype=torch.float64, requires_grad=True)
        for stepper, channels, factor in steppers(length, scale, nu, solver=SOLVERS[solver](), backward=backward):
            if channels == 3 and solver != "direct" and backward == "unrolled":
                continue  # the iterates of GMRES on Navier-Stokes depend on the units, and so do their derivatives
            u = field(SHAPE, channels=channels)
            u = (fields.project(u) if channels == 3 else u).requires_grad_()
            u_next = stepper(factor * u)[:, :2] / factor
            results.append((u_next, *torch.autograd.grad((u_next**2).sum(), (u, nu), retain_graph=True)))
    half = len(results) // 2
    for unit, scaled in zip(results[:half], results[half:], strict=True):
        torch.testing.assert_close(scaled, unit, rtol=1e-7, atol=1e-9)


def test_the_loops_and_plain_tensors_agree_on_a_stretched_domain():
    from prdp_torch import _C

    w = field(SHAPE, channels=3)
    for a, channels in (
        (operators.Heat(SHAPE, 1e-2, 0.2, LENGTH), 1),
        (operators.Burgers(w[:, :2], 1e-2, 0.2, LENGTH), 2),
        (operators.NavierStokes(w, 1e-2, 0.2, LENGTH), 3),
    ):
        b = field(SHAPE, channels=channels, seed=3)
        b = fields.project(b) if channels == 3 else b
        for transposed in (False, True):
            oracle, _ = _C.solve_with_tensors(
                b, a.tensors, a.kind, a.shape, a.parameters, transposed, "gmres", 3, 0.0, 5
            )
            found, *_ = torch.ops.prdp.linear_solve(
                b, a.tensors, a.kind, a.shape, a.parameters, transposed, None,
                *packed_options("gmres", 3, 0.0, 5, None, "none", on_failure="return"),
            )  # fmt: skip
            torch.testing.assert_close(found, oracle, rtol=1e-9, atol=1e-11)


def test_unrolled_sweeps_and_autograd_agree_on_a_stretched_domain():
    for index in range(3):
        results = []
        for create_graph in (False, True):  # by the CPU loops, and by plain tensors
            nu = torch.tensor(1e-2, dtype=torch.float64, requires_grad=True)
            options = {"solver": prdp.GMRES(2, restart=4), "backward": "unrolled", "on_failure": "return"}
            stepper, channels, _ = list(steppers(LENGTH, 1.0, nu, **options))[index]
            u = field(SHAPE, channels=channels).requires_grad_()
            results.append(torch.autograd.grad((stepper(u) ** 2).sum(), (u, nu), create_graph=create_graph))
        torch.testing.assert_close(*results, rtol=1e-9, atol=1e-11)


def test_steps_and_their_operators_have_the_same_length():
    u = fields.project(field(SHAPE, channels=3))
    for stepper, channels, _ in steppers(LENGTH, 1.0, 1e-2, solver=prdp.GMRES(100, restart=20, rtol=1e-12)):
        v = u[:, :channels] if channels != 1 else field(SHAPE)
        residual = stepper.operator(v).apply(stepper(v)) - stepper.rhs(v)
        assert residual.abs().max() < 1e-9 and "length=(2.0, 0.5)" in repr(stepper)
        assert statuses(stepper.info) == ["CONVERGED"] * 2
    poisson = prdp.Poisson(SHAPE, prdp.Direct(), length=LENGTH)
    p = field(SHAPE)
    torch.testing.assert_close(poisson.operator().apply(poisson(p)), -p)


@pytest.mark.parametrize(
    "length, error, message",
    [
        (0.0, ValueError, "Heat: length must be finite and > 0, got"),
        ((1.0, -2.0), ValueError, "Heat: length must be finite and > 0, got"),
        (math.inf, ValueError, "Heat: length must be finite and > 0, got"),
        ((1.0, 2.0, 3.0), ValueError, "Heat: length must be one number or one per axis, 2 here, got"),
        ("long", TypeError, "Heat: length must be a real number, got 'long'"),
        ((1.0, None), TypeError, "Heat: every length must be a real number, got None"),
    ],
)
def test_bad_lengths(length, error, message):
    for make in (lambda: prdp.Heat(SHAPE, 1.0, 1.0, prdp.CG(1), length=length),
                 lambda: operators.Heat(SHAPE, 1.0, 1.0, length=length)):  # fmt: skip
        with pytest.raises(error, match=message):
            make()


def test_a_parameter_is_trained_moved_and_saved():
    nu = torch.nn.Parameter(torch.tensor(1e-2, dtype=torch.float64))
    for stepper in (prdp.Heat((9,), nu, 1.0, prdp.CG(5)), prdp.Burgers((9,), nu, 0.1, prdp.GMRES(5))):
        assert list(stepper.parameters()) == [nu] and list(stepper.state_dict()) == ["nu"]
        optimiser = torch.optim.SGD(stepper.parameters(), lr=1e-3)
        before = nu.item()
        (stepper.rollout(field((9,)), 2) ** 2).sum().backward()
        optimiser.step()
        assert nu.item() != before
        expected = type(stepper)((9,), nu.item(), stepper.equation.parameters[0], prdp.GMRES(5))
        stepper.method = "gmres"
        torch.testing.assert_close(stepper(field((9,))), expected(field((9,))))


def test_a_tensor_is_a_buffer():
    nu = torch.tensor(1e-2, dtype=torch.float64, requires_grad=True)
    heat = prdp.Heat((9,), nu, 1.0, prdp.CG(5))
    assert list(heat.parameters()) == [] and list(heat.state_dict()) == ["nu"] and heat.nu is nu
    heat(field((9,))).sum().backward()
    assert nu.grad.abs() > 0
    other = prdp.Heat((9,), torch.tensor(0.5, dtype=torch.float64), 1.0, prdp.CG(5))
    other.load_state_dict(heat.state_dict())
    assert torch.equal(other(field((9,))), heat(field((9,))))
    assert other.float().nu.dtype == torch.float32 and other.operator().tensors[0] is other.nu


def test_a_number_stays_a_number():
    heat = prdp.Heat((9,), 1e-2, 1.0, prdp.CG(5))
    assert heat.state_dict() == {} and heat.nu == 1e-2
    double = heat(field((9,)))
    assert torch.equal(heat.float()(field((9,))), double)
    heat.nu = 0.5
    assert torch.equal(heat(field((9,))), prdp.Heat((9,), 0.5, 1.0, prdp.CG(5))(field((9,))))
    heat.nu = -1.0
    with pytest.raises(ValueError, match="Heat: nu must be finite and >= 0, got -1"):
        heat(field((9,)))
    heat.nu = torch.nn.Parameter(torch.tensor(0.5))
    assert len(list(heat.parameters())) == 1


@pytest.mark.parametrize("nu", [1e-2, torch.tensor(1e-2), torch.nn.Parameter(torch.tensor(1e-2))], ids=type)
def test_steppers_are_copied_and_pickled(nu):
    u = field((4, 6), channels=2)
    burgers = prdp.Burgers((4, 6), nu, 0.1, prdp.Jacobi(5, rtol=0.0), length=LENGTH)
    burgers.rollout(u.clone().requires_grad_(), 2).sum().backward()
    for clone in (copy.deepcopy(burgers), pickle.loads(pickle.dumps(burgers))):
        assert torch.equal(clone.rollout(u, 2), burgers.rollout(u, 2))
        clone.max_iter = 2
        if isinstance(nu, torch.Tensor):
            clone.nu.data.fill_(1.0)
        assert burgers.max_iter == 5 and torch.as_tensor(burgers.nu).item() == pytest.approx(1e-2)
        assert not torch.equal(clone(u), burgers(u))
