"""`Direct` for a field that is coupled along one axis alone: no zero beside it fills in."""

import pytest
import torch

import prdp_torch as prdp
from prdp_torch import _C, operators

F64 = torch.float64


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_field_is_solved_as_its_columns_are(axis, symmetric):
    shape = (10, 11, 12)
    generator = torch.Generator().manual_seed(axis)
    inner = torch.rand(1, *shape, dtype=F64, generator=generator).narrow(axis + 1, 0, shape[axis] - 1)
    width = torch.ones(()) if symmetric else torch.linspace(1, 9, shape[axis], dtype=F64)
    width = width.view(-1, *[1] * (2 - axis)) if not symmetric else width
    edge = torch.zeros_like(inner.narrow(axis + 1, 0, 1))
    low, high = torch.cat([edge, inner], axis + 1) / width, torch.cat([inner, edge], axis + 1) / width
    rows = torch.stack([1 + low + high, -low, -high], 1)
    along = [tuple(side * (a == axis) for a in range(3)) for side in (-1, 1)]
    b = torch.rand(1, 1, *shape, dtype=F64, generator=generator)

    _C.clear_factorisations()
    u, _ = prdp.linear_solve(operators.Stencil(rows, [(0, 0, 0), *along]), b, prdp.Direct())
    assert _C.bytes_of_factorisations() < 100 * b.numel() + 200_000  # four numbers for each cell with their places

    def columns(t):
        return t.movedim(axis + 2, -1).flatten(2, 3)[0].movedim(1, 0)

    v, _ = prdp.linear_solve(operators.Stencil(columns(rows), [(0,), (-1,), (1,)]), columns(b), prdp.Direct())
    torch.testing.assert_close(columns(u), v, rtol=1e-12, atol=1e-13)
