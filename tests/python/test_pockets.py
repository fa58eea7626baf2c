"""Parts of a grid that nothing couples to the rest: coarse grids of multigrid do not resolve them."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from stand_in_device import StandIn

import prdp_torch as prdp
from prdp_torch import operators

F32, F64 = torch.float32, torch.float64
OFFSETS = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
MULTIGRID = {"preconditioner": "multigrid"}


def noise(*shape, seed=0, dtype=F64):
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed)).to(dtype)


def hollow(shape, generator):
    """Solid boxes of which some are hollow inside."""
    mask = np.zeros(shape, bool)
    for _ in range(3):
        size = [int(generator.integers(3, min(9, n - 2))) for n in shape]
        at = [int(generator.integers(1, n - s)) for n, s in zip(shape, size, strict=True)]
        box = tuple(slice(a, a + s) for a, s in zip(at, size, strict=True))
        inside = tuple(slice(a + 1, a + s - 1) for a, s in zip(at, size, strict=True))
        mask[box] = True
        mask[inside] = bool(generator.random() < 0.2)
    return torch.tensor(mask)


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**20),
    boundary=st.sampled_from(["periodic", "wall", ("wall", "periodic")]),
    shape=st.sampled_from([(16, 16), (21, 32)]),
    length=st.sampled_from([1.0, 2 * np.pi, (1.0, 7.0)]),
    dtype=st.sampled_from([F32, F64]),
)
def test_a_flow_round_hollow_obstacles_takes_its_steps_and_their_gradient(seed, boundary, shape, length, dtype):
    """In the second step there is little divergence left, beside which rounding counts: with cells that are not square
    float32 makes the operator of the pressure indefinite."""
    mask = hollow(shape, np.random.default_rng(seed))
    flow = prdp.Flow(shape, 1e-3, 1e-2, boundary=boundary, length=length, obstacle=mask, force=(0.1, 0.0))
    u = (0.1 * noise(1, 2, *shape, seed=seed, dtype=dtype)).requires_grad_()
    after = flow(flow(u))
    after.square().sum().backward()
    assert flow.info.solved.all() and flow.info.iterations.max() <= 40
    assert flow.divergence(after).abs().max() <= 1e-2 * flow.divergence(u).abs().max()
    assert u.grad.isfinite().all()


def blocks(n, size, dtype):
    """-∇·(κ ∇u) on n × n cells in blocks of size × size, through whose sides no flux passes; and its null space."""
    kappa = torch.exp(noise(n, n))
    of_axis = torch.arange(n) // size
    block = of_axis[:, None] * n + of_axis
    fields = []
    for offset in OFFSETS[1:]:
        there = kappa.roll([-o for o in offset], (0, 1))
        inside = block == block.roll([-o for o in offset], (0, 1))
        axis, end = (0, offset[0]) if offset[0] else (1, offset[1])
        inside.select(axis, -1 if end > 0 else 0).fill_(False)
        fields.append(2 * kappa * there / (kappa + there) * inside)
    coefficients = torch.stack([sum(fields), *(-f for f in fields)])[None].to(dtype)
    return coefficients, torch.stack([block == k for k in block.unique()]).to(dtype)


def without(null_space, b):
    q = null_space.flatten(1).double()
    q = q / q.norm(dim=1, keepdim=True)
    rows = b.flatten(2).double()
    return (rows - rows @ q.T @ q).view_as(b).to(b.dtype)


SOLVERS = {
    "cg": prdp.CG(30, 1e-5, **MULTIGRID),
    "gmres": prdp.GMRES(2, 1e-5, restart=20, **MULTIGRID),
    "cycles": prdp.Multigrid(60, 1e-5),
}


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("n, size", [(16, 8), (32, 5), (14, 2), (30, 3)])
def test_blocks_that_do_not_touch(n, size, dtype, solver):
    coefficients, null_space = blocks(n, size, dtype)
    a = operators.Stencil(coefficients, OFFSETS, nullspace=null_space)
    b = without(null_space, noise(1, 1, n, n, dtype=dtype)).requires_grad_()
    cotangent = without(null_space, noise(1, 1, n, n, seed=1, dtype=dtype))
    u, info = prdp.linear_solve(a, b, SOLVERS[solver])
    u.backward(cotangent)
    assert info.solved.all() and info.adjoint.solved.all()
    m = operators.Stencil(coefficients.double(), OFFSETS)
    m = m.apply(torch.eye(n * n, dtype=F64).view(n * n, 1, n, n)).flatten(1).T
    q = null_space.flatten(1).double()
    m = m + q.T @ q
    for found, rhs in ((u.detach(), b.detach()), (b.grad, cotangent)):
        exact = torch.linalg.solve(m, rhs.double().flatten())
        assert (found.flatten() - exact).norm() <= 3e-4 * exact.norm()


@pytest.mark.parametrize("n, size", [(16, 8), (30, 3)])
def test_blocks_that_do_not_touch_on_devices_without_loops(n, size):
    coefficients, null_space = blocks(n, size, F64)
    b = without(null_space, noise(1, 1, n, n))
    exact, here = prdp.linear_solve(operators.Stencil(coefficients, OFFSETS), b, SOLVERS["cg"])
    with StandIn() as device:
        a = operators.Stencil(device.send(coefficients), OFFSETS)
        u, info = prdp.linear_solve(a, device.send(b), SOLVERS["cg"])
        u, iterations = device.fetch(u), int(device.fetch(info.iterations))
    assert abs(iterations - int(here.iterations)) <= 1
    assert (without(null_space, u) - without(null_space, exact)).norm() <= 1e-4 * exact.norm()


@pytest.mark.parametrize("boundary", ["zero", "flux"])
@pytest.mark.parametrize("inside", [2, 3, 6])
def test_a_pocket_behind_a_contrast_that_float32_does_not_see(inside, boundary):
    n, first = 32, 12
    kappa = torch.ones(n, n, dtype=F64)
    kappa[first : first + inside + 2, first : first + inside + 2] = 1e-8
    kappa[first + 1 : first + inside + 1, first + 1 : first + inside + 1] = 1.0
    b = noise(1, 1, n, n)
    b[0, 0, first + 1 : first + inside + 1, first + 1 : first + inside + 1] = 0.0
    exact = prdp.linear_solve(operators.Diffusion(kappa[None], 1.0, boundary), b, prdp.Direct())[0]
    rhs = b.float().requires_grad_()
    a = operators.Diffusion(kappa[None].float(), 1.0, boundary)
    u, info = prdp.linear_solve(a, rhs, prdp.CG(30, **MULTIGRID))
    u.sum().backward()
    assert info.solved.all() and info.adjoint.solved.all()
    assert (u - exact).norm() <= 1e-3 * exact.norm()


def test_the_row_of_a_zero_on_the_diagonal_is_named_and_no_other():
    coefficients = torch.tensor([4.0, -1, -1, -1, -1]).view(1, 5, 1, 1).repeat(1, 1, 9, 9)
    coefficients[0, :, 2, 5] = 0.0
    for solver in (prdp.Jacobi(5), prdp.CG(5, preconditioner="diagonal"), prdp.CG(5, **MULTIGRID)):
        with pytest.raises(torch.linalg.LinAlgError, match=r"ZERO_DIAGONAL in row \(0, 2, 5\)"):
            prdp.linear_solve(operators.Stencil(coefficients, OFFSETS), noise(1, 1, 9, 9, dtype=F32), solver)


def test_where_multigrid_finds_no_coarse_grid_no_row_is_named():
    """A diagonal whose inverse is beyond the range of float32."""
    coefficients = torch.tensor([4.0, -1, -1, -1, -1]).view(1, 5, 1, 1).repeat(1, 1, 9, 9)
    coefficients[0, 0, 2, 5] = 1e-40
    with pytest.raises(torch.linalg.LinAlgError, match=r"ZERO_DIAGONAL, CG .* multigrid finds no coarse grid for A"):
        prdp.linear_solve(
            operators.Stencil(coefficients, OFFSETS), noise(1, 1, 9, 9, dtype=F32), prdp.CG(5, **MULTIGRID)
        )
