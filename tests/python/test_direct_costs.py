"""What `Direct` takes on a device, by the stand-in: memory, operations and looks of the host; and what is refused."""

import math
import re

import pytest
import torch
from helpers import statuses
from stand_in_device import StandIn
from test_direct_on_devices import F32, F64, FIVE, assert_close, box, in_a_box, lapack, line, random, there

import prdp_torch as prdp
from prdp_torch import operators

LARGE = {
    "periodic box": lambda send: operators.Stencil(send(box(1, (128, 130))), FIVE, "periodic"),
    "box": lambda send: operators.Stencil(send(box(1, (128, 130))), FIVE, "zero"),
    "heat": lambda send: operators.Heat((128, 130), 0.1, 1.0),
    "line": lambda send: operators.Stencil(send(line(16640, "rows", "zero", F64, 1)), [(0,), (-1,), (1,)], "periodic"),
    "long heat": lambda send: operators.Heat((16640,), 0.1, 1.0),
    "burgers": lambda send: operators.Burgers(send(random(1, 1, 16640)), 0.1, 1e-3),
}  # fmt: skip


@pytest.mark.parametrize("name", LARGE)
def test_no_dense_matrix_of_a_large_grid_is_formed(name):
    device = StandIn()
    with device:
        a = LARGE[name](device.send)
        b = device.send(random(2, 1, *a.shape)).requires_grad_()
        u, info = prdp.linear_solve(a, b, prdp.Direct(rtol=1e-8))
        torch.autograd.grad(u.sum(), b)
        assert statuses(type("Info", (), {"status": device.fetch(info.status)})) == ["CONVERGED"] * 2
    assert device.largest <= 16 * 16640
    assert "linalg_solve_ex" not in device.operations


@pytest.mark.parametrize("boundary, count", [("periodic", 30), ("zero", 35)])
def test_the_host_looks_once_at_a_solve_with_the_same_coefficients(boundary, count):
    device = StandIn()
    with device:
        a = operators.Stencil(device.send(box(1)), FIVE, boundary)
        b = device.send(random(2, 1, 6, 7))
        prdp.linear_solve(a, b, prdp.Direct())
        looks, launched = device.copies_to_host, device.launched()
        for _ in range(3):
            prdp.linear_solve(a, b, prdp.Direct())
        assert device.copies_to_host == looks + 3 and device.launched() - launched <= 3 * count
        looks = device.copies_to_host
        a.tensors[0].mul_(2.0)
        doubled = prdp.linear_solve(a, b, prdp.Direct())[0]
        assert device.copies_to_host == looks + 2  # and once at the coefficients
    exact = lapack(operators.Stencil(2.0 * box(1), FIVE, boundary), random(2, 1, 6, 7))
    assert_close(device.fetch(doubled), exact, F64)


COUNTED = {  # an operator, a channel of b, and the operations of a solve at most
    "periodic box": (lambda send: operators.Stencil(send(box(1)), FIVE, "periodic"), 30),
    "box": (lambda send: operators.Stencil(send(box(1)), FIVE, "zero"), 35),
    "heat": (lambda send: operators.Heat((6, 7), 0.1, 1.0), 36),
    "heat 3D": (lambda send: operators.Heat((3, 4, 5), send(torch.tensor(0.1)), 1.0), 46),
    "poisson": (lambda send: operators.Poisson((6, 7)), 31),
}  # fmt: skip


