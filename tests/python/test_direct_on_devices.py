"""`Direct` on a device, by the stand-in, beside LAPACK and the CPU."""

import pytest
import torch
from helpers import statuses
from stand_in_device import StandIn
from test_fast_diagonalisation import BOXES, CASES, faces, noise, stencil

import prdp_torch as prdp
from prdp_torch import operators

F32, F64 = torch.float32, torch.float64


class Report:
    """u, statuses and the gradients of the inputs for a cotangent."""

    def __init__(self, solve, inputs, cotangent=None, on_failure="raise", device=None):
        send, fetch = (device.send, device.fetch) if device else (lambda t: t.clone(), lambda t: t)
        given = [send(t).requires_grad_() for t in inputs]
        a, b = solve(*given)
        u, info = prdp.linear_solve(a, b, prdp.Direct(), on_failure=on_failure)
        self.u, self.status = fetch(u.detach()), statuses(type("Info", (), {"status": fetch(info.status)}))
        self.residual, self.iterations = fetch(info.residual), fetch(info.iterations)
        if cotangent is not None:
            found = torch.autograd.grad(u, given, send(cotangent), allow_unused=True)
            self.gradients = [g if g is None else fetch(g) for g in found]


def there(solve, *inputs, **options):
    device = StandIn()
    with device:
        found = Report(solve, inputs, device=device, **options)
    found.device = device
    return found


def random(*shape, seed=0, dtype=F64):
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed)).to(dtype)


def lapack(a, b):
    """A⁻¹ b in double for each channel of each sample."""
    dense = a.dense().double()
    return torch.linalg.solve(dense, b.double().flatten(2).mT).mT.view_as(b)


def assert_close(found, exact, dtype, bound=1.0):
    slack = bound * (1e-4 if dtype == F32 else 1e-11)
    assert (found.double() - exact).norm() <= slack * exact.norm()


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("name", CASES)
def test_sums_over_axes_are_solved_as_by_lapack(name, dtype):
    along, periodic, shift = CASES[name]
    A = stencil(along, periodic, dtype, shift=shift)
    b = noise([len(f) - 1 for f in along], batch=3, dtype=dtype)

    def solve(c, b):
        return operators.Stencil(c, A.offsets, A.boundary), b

    found, here = there(solve, A.tensors[0], b, cotangent=b.flip(0)), Report(solve, (A.tensors[0], b), b.flip(0))
    exact = lapack(A, b)
    assert found.status == ["CONVERGED"] * 3 and found.iterations.tolist() == [1] * 3
    assert_close(found.u, exact, dtype)
    assert_close(found.gradients[1], exact.flip(0), dtype)  # A is symmetric
    assert_close(found.gradients[0], here.gradients[0].double(), dtype, 10)
    assert found.residual.max() < 1e3 * torch.finfo(dtype).eps


def line(n, kind, boundary, dtype, batch=3):
    """Coefficients (batch, 3, n) of lines that are dominant by rows or by columns, or neither."""
    before, behind = random(batch, n, seed=1), random(batch, n, seed=2)
    if kind == "rows":
        centre = before.abs() + behind.abs() + 0.1
    elif kind == "columns":
        centre = before.roll(-1, 1).abs() + behind.roll(1, 1).abs() + 0.1
    else:
        centre = random(batch, n, seed=3) * 0.5
    return torch.stack([centre, before, behind], 1).to(dtype)


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("boundary", ["zero", "periodic"])
@pytest.mark.parametrize("kind", ["rows", "columns", "neither"])
@pytest.mark.parametrize("n", [1, 2, 3, 7, 64, 65])
def test_lines_are_solved_as_by_lapack(n, kind, boundary, dtype):
    c, b = line(n, kind, boundary, dtype), random(3, 2, n, seed=4, dtype=dtype)
    if kind == "neither":
        dtype, c, b = F64, c.double(), b.double()

    def solve(c, b):
        return operators.Stencil(c, [(0,), (-1,), (1,)], boundary), b

    found = there(solve, c, b, cotangent=b.flip(0))
    A = operators.Stencil(c, [(0,), (-1,), (1,)], boundary)
    dense = A.dense().double()
    assert_close(found.u, lapack(A, b), dtype, 1e3 if kind == "neither" else 10)
    exact = torch.linalg.solve(dense.mT, b.double().flip(0).mT).mT
    assert_close(found.gradients[1], exact, dtype, 1e3 if kind == "neither" else 10)
    is_dominant = kind != "neither" or n == 1
    assert ("linalg_solve_ex" in found.device.operations) != is_dominant


