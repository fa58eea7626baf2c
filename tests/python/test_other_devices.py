"""The path of devices without loops of their own, on a stand-in: what comes out, and how often the host waits."""

import pytest
import torch
from stand_in_device import StandIn

import prdp_torch as prdp
from prdp_torch import _C, operators

F32, F64 = torch.float32, torch.float64
OFFSETS = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
SHAPE = (7, 9)  # not of whole registers, so that the CPU takes the same operations
METHODS = ["jacobi", "steepest_descent", "cg", "bicgstab"]


def rounding(dtype):
    return 1e4 * torch.finfo(dtype).eps


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def product(v):
    w = 4.3 * v
    for axis in (-1, -2):
        w = w - v.roll(1, axis) - v.roll(-1, axis)
    return w


def function():
    return operators.Function(product, symmetric=True, diagonal=lambda: torch.tensor(4.3, dtype=F64))


def five_points(centre, rows=1):
    coefficients = -torch.ones(rows, 5, *SHAPE, dtype=F64)
    coefficients[:, 0] = centre
    return coefficients


def ill_assorted():
    """A regular sample, a diagonal one, a large one and one with a NaN."""
    coefficients = five_points(4.3, rows=4)
    coefficients[1, 1:] = 0.0
    coefficients[2] *= 1e18
    coefficients[3, 0, 0, 0] = torch.nan
    return coefficients


def stencil(coefficients, boundary="periodic", **options):
    return lambda dtype: operators.Stencil(coefficients.to(dtype), OFFSETS, boundary, **options)


OPERATORS = {
    "definite": stencil(five_points(4.3)),
    "singular": stencil(five_points(4.0)),
    "null space": stencil(five_points(4.0), nullspace="constant"),
    "indefinite": stencil(five_points(1.0), "zero"),
    "random": stencil(noise(4, 5, *SHAPE, seed=1)),
    "ill-assorted": stencil(ill_assorted()),
    "heat": lambda dtype: operators.Heat(SHAPE, torch.tensor(0.3, dtype=dtype), 1.0),
}


def right_hand_sides():
    """Noise; a zero, a constant and a tiny one; a NaN, a huge one and a point."""
    plain = noise(4, 1, *SHAPE)
    special, hard = plain.clone(), plain.clone()
    special[0], special[1], special[2] = 0.0, 1.0, plain[2] * 1e-25
    hard[3, 0, 2, 2], hard[0], hard[1] = torch.nan, plain[0] * 1e30, 0.0
    hard[1, 0, 3, 3] = 1.0
    return {"noise": plain, "special": special, "hard": hard}


def solve_there(b, a, *settings):
    device = StandIn()
    with device:
        settings = [device.send(s) if isinstance(s, torch.Tensor) else s for s in settings]
        tensors = [device.send(t) for t in a.tensors]
        u, info = _C.solve_with_tensors(device.send(b), tensors, a.kind, a.shape, a.parameters, False, *settings)
    return device.fetch(u), info, device


SETTINGS = [(0, 0.0), (1, 1e-6), (7, 0.0), (25, 1e-2), (40, 1e-6), (40, 1e-15)]  # max_iter, rtol
RUNS = [(method, "", name) for method in METHODS for name in OPERATORS]
RUNS += [(method, "diagonal", name) for method in ("cg", "bicgstab") for name in OPERATORS]
RUNS += [("chebyshev", "", "heat")]


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("method, preconditioner, name", RUNS)
def test_a_device_looked_at_seldom_gives_the_same_bits_and_reports(method, preconditioner, name, dtype):
    a = OPERATORS[name](dtype)
    for turn, (case, b) in enumerate(right_hand_sides().items()):
        for n, (k, rtol) in list(enumerate(SETTINGS))[(turn + (dtype == F32)) % 3 :: 3]:
            x0 = noise(4, 1, *SHAPE, seed=2).to(dtype) if n < 4 else None
            settings = (method, k, rtol, 4, x0, preconditioner)
            u, info = _C.solve_with_tensors(b.to(dtype), a.tensors, a.kind, a.shape, a.parameters, False, *settings)
            v, report, _ = solve_there(b.to(dtype), a, *settings)
            assert torch.equal(u, v), (case, k, rtol)
            for mine, other in zip(info, report, strict=True):
                # On Intel's processors torch takes MKL's square root, whose last bit may differ from the C library's.
                last_bit = torch.finfo(dtype).eps if mine.is_floating_point() else 0.0
                mine, other = mine.double(), other.double()
                assert torch.allclose(mine, other, rtol=last_bit, atol=0, equal_nan=True), (case, k, rtol)


ON, OFF = torch.tensor([1.0, 0.0] * 4, dtype=F64), torch.tensor([0.0, 1.0] * 4, dtype=F64)


