"""`Direct` on stencils that are sums of operators along the axes, beside dense LAPACK; and on flows in boxes."""

import pytest
import torch
from helpers import statuses

import prdp_torch as prdp
from prdp_torch import _C, operators

F32, F64 = torch.float32, torch.float64


def stencil(along, periodic, dtype=F64, nullspace=None, shift=0.0):
    """Σ_d A_d + shift, where `along` has the coupling on the n + 1 faces of each axis, the last one for both ends of a
    periodic one."""
    shape, dim = tuple(len(faces) - 1 for faces in along), len(along)
    fields, offsets = [torch.full(shape, shift, dtype=F64)], [(0,) * dim]
    for axis, faces in enumerate(along):
        sides = torch.stack([faces[:-1], faces[1:]])
        if periodic[axis]:
            sides[1, -1] = faces[0]
        for step, coupling in zip((-1, 1), sides, strict=True):
            field = coupling.reshape([-1 if d == axis else 1 for d in range(dim)]).expand(shape)
            fields[0] = fields[0] + field
            fields.append(-field)
            offsets.append(tuple(step if d == axis else 0 for d in range(dim)))
    boundary = ["periodic" if p else "zero" for p in periodic]
    return operators.Stencil(torch.stack(fields)[None].to(dtype), offsets, boundary, nullspace=nullspace)


def faces(n, seed=None, closed=False):
    couplings = torch.ones(n + 1, dtype=F64)
    if seed is not None:
        couplings += torch.rand(n + 1, dtype=F64, generator=torch.Generator().manual_seed(seed))
    if closed:  # nothing passes the two ends
        couplings[0] = couplings[-1] = 0.0
    return couplings


CASES = {
    "periodic": ([faces(12), faces(9)], [True, True], 0.3),
    "periodic, varying": ([faces(12, seed=5), faces(9)], [True, True], 0.3),
    "periodic cubes": ([faces(5), 2 * faces(4), faces(7)], [True, True, True], 0.2),
    "zero": ([faces(7), faces(12)], [False, False], 0.0),
    "mixed": ([faces(8), faces(5)], [True, False], 0.0),
    "walls": ([faces(6, closed=True), faces(5, closed=True)], [False, False], 0.1),
    "varying": ([faces(9, seed=1), faces(4, seed=2)], [False, True], 0.0),
    "cubes": ([faces(4, seed=3), faces(3), faces(5, closed=True)], [False, True, False], 0.2),
    "negative": ([-faces(6), -faces(7)], [False, False], 0.0),
}


def noise(shape, batch=2, channels=2, dtype=F64):
    return torch.randn(batch, channels, *shape, dtype=F64, generator=torch.Generator().manual_seed(4)).to(dtype)


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("name", CASES)
def test_solution_and_gradients_are_those_of_lapack(name, dtype):
    along, periodic, shift = CASES[name]
    A = stencil(along, periodic, dtype, shift=shift)
    b = noise([len(f) - 1 for f in along], dtype=dtype).requires_grad_()
    u, info = prdp.linear_solve(A, b, prdp.Direct())
    assert statuses(info) == ["CONVERGED"] * 2 and info.iterations.tolist() == [1, 1]
    dense = A.dense().double().squeeze(0)
    exact = torch.linalg.solve(dense, b.detach().double().flatten(2).mT).mT.view_as(b)
    bound = 1e-4 if dtype == F32 else 1e-12
    assert (u - exact).norm() < bound * exact.norm()
    (gradient,) = torch.autograd.grad(u, b, b.detach())
    assert (gradient - exact).norm() < bound * exact.norm()  # A is symmetric