@pytest.mark.parametrize("name", COUNTED)
def test_a_solve_takes_few_operations_and_one_look(name):
    make, most = COUNTED[name]
    device = StandIn()
    with device:
        a = make(device.send)
        b = random(3, 1, *a.shape)
        b[1] = 0.0
        prdp.linear_solve(a, device.send(b), prdp.Direct())
        looks, launched = device.copies_to_host, device.launched()
        u, info = prdp.linear_solve(a, device.send(b), prdp.Direct())
        assert device.launched() - launched <= most
        assert device.copies_to_host - looks == 1
        assert device.fetch(info.iterations).tolist() == [1, 0, 1] and not device.fetch(u)[1].any()
        assert device.fetch(info.residual)[1] == 0.0
    exact = lapack(make(lambda t: t), b)
    assert_close(device.fetch(u), exact, F64)


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("boundary", ["zero", "periodic"])
def test_right_hand_sides_at_the_ends_of_the_range(boundary, dtype):
    """The bits of an ordinary one are those that it has beside others of its kind."""
    ends = (1e-37, 1e36) if dtype == F32 else (1e-300, 1e300)
    b = random(3, 1, 6, 7, dtype=dtype)
    factors = [2.0 ** round(math.log2(end)) for end in ends]
    b[1], b[2] = b[0] * factors[0], b[0] * factors[1]
    found = there(in_a_box(boundary), box(1).to(dtype), b)
    assert found.status == ["CONVERGED"] * 3
    ordinary = there(in_a_box(boundary), box(1).to(dtype), b[:1].expand(3, -1, -1, -1))
    assert torch.equal(ordinary.u[0], found.u[0]) and torch.equal(ordinary.residual[0], found.residual[0])
    assert_close(found.u[1] / factors[0], found.u[0].double(), dtype)
    assert_close(found.u[2] / factors[1], found.u[0].double(), dtype)


REFUSED = {
    "varying": ((65, 64), lambda c: operators.Stencil(c[:, :5], FIVE, "zero")),
    "far": ((4097,), lambda c: operators.Stencil(c[:, :2], [(0,), (2,)], "zero")),
    "diffusion": ((65, 64), lambda c: operators.Diffusion(c[:, 0], 1.0)),
    "null space": ((65, 64), lambda c: operators.Diffusion(c[:, 0], 0.0, "flux")),
    "burgers": ((65, 64), lambda c: operators.Burgers(c[:, :2], 1e-2, 1.0)),
    "navier_stokes": ((38, 38), lambda c: operators.NavierStokes(c[:, :2], 1e-2, 1.0)),
    "function": ((65, 64), lambda c: operators.Function(lambda v: v * 2.0)),
    "batch": ((64, 64), lambda c: operators.Stencil(c[:, :5].expand(5, 5, 64, 64), FIVE, "zero")),
}
CHANNELS = {"burgers": 2, "navier_stokes": 3}


@pytest.mark.parametrize("name", REFUSED)
def test_what_would_take_a_large_dense_matrix_is_refused(name):
    shape, make = REFUSED[name]
    device = StandIn()
    with device:
        a = make(device.send(random(1, 5, *shape).exp()))
        b = device.send(random(5 if name == "batch" else 1, CHANNELS.get(name, 1), *shape))
        with pytest.raises(NotImplementedError, match=r"Direct on lazy:0 solves .* take CG .* or GMRES"):
            prdp.linear_solve(a, b, prdp.Direct())
    assert device.largest < 4096**2


def test_a_dense_matrix_of_a_grid_is_not_made_in_silence(capfd):
    device = StandIn()
    with device:
        for size, words in (
            (16, ""),
            (17, "Direct on lazy:0 has no fast way .* dense matrix of 289 unknowns, .*; take CG"),
        ):
            kappa = device.send(random(1, size, size).exp())
            torch.set_warn_always(True)
            try:
                prdp.linear_solve(operators.Diffusion(kappa, 1.0), device.send(random(1, 1, size, size)), prdp.Direct())
            finally:
                torch.set_warn_always(False)
            said = capfd.readouterr().err  # where warnings go while a mode of torch is at work
            assert re.search(words, said) if words else not said


def test_a_large_sparse_matrix_is_refused():
    unit = torch.eye(4097, dtype=F64).to_sparse_csr()
    device = StandIn()
    with device:
        parts = [device.send(t) for t in (unit.crow_indices(), unit.col_indices(), unit.values())]
        a = operators.Matrix.csr(*parts, 4097)
        with pytest.raises(NotImplementedError, match=r"got 1 matrix of 4097 unknowns"):
            prdp.linear_solve(a, device.send(random(1, 4097)), prdp.Direct())