def ring(c, b):
    return operators.Stencil(c, [(0,), (-1,), (1,)], "periodic"), b


def closed_line(kappa, periodic=False):
    """-(κ u')' without flux through the ends: (1, 3, n) for n faces before each cell."""
    before, behind = kappa.clone(), kappa.roll(-1)
    if not periodic:
        before[0] = behind[-1] = 0.0
    return torch.stack([before + behind, -before, -behind])[None]


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("n", [1, 2, 3, 33])
def test_a_line_with_a_constant_in_its_null_space(n, periodic):
    c = closed_line(1.0 + torch.rand(n, dtype=F64, generator=torch.Generator().manual_seed(0)), periodic)
    c, boundary = (c * 0.0 if n == 1 else c), "periodic" if periodic else "zero"
    b = random(2, 2, n)
    b = b - b.mean(-1, keepdim=True)

    def solve(c, b, nullspace="constant"):
        return operators.Stencil(c, [(0,), (-1,), (1,)], boundary, nullspace=nullspace), b

    found, here = there(solve, c, b, cotangent=b.flip(0)), Report(solve, (c, b), b.flip(0))
    inverse = torch.linalg.pinv(operators.Stencil(c, [(0,), (-1,), (1,)], boundary).dense())
    assert found.status == here.status
    torch.testing.assert_close(found.u, (inverse @ b.mT).mT, rtol=1e-10, atol=1e-12)
    for mine, other in zip(found.gradients, here.gradients, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-10, atol=1e-12)
    assert "linalg_solve_ex" not in found.device.operations
    if n > 1:
        found = there(lambda c, b: solve(c, b, None), c, b, on_failure="return")
        assert found.status == ["BREAKDOWN"] * 2 and not found.u.any()


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("periodic", [[True, True], [False, True], [False, False]], ids=str)
def test_a_named_null_space_gives_the_pseudo_inverse(periodic, dtype):
    along = [faces(n, closed=not p) for n, p in zip((8, 11), periodic, strict=True)]
    b = noise((8, 11), dtype=dtype)
    b = b - b.mean((-2, -1), keepdim=True)
    A = stencil(along, periodic, dtype)

    def solve(c, b, nullspace="constant"):
        return operators.Stencil(c, A.offsets, A.boundary, nullspace=nullspace), b

    found = there(solve, A.tensors[0], b)
    inverse = torch.linalg.pinv(A.dense().double())
    assert found.status == ["CONVERGED"] * 2
    assert_close(found.u, (inverse @ b.double().flatten(2).mT).mT.view_as(b), dtype)
    found = there(lambda c, b: solve(c, b, None), A.tensors[0], b, on_failure="return")
    assert found.status == ["BREAKDOWN"] * 2 and not found.u.any()
    found = there(solve, A.tensors[0], b + 1.0, on_failure="return")
    assert found.status == ["INCONSISTENT"] * 2