def test_the_gradient_of_the_coefficients_is_exact():
    A = stencil([faces(4, seed=1), faces(3)], [False, True])
    b = noise((4, 3), batch=1, channels=1)

    def solve(coefficients, b):
        changed = operators.Stencil(coefficients, A.offsets, A.boundary)
        return prdp.linear_solve(changed, b, prdp.Direct())[0]

    # Central differences leave the sums over axes, so they are solved by sparse factors.
    assert torch.autograd.gradcheck(solve, (A.tensors[0].clone().requires_grad_(), b.requires_grad_()))


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("periodic", [[True, True], [False, True], [False, False]], ids=str)
def test_a_named_null_space_gives_the_pseudo_inverse(periodic, dtype):
    along = [faces(n, closed=not p) for n, p in zip((8, 11), periodic, strict=True)]
    b = noise((8, 11), dtype=dtype)
    b = b - b.mean((-2, -1), keepdim=True)
    u, info = prdp.linear_solve(stencil(along, periodic, dtype, "constant"), b, prdp.Direct())
    assert statuses(info) == ["CONVERGED"] * 2
    inverse = torch.linalg.pinv(stencil(along, periodic).dense().squeeze(0))
    exact = (inverse @ b.double().flatten(2).mT).mT.view_as(b)
    assert (u - exact).norm() < (1e-5 if dtype == F32 else 1e-12) * exact.norm()
    with pytest.raises(torch.linalg.LinAlgError, match="BREAKDOWN"):
        prdp.linear_solve(stencil(along, periodic, dtype), b, prdp.Direct())


def test_a_large_solve_needs_no_sparse_factors():
    """The eigenvectors are made once, for the adjoint and for later solves."""
    A = stencil([faces(300), faces(300)], [True, True], shift=1e-3)
    b = noise((300, 300), batch=1, channels=1).requires_grad_()
    _C.clear_factorisations()
    made = _C.count_factorisations()
    for _ in range(3):
        u, info = prdp.linear_solve(A, b, prdp.Direct(rtol=1e-10))
        u.sum().backward()
    assert _C.count_factorisations() == made + 1 and statuses(info) == ["CONVERGED"]


def test_threads_and_the_rest_of_a_batch_do_not_change_a_bit():
    A = stencil([faces(40), faces(30)], [True, True], F32, shift=0.1)
    b = noise((40, 30), batch=5, dtype=F32)
    before = torch.get_num_threads()
    answers = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        answers.append(prdp.linear_solve(A, b, prdp.Direct())[0])
    torch.set_num_threads(before)
    assert torch.equal(*answers)
    for i in range(5):
        assert torch.equal(prdp.linear_solve(A, b[i : i + 1], prdp.Direct())[0], answers[0][i : i + 1])


def test_a_stencil_that_is_no_sum_is_solved_as_well():
    A = stencil(*CASES["varying"][:2])
    coefficients = A.tensors[0].clone()
    coefficients[0, 0, 5, 2] += 1.0  # one entry in the middle
    changed = operators.Stencil(coefficients, A.offsets, A.boundary)
    b = noise((9, 4), batch=1, channels=1)
    u, info = prdp.linear_solve(changed, b, prdp.Direct())
    exact = torch.linalg.solve(changed.dense().squeeze(0), b.flatten())
    assert statuses(info) == ["CONVERGED"] and torch.allclose(u.flatten(), exact, rtol=1e-12, atol=1e-12)


BOXES = {
    "periodic": {},
    "walls": {"boundary": "wall"},
    "channel": {"boundary": ("wall", "open"), "inflow": torch.tensor([1.0, 0.0], dtype=F64)},
    "long cells": {"length": (1.0, 3.0)},
    "obstacle": {"obstacle": torch.zeros(12, 16, dtype=torch.bool).index_put_((torch.tensor(5), torch.tensor(7)),
                                                                             torch.tensor(True))},
}  # fmt: skip


@pytest.mark.parametrize("name", BOXES)
def test_a_flow_takes_the_direct_solver(name):
    def flow(solver):
        return prdp.Flow((12, 16), nu=0.01, dt=0.01, solver=solver, **BOXES[name])

    u = noise((12, 16), channels=2).mul_(0.3).requires_grad_()
    direct, iterated = flow(prdp.Direct()), flow(prdp.CG(300, rtol=1e-12, preconditioner="multigrid"))
    states, reference = direct.rollout(u, 3), iterated.rollout(u, 3)
    assert (states - reference).abs().max() < 1e-9
    assert direct.divergence(states[:, -1]).abs().max() < 1e-10
    cotangent = noise(states.shape[3:], batch=2, channels=8).view_as(states)
    (gradient,) = torch.autograd.grad(states, u, cotangent)
    (wanted,) = torch.autograd.grad(reference, u, cotangent)
    assert (gradient - wanted).abs().max() < 1e-8 * wanted.abs().max()
