"""A null space for each sample, (batch, k, channels, *shape)."""

import pytest
import torch
from fibers import Fibers
from helpers import statuses

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64
OFFSETS = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
SHAPE = (6, 7)


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def basins():
    """Cells of water: one basin, two apart, one with an island."""
    water = torch.ones(3, *SHAPE, dtype=F64)
    water[1, :, 3] = 0
    water[2, 2:4, 2:5] = 0
    return water


def laplacian(water):
    """No flux at coasts; identity rows on land."""
    pad = torch.nn.functional.pad
    x, y = water[:, :, 1:] * water[:, :, :-1], water[:, 1:] * water[:, :-1]
    west, east = pad(x, (1, 0)), pad(x, (0, 1))
    south, north = pad(y, (0, 0, 1, 0)), pad(y, (0, 0, 0, 1))
    return torch.stack([west + east + south + north + (1 - water), -west, -east, -south, -north], 1)


def null_vectors(water):
    """(3, 2, 1, *shape): the water of each basin; zeros for the second of a sample with one."""
    vectors = torch.zeros(3, 2, 1, *SHAPE, dtype=F64)
    vectors[:, 0, 0] = water
    vectors[1, 0, 0, :, 3:] = 0
    vectors[1, 1, 0] = water[1]
    vectors[1, 1, 0, :, :4] = 0
    return vectors


def in_range(b, vectors):
    rows = vectors.flatten(2)
    size = rows.square().sum(-1, keepdim=True).clamp_min(1)
    flat = b.flatten(2)
    return (flat - (flat @ rows.mT) @ (rows / size)).view_as(b)


def dense(a):
    n = SHAPE[0] * SHAPE[1]
    columns = [a.apply(torch.eye(n, dtype=F64)[i].view(1, 1, *SHAPE).expand(3, 1, *SHAPE)).flatten(1) for i in range(n)]
    return torch.stack(columns, -1)


SOLVERS = {
    "cg": prdp.CG(200, 1e-12),
    "multigrid": prdp.CG(60, 1e-12, preconditioner="multigrid"),
    "gmres": prdp.GMRES(20, 1e-12, restart=42),
    "bicgstab": prdp.BiCGStab(200, 1e-12),
    "minres": prdp.MINRES(200, 1e-12),
    "direct": prdp.Direct(),
}


def expected(water, b, weights, rows):
    """By the pseudo-inverse, the gradient of the rows along the given water too."""
    a = operators.Stencil(rows, OFFSETS)
    inverse = torch.linalg.pinv(dense(a), rcond=1e-10, hermitian=True)
    u = (inverse @ b.flatten(1)[..., None]).view_as(b)
    b_bar = (inverse @ weights.flatten(1)[..., None]).view_as(b)
    return u, b_bar