EQUATIONS = {
    "heat": lambda b, c: (operators.Heat((9,), c.mean().abs(), 1.0), b[:, :1]),
    "long heat": lambda b, c: (operators.Heat((5000,), c.mean().abs(), 1e-6), b[:, :1, :1].expand(-1, 1, 5000)),
    "poisson": lambda b, c: (operators.Poisson((9,)), b[:, :1]),
    "burgers": lambda b, c: (operators.Burgers(c[:, :1], 1e-2, 0.1), b[:, :1]),
    "diffusion": lambda b, c: (operators.Diffusion(c[:, 0].abs() + 0.1, c[:, 1].abs(), [("zero", "flux")], 2.0), b),
    "closed diffusion": lambda b, c: (operators.Diffusion(c[:, 0].abs() + 0.1, 0.0, "flux"), b - b.mean(-1, True)),
}  # fmt: skip


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("name", EQUATIONS)
def test_equations_have_the_derivatives_of_the_cpu(name, backward):
    """First and second ones."""

    def run(b, c, cotangent):
        a, rhs = EQUATIONS[name](b, c)
        u = prdp.linear_solve(a, rhs, prdp.Direct(), backward=backward)[0]
        first = torch.autograd.grad(
            (u * cotangent[..., : u.shape[-1]]).sum(), [b, c], create_graph=True, allow_unused=True
        )
        known = [g for g in first if g is not None]
        second = torch.autograd.grad(sum(g.square().sum() for g in known), [b, c], allow_unused=True)
        return u, *first, *second

    inputs = [random(2, 2, 9), random(2, 2, 9, seed=1), random(2, 1, 5000, seed=2)]
    expected = run(*(t.clone().requires_grad_() for t in inputs))
    device = StandIn()
    with device:
        found = run(*(device.send(t).requires_grad_() for t in inputs))
    for mine, other in zip(found, expected, strict=True):
        assert (mine is None) == (other is None)
        if other is not None:
            torch.testing.assert_close(device.fetch(mine), other, rtol=1e-7, atol=1e-9)


def constant(shape, boundary, length=1.0):
    return lambda send: operators.Diffusion(
        send(torch.full((1, *shape), 1.5, dtype=F64)), 0.4, boundary=boundary, length=length
    )


CONSTANT = {
    "heat 3D": lambda send: operators.Heat((5, 4, 6), 0.3, 1.0),
    "poisson 2D": lambda send: operators.Poisson((7, 9)),
    "poisson 3D": lambda send: operators.Poisson((4, 5, 6)),
    "diffusion 2D": constant((7, 9), ("zero", "flux"), (1.0, 2.0)),
    "diffusion 3D": constant((4, 5, 6), ("periodic", "flux", "zero")),
    "robin": constant((7, 9), ("zero", (("robin", 2.0), "flux"))),
    "robin 3D": constant((4, 5, 6), ("periodic", "flux", (("robin", 2.0), ("robin", 5.0)))),
}


@pytest.mark.parametrize("name", CONSTANT)
def test_constant_equations_in_boxes_are_solved_as_by_lapack(name):
    """By sums over the axes, not by a dense matrix; A is symmetric, so the gradient of b is a solve, too."""
    here, device = CONSTANT[name](lambda t: t), StandIn()
    b = noise(here.shape, channels=1)
    with device:
        given = device.send(b).requires_grad_()
        u, info = prdp.linear_solve(CONSTANT[name](device.send), given, prdp.Direct())
        (gradient,) = torch.autograd.grad(u, given, device.send(b.flip(0)))
    assert device.fetch(info.status).tolist() == [prdp.SolveStatus.CONVERGED] * 2
    exact = lapack(here, b)
    assert_close(device.fetch(u), exact, F64)
    assert_close(device.fetch(gradient), exact.flip(0), F64)
    assert "linalg_solve_ex" not in device.operations and device.largest <= 4 * b.numel() + 4 * max(here.shape) ** 2


def box(samples, shape=(6, 7)):
    """(samples, 5, *shape): constant coefficients that differ between samples."""
    centre = torch.arange(5, samples + 5, dtype=F64).view(-1, 1, 1, 1).expand(-1, 1, *shape)
    return centre * torch.tensor([1.0, -0.1, -0.1, -0.2, -0.2], dtype=F64).view(5, 1, 1)


FIVE = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)]


def in_a_box(boundary):
    return lambda c, b: (operators.Stencil(c, FIVE, boundary), b)