@pytest.mark.parametrize(
    "method, preconditioner, diagonal, before, b",
    [
        ("cg", "diagonal", ON - OFF, 0 * ON, ON + OFF),  # r·M⁻¹ r = 0
        ("cg", "", ON - OFF, 0 * ON, ON + OFF),  # p·Ap = 0
        ("bicgstab", "", ON, OFF, ON),  # the residual between the two steps is in the null space of A: t = 0
    ],
)
@pytest.mark.parametrize("k", range(5))
def test_a_number_that_vanishes_exactly_is_noticed_later(method, preconditioner, diagonal, before, b, k):
    a = operators.Stencil(torch.stack([diagonal, before])[None], [(0,), (-1,)], "zero")
    settings = (method, k, 0.0, 4, None, preconditioner)
    b = b.expand(3, 1, 8) * torch.tensor([1.0, 0.0, 3.0], dtype=F64).reshape(3, 1, 1)
    u, info = _C.solve_with_tensors(b, a.tensors, a.kind, a.shape, a.parameters, False, *settings)
    v, report, _ = solve_there(b, a, *settings)
    assert torch.equal(u, v) and all(torch.equal(x, y) for x, y in zip(info, report, strict=True)), (info, report)
    assert v.isfinite().all() and v[0].abs().max() < 4


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("preconditioner", ["", "diagonal"])
@pytest.mark.parametrize("name", [name for name in OPERATORS if name != "singular"])  # there u is what its rounding is
def test_gmres_on_a_device_gives_the_same_reports_and_u_to_rounding(name, preconditioner, dtype):
    a = OPERATORS[name](dtype)
    for turn, (case, b) in enumerate(right_hand_sides().items()):
        cycles = [(4, 0, 0.0), (1, 1, 1e-3), (4, 4, 0.0), (8, 5, 1e-2), (4, 9, 1e-4), (2, 3, 0.0)]
        for n, (m, k, rtol) in enumerate(cycles):
            x0 = noise(4, 1, *SHAPE, seed=2).to(dtype) if (n + turn) % 2 else None
            settings = ("gmres", k, rtol, m, x0, preconditioner)
            u, info = _C.solve_with_tensors(b.to(dtype), a.tensors, a.kind, a.shape, a.parameters, False, *settings)
            v, report, _ = solve_there(b.to(dtype), a, *settings)
            told = str((case, settings, info, report))
            info, report = list(info), list(report)
            lost = report[2] == -7  # b lies in the null space, and what is left of it is rounding
            products, most = info.pop(3), report.pop(3)
            assert (products <= most).all(), told  # a device's cycle goes on to its end with zeros
            for mine, other in zip(info, report, strict=True):
                torch.testing.assert_close(mine[~lost], other[~lost], rtol=1e-3, atol=rounding(dtype), msg=told)
            size = u.abs().amax((1, 2, 3), keepdim=True)
            ill_conditioned = name == "random"  # but of least residual
            assert ((u - v).abs() <= rounding(dtype) * size).all() or ill_conditioned, told


def test_a_product_meets_no_nan_of_a_sample_that_is_solved():
    """An eigenvector and a zero beside noise: the quotients of their numbers are 0/0 from the first iteration on."""

    def strict(v):
        assert StandIn.fetch(v).isfinite().all()
        return product(v)

    b = noise(4, 1, *SHAPE)
    b[0], b[1] = 0.0, 1.0
    a = operators.Function(strict, symmetric=True)
    device = StandIn()
    with device:
        u, _ = prdp.linear_solve(a, device.send(b), prdp.CG(30, 0.0))
    torch.testing.assert_close(device.fetch(u), prdp.linear_solve(a, b, prdp.CG(30, 0.0))[0])


@pytest.mark.parametrize("method", METHODS)
def test_how_often_the_host_looks(method):
    """With rtol = 0 at the report alone; else at each iteration."""
    a = operators.Stencil(five_points(4.0)[..., :1, :1].expand(1, 5, 51, 53).contiguous(), OFFSETS, "zero")

    def copies(k, rtol):
        _, info, device = solve_there(noise(4, 1, 51, 53), a, method, k, rtol)
        assert info[0].tolist() == [k] * 4
        return device.copies_to_host

    assert copies(50, 0.0) == copies(3, 0.0) <= 4
    assert copies(25, 1e-12) - copies(15, 1e-12) <= 20


@pytest.mark.parametrize(
    "method, at_most, products",
    [("jacobi", 2, 1), ("steepest_descent", 29, 1), ("cg", 38, 1), ("bicgstab", 127, 2), ("gmres", 8 * 12, 9)],
)
def test_operations_of_an_iteration_beside_its_products(method, at_most, products):
    a = operators.Stencil(five_points(4.3), OFFSETS, "periodic")
    few, many = [solve_there(noise(4, 1, *SHAPE), a, method, k, 0.0, 8)[2].launched() for k in (10, 20)]
    device = StandIn()
    with device:
        tensors = [device.send(t) for t in a.tensors]
        torch.ops.prdp.apply(device.send(noise(4, 1, *SHAPE)), tensors, a.kind, a.shape, a.parameters, False)
    assert (many - few) / 10 - products * device.launched() <= at_most