@pytest.mark.parametrize(
    "name, way",
    [(name, way) for name in SOLVERS for way in ("loops", "kernels") if (name, way) != ("direct", "kernels")],
)
def test_u_and_gradients_are_those_of_the_pseudo_inverse(name, way):
    water = basins()
    rows, vectors = laplacian(water).requires_grad_(), null_vectors(water)
    b = in_range(noise(3, 1, *SHAPE), vectors).requires_grad_()
    weights = noise(3, 1, *SHAPE, seed=1)  # has a part in the null space

    def run():
        a = operators.Stencil(rows, OFFSETS, nullspace=vectors)
        u, info = prdp.linear_solve(a, b, SOLVERS[name])
        assert info.solved.all()
        return u, *torch.autograd.grad(u, (b, rows), weights)

    if way == "kernels":
        with Fibers():
            u, b_bar, rows_bar = run()
    else:
        u, b_bar, rows_bar = run()
    with torch.no_grad():
        exact, exact_bar = expected(water, b, weights, rows.detach())
    torch.testing.assert_close(u, exact, rtol=0, atol=1e-9)
    torch.testing.assert_close(b_bar, exact_bar, rtol=0, atol=1e-9)
    # -λ uᵀ at the entries of the stencil
    pairs = -b_bar.detach()[:, 0], u.detach()[:, 0]
    torch.testing.assert_close(rows_bar[:, 0], pairs[0] * pairs[1], rtol=0, atol=1e-8)
    torch.testing.assert_close(rows_bar[:, 1, :, 1:], pairs[0][..., 1:] * pairs[1][..., :-1], rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", SOLVERS)
def test_each_sample_is_as_alone(name):
    water = basins()
    rows, vectors = laplacian(water), null_vectors(water)
    b = in_range(noise(3, 1, *SHAPE), vectors)
    together, _ = prdp.linear_solve(operators.Stencil(rows, OFFSETS, nullspace=vectors), b, SOLVERS[name])
    for i in range(3):
        own = vectors[i] if i == 1 else vectors[i, :1]
        alone, _ = prdp.linear_solve(operators.Stencil(rows[[i]], OFFSETS, nullspace=own), b[[i]], SOLVERS[name])
        assert torch.equal(together[[i]], alone)


def test_a_mean_of_one_basin_is_told_of_its_sample():
    water = basins()
    vectors = null_vectors(water)
    b = in_range(noise(3, 1, *SHAPE), vectors)
    b[1, 0] += vectors[1, 1, 0]
    a = operators.Stencil(laplacian(water), OFFSETS, nullspace=vectors)
    for solver in SOLVERS.values():
        u, info = prdp.linear_solve(a, b, solver, on_failure="return")
        assert statuses(info)[1] == "INCONSISTENT" and info.solved.tolist() == [True, False, True]
        assert u.isfinite().all()


def test_a_refused_sample_leaves_its_neighbours_their_gradient():
    water = basins()
    vectors = null_vectors(water)
    rows = laplacian(water).requires_grad_()
    b = in_range(noise(3, 1, *SHAPE), vectors)
    for backward in ("implicit", "unrolled"):
        bad = rows * torch.tensor([1.0, 1.0, float("nan")], dtype=F64).view(3, 1, 1, 1)
        u, info = prdp.linear_solve(
            operators.Stencil(bad, OFFSETS, nullspace=vectors), b, prdp.CG(100, 1e-12), backward, on_failure="zero_grad"
        )
        assert statuses(info) == ["CONVERGED", "CONVERGED", "NONFINITE_OPERATOR"]
        (got,) = torch.autograd.grad(u[:2].square().sum(), rows)
        good = operators.Stencil(rows[:2], OFFSETS, nullspace=vectors[:2])
        v, _ = prdp.linear_solve(good, b[:2], prdp.CG(100, 1e-12), backward)
        (want,) = torch.autograd.grad(v.square().sum(), rows)
        torch.testing.assert_close(got[:2], want[:2], rtol=1e-9, atol=1e-12)


def graphs():
    """Laplacians (3, 6, 6): a ring, two triangles, a path and a pair."""
    edges = [[(i, (i + 1) % 6) for i in range(6)], [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3)],
             [(0, 1), (1, 2), (2, 3), (4, 5)]]  # fmt: skip
    a = torch.zeros(3, 6, 6, dtype=F64)
    for s, of_graph in enumerate(edges):
        for i, j in of_graph:
            a[s, i, i] += 1
            a[s, j, j] += 1
            a[s, i, j] = a[s, j, i] = -1
    vectors = torch.zeros(3, 2, 6, dtype=F64)
    vectors[0, 0] = 1
    vectors[1, 0, :3] = vectors[1, 1, 3:] = 1
    vectors[2, 0, :4] = vectors[2, 1, 4:] = 1
    return a, vectors


@pytest.mark.parametrize("solver", [prdp.CG(60, 1e-13), prdp.Direct(), prdp.GMRES(10, 1e-13, restart=6)], ids=repr)
def test_graphs_of_a_batch_fall_into_parts_of_their_own(solver):
    a, vectors = graphs()
    inverse = torch.linalg.pinv(a, rcond=1e-10, hermitian=True)
    b = (a @ noise(3, 6, 1)).squeeze(-1).requires_grad_()
    u, info = prdp.linear_solve(operators.Matrix(a, nullspace=vectors), b, solver)
    assert info.solved.all()
    torch.testing.assert_close(u, (inverse @ b[..., None]).squeeze(-1), rtol=0, atol=1e-10)
    weights = noise(3, 6, seed=2)
    (b_bar,) = torch.autograd.grad(u, b, weights)
    torch.testing.assert_close(b_bar, (inverse @ weights[..., None]).squeeze(-1), rtol=0, atol=1e-10)