@pytest.mark.parametrize("boundary", ["zero", "periodic", ("periodic", "zero")], ids=str)
def test_samples_of_all_kinds_beside_each_other(boundary):
    """Two sums, one that is none, a singular one, a NaN, a badly scaled one, an Inf and a zero b."""
    c, b = box(8), random(8, 2, 6, 7)
    c[2, 0, 3, 3] += 1.0
    c[3] = 0.0
    c[4, 1, 2, 2] = torch.nan
    c[5, :, 2] *= 2.0**90
    b[5, :, 2] *= 2.0**90
    b[6, 0, 1, 1], b[7] = torch.inf, 0.0
    solve = in_a_box(boundary)
    found, here = there(solve, c, b, on_failure="return"), Report(solve, (c, b), on_failure="return")
    assert found.status == here.status
    assert found.status[3:5] == ["BREAKDOWN", "NONFINITE_OPERATOR"] and found.status[6] == "NONFINITE_INPUT"
    assert_close(found.u, here.u, F64)
    for s in range(8):
        alone = there(solve, c[s : s + 1], b[s : s + 1], on_failure="return")
        assert torch.equal(alone.u[0], found.u[s]) and alone.status == found.status[s : s + 1]
        assert torch.equal(alone.residual[0], found.residual[s])


def test_a_penalty_along_a_whole_line_of_cells_is_no_constant_coefficient():
    c, b = box(1), random(1, 1, 6, 7)
    c[0, 0, :, 3] += 1e20
    found = there(in_a_box("zero"), c, b)
    assert_close(found.u, lapack(operators.Stencil(c, FIVE, "zero"), b), F64)


def test_lines_of_all_kinds_beside_each_other():
    c, b = line(12, "rows", "periodic", F64, batch=7), random(7, 2, 12)
    c[1] = line(12, "neither", "periodic", F64)[0]
    c[2] = closed_line(torch.ones(12, dtype=F64), periodic=True)[0]
    c[3, 0, 3] = torch.inf
    c[4, :, 5] *= 2.0**200
    b[4, :, 5] *= 2.0**200
    b[5] = 0.0
    found, here = there(ring, c, b, on_failure="return"), Report(ring, (c, b), on_failure="return")
    assert found.status == here.status and found.status[2:4] == ["BREAKDOWN", "NONFINITE_OPERATOR"]
    assert_close(found.u, here.u, F64)
    for s in range(7):
        alone = there(ring, c[s : s + 1], b[s : s + 1], on_failure="return")
        assert torch.equal(alone.u[0], found.u[s]) and alone.status == found.status[s : s + 1]


def test_rows_and_columns_of_other_sizes_in_a_small_dense_system():
    m, sizes = random(40, 40) + 8 * torch.eye(40), 10 ** torch.linspace(-8, 8, 40, dtype=F64)
    for rows, columns in ((sizes, None), (None, sizes), (sizes, sizes.flip(0))):
        a = m if rows is None else rows[:, None] * m
        a = a if columns is None else a * columns
        b = random(2, 40, seed=1) * (1.0 if rows is None else rows)
        found = there(lambda a, b: (operators.Matrix(a), b), a, b)
        exact, scale = torch.linalg.solve(a, b.mT).mT, 1.0 if columns is None else columns
        assert ((found.u - exact) * scale).norm() <= 1e-13 * (exact * scale).norm()
        assert found.status == ["CONVERGED"] * 2


@pytest.mark.parametrize("diffusion", ["explicit", "implicit"])
@pytest.mark.parametrize("name", BOXES)
def test_a_flow_takes_the_direct_solver(name, diffusion):
    def rollout(u, send=lambda t: t):
        options = {k: send(v) if isinstance(v, torch.Tensor) else v for k, v in BOXES[name].items()}
        flow = prdp.Flow((12, 16), nu=0.01, dt=0.01, solver=prdp.Direct(), diffusion=diffusion, **options)
        states = flow.rollout(u, 2)
        return states, torch.autograd.grad(states.square().sum(), u)[0]

    u = noise((12, 16), channels=2).mul_(0.3)
    expected = rollout(u.clone().requires_grad_())
    device = StandIn()
    with device:
        found = rollout(device.send(u).requires_grad_(), device.send)
    for mine, other in zip(found, expected, strict=True):
        torch.testing.assert_close(device.fetch(mine), other, rtol=0, atol=1e-11 * float(other.detach().abs().max()))
    if name != "obstacle":
        assert "linalg_solve_ex" not in device.operations