def test_operations_of_an_iteration_of_chebyshev():
    """With nu as a number; one on the device takes six more, on single numbers, for the weights."""
    a, b = operators.Heat(SHAPE, 0.3, 1.0), noise(4, 1, *SHAPE)

    def launched(run):
        device = StandIn()
        with device:
            run(device.send(b))
        return device.launched()

    few, many = [launched(lambda b, k=k: prdp.linear_solve(a, b, prdp.Chebyshev(k, 0.0))) for k in (10, 20)]
    assert (many - few) / 10 - launched(a.apply) <= 4


CASES = {
    "stencil": lambda b, c: operators.Stencil(c, OFFSETS, "periodic"),
    "function": lambda b, c: function(),
    "heat": lambda b, c: operators.Heat(SHAPE, c.mean().abs() + 1e-2, 1.0),
}
SOLVERS = {
    "jacobi": prdp.Jacobi(8, 0.0),
    "cg": prdp.CG(8, 0.0),
    "cg, rtol": prdp.CG(60, 1e-4),
    "cg, diagonal": prdp.CG(60, 1e-4, preconditioner="diagonal"),
    "bicgstab": prdp.BiCGStab(60, 1e-4),
    "gmres": prdp.GMRES(20, 1e-4, restart=4),
    "direct": prdp.Direct(),
}


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("solver", SOLVERS)
def test_solutions_and_gradients_are_those_of_the_cpu(solver, case, backward):
    compare(lambda b, c: prdp.linear_solve(CASES[case](b, c), b, SOLVERS[solver], backward=backward)[0])


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_a_cycle_of_multigrid_is_one_look(backward):
    solver = prdp.CG(20, 1e-10, preconditioner="multigrid")
    copies = compare(lambda b, c: prdp.linear_solve(CASES["stencil"](b, c), b, solver, backward=backward)[0])
    assert copies <= 30  # with those of CG itself


def compare(make):
    """u and its gradients on the CPU and on the stand-in; returns how often the forward pass waited."""
    inputs = [noise(3, 1, *SHAPE), five_points(4.3)]

    def run(b, c):
        u = make(b, c)
        return u, torch.autograd.grad(u.square().sum(), [b, c], allow_unused=True)

    u, gradients = run(*(t.clone().requires_grad_() for t in inputs))
    device = StandIn()
    with device:
        there = [device.send(t).requires_grad_() for t in inputs]
        make(*there)
        copies = device.copies_to_host
        v, found = run(*there)
    torch.testing.assert_close(device.fetch(v), u, rtol=1e-8, atol=1e-10)
    for mine, other in zip(found, gradients, strict=True):
        assert (mine is None) == (other is None)
        if other is not None:
            torch.testing.assert_close(device.fetch(mine), other, rtol=1e-7, atol=1e-9)
    return copies


@pytest.mark.parametrize("name", ["heat", "burgers"])
def test_steps_and_rollouts(name):
    def stepper(nu):
        if name == "heat":
            return prdp.Heat((9,), nu, 1.0, solver=prdp.CG(6, 0.0))
        return prdp.Burgers((9,), nu, 1e-2, solver=prdp.GMRES(20, 1e-9, restart=4))

    u, nu = noise(3, 1, 9) * 0.1 + 1.0, torch.tensor(1e-2, dtype=F64)
    states = stepper(nu).rollout(u, 3)
    device = StandIn()
    with device:
        there = stepper(device.send(nu)).rollout(device.send(u), 3)
        number = stepper(1e-2).rollout(device.send(u), 3)
    for found in (there, number):
        torch.testing.assert_close(device.fetch(found), states, rtol=1e-8, atol=1e-10)


def test_a_network_in_half_precision_around_a_solve():
    """The solve and its adjoint stay in float32 under autocast, on the device as on the CPU."""
    b, weight = noise(3, 1, *SHAPE).to(F32), torch.tensor(0.7)

    def train(b, weight):
        rhs = (weight.bfloat16() * b.bfloat16()).float()
        u, _ = prdp.linear_solve(function(), rhs, prdp.CG(8, 0.0))
        return u, torch.autograd.grad((u.bfloat16() * u.bfloat16()).float().sum(), weight)[0]

    u, gradient = train(b, weight.requires_grad_())
    device = StandIn()
    with device, torch.autocast("cpu", dtype=torch.bfloat16):
        v, found = train(device.send(b), device.send(weight).requires_grad_())
    assert v.dtype == found.dtype == F32
    torch.testing.assert_close(device.fetch(v), u)
    torch.testing.assert_close(device.fetch(found), gradient)