def test_the_vectors_may_depend_on_parameters():
    """D L D with its null vectors D⁻¹ 1: gradcheck in all modes, and vmap over a further axis."""
    a, vectors = graphs()
    b = noise(3, 6, seed=3)

    def solve(d, b):
        scaled = d[:, :, None] * a * d[:, None, :]
        basis = vectors / d[:, None]
        q = torch.where(basis == 0, 0.0, basis)
        q = q / q.norm(dim=-1, keepdim=True).clamp_min(1e-30)
        b = b - (q.mT @ (q @ b[..., None])).squeeze(-1)
        return prdp.linear_solve(operators.Matrix(scaled, nullspace=basis), b, prdp.Direct())[0]

    d = (1 + 0.3 * noise(3, 6, seed=4).tanh()).requires_grad_()
    exact = torch.linalg.pinv(d[:, :, None] * a * d[:, None, :], rcond=1e-10, hermitian=True)
    torch.testing.assert_close(solve(d, b), (exact @ b[..., None]).squeeze(-1), rtol=0, atol=1e-9)
    torch.autograd.gradcheck(solve, (d, b.requires_grad_()), check_forward_ad=True)
    many = torch.func.vmap(solve)(torch.stack([d, d + 0.1]), torch.stack([b, 2 * b]))
    torch.testing.assert_close(many[1], solve(d + 0.1, 2 * b), rtol=1e-10, atol=1e-12)


def test_functions_take_them():
    a, vectors = graphs()
    b = (a @ noise(3, 6, 1)).squeeze(-1)
    function = operators.Function(
        lambda v, m: (m @ v[..., None]).squeeze(-1), tensors=(a,), symmetric=True, nullspace=vectors
    )
    u, info = prdp.linear_solve(function, b, prdp.CG(60, 1e-13))
    assert info.solved.all()
    exact = torch.linalg.pinv(a, rcond=1e-10, hermitian=True) @ b[..., None]
    torch.testing.assert_close(u, exact.squeeze(-1), rtol=0, atol=1e-10)


def test_one_for_all_samples_may_have_a_batch_axis():
    a, vectors = graphs()
    b = (a[:1] @ noise(4, 6, 1)).squeeze(-1)
    one = operators.Matrix(a[0], nullspace=vectors[0, :1])
    other = operators.Matrix(a[0], nullspace=vectors[:1, :1])
    assert torch.equal(*(prdp.linear_solve(m, b, prdp.CG(20, 1e-12))[0] for m in (one, other)))


def test_what_does_not_fit_is_refused():
    water = basins()
    rows, vectors, b = laplacian(water), null_vectors(water), noise(3, 1, *SHAPE)

    def solve(right, left=None):
        a = operators.Stencil(rows, OFFSETS, nullspace=right, left_nullspace=left)
        return prdp.linear_solve(a, b, prdp.CG(5))

    with pytest.raises(ValueError, match="Stencil: a null space of 2 samples, the vector has 3"):
        solve(vectors[:2])
    with pytest.raises(ValueError, match=r"vector 0 of nullspace of sample . is not in the null space of A"):
        solve(vectors.flip(0))
    with pytest.raises(ValueError, match="vector 1 of a null space of sample 0 is zero, not finite, or depends"):
        solve(vectors[:, :1].expand(-1, 2, -1, -1, -1))
    with pytest.raises(ValueError, match="vectors of zeros at the same places"):
        solve(vectors, vectors.flip(1))
    with pytest.raises(ValueError, match="must both be of each sample, or both of all samples"):
        solve(vectors[:, :1], "constant")
    with pytest.raises(ValueError, match=r"or \(batch, k, channels, \*shape\); got \[3, 6, 8\]"):
        solve(torch.ones(3, 6, 8, dtype=F64))
    with pytest.raises(ValueError, match=r"share these vectors: for one of each, give \(batch, 1, channels"):
        solve(water[:, None])
