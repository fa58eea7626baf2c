"""`prdp.check_operator` finds each kind of mistake, and none where there is none."""

import pytest
import torch
from helpers import field, spd_matrices

import prdp_torch as prdp
from prdp_torch import operators

N = 7
K = torch.rand(2, N, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) + 1
EXAMPLE = torch.zeros(2, N, dtype=torch.float64)


def right(v, k):
    return 3 * k * v - k.roll(1, -1) * v.roll(1, -1)


def right_transpose(v, k):
    return 3 * k * v - (k.roll(1, -1) * v).roll(-1, -1)


def diagonal(k):
    return 3 * k


class Lossy(torch.autograd.Function):
    """k v with a wrong derivative for k."""

    @staticmethod
    def forward(ctx, v, k):
        ctx.save_for_backward(v, k)
        return k * v

    @staticmethod
    def backward(ctx, g):
        v, k = ctx.saved_tensors
        return k * g, 1.01 * v * g


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "make",
    [
        lambda dtype: operators.Function(right, right_transpose, (K.to(dtype),), diagonal),
        lambda dtype: operators.Function(right, tensors=K.to(dtype)),
        lambda dtype: operators.Matrix(spd_matrices(2, N, dtype=dtype)),
        lambda dtype: spd_matrices(2, N, dtype=dtype)[0].to_sparse_csr(),
    ],
)
def test_right_operators_pass(make, dtype):
    assert prdp.check_operator(make(dtype), EXAMPLE.to(dtype)) is True


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_built_in_ones_pass(dtype):
    w = field((5, 6), dtype=dtype, channels=3)
    assert prdp.check_operator(operators.Poisson((4, 5, 3)), field((4, 5, 3), dtype=dtype))
    assert prdp.check_operator(operators.Heat((30,), 1e-3, 0.5, length=2.0), field((30,), dtype=dtype))
    assert prdp.check_operator(operators.Burgers(w[:, :2], 1e-2, 0.1), w[:, :2])
    assert prdp.check_operator(operators.NavierStokes(w, torch.tensor(1e-2, dtype=dtype), 0.1), w)


CAPTURED = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)


@pytest.mark.parametrize(
    "a, message",
    [
        (operators.Function(right, right, (K,)), r"the transpose is wrong: <A v, w> = .* but <v, A\^T w> = "),
        (operators.Function(right, tensors=K, symmetric=True), "the transpose is wrong"),
        (
            operators.Function(right, tensors=K, diagonal=lambda k: k),
            "the diagonal is wrong: entry 0 is .*, by the prod",
        ),
        (operators.Function(right, tensors=K, diagonal=lambda k: k[:, 1:]), r"diagonal has shape \(2, 6\), which does"),
        (operators.Function(lambda v, k: v + k, tensors=K), "A is not linear"),
        (operators.Function(lambda v: v + v.sum(0), symmetric=True), "samples influence each other"),
        (operators.Function(lambda v: CAPTURED * v), "requires grad but is not among its tensors"),
        (
            operators.Function(Lossy.apply, tensors=K, symmetric=True),
            r"gradient for tensor 0 of shape \(2, 7\) is wrong",
        ),
        (operators.Function(lambda v, k: k.detach() * v, tensors=K), "the gradient for tensor 0 .* is wrong: 0 along"),
    ],
)
def test_mistakes_are_named(a, message):
    with pytest.raises(ValueError, match="check_operator: Function: .*" + message):
        prdp.check_operator(a, EXAMPLE)


def test_all_mistakes_come_at_once():
    a = operators.Function(right, right, (K,), diagonal=lambda k: k)
    with pytest.raises(ValueError, match=r"the transpose is wrong: .*; the diagonal is wrong"):
        prdp.check_operator(a, EXAMPLE)


def test_bad_arguments():
    with pytest.raises(TypeError, match=r"check_operator: A must be an operator of prdp_torch.operators, got 3"):
        prdp.check_operator(3, EXAMPLE)
    with pytest.raises(ValueError, match=r"check_operator: example must have shape \(batch, ...\), got \(7,\)"):
        prdp.check_operator(operators.Function(lambda v: v), torch.zeros(N))


INVERSE = operators.Function(lambda v: v / 3, symmetric=True)


def looked_at(preconditioner, solver=prdp.CG):
    return prdp.check_operator(spd_matrices(2, N), EXAMPLE, solver(3, preconditioner=preconditioner))


@pytest.mark.parametrize("preconditioner", [None, "diagonal", INVERSE, operators.Matrix(-spd_matrices(2, N))])
def test_right_preconditioners_pass(preconditioner):
    assert looked_at(preconditioner)
    assert prdp.check_operator(
        operators.Diffusion(K.expand(2, -1)), EXAMPLE[:, None], prdp.CG(3, preconditioner="multigrid")
    )


@pytest.mark.parametrize(
    "matvec, transpose, message",
    [
        (lambda v: v.abs(), None, r"M is not linear: M \(2 v \+ w\) differs"),
        (lambda v: v + v.roll(1, -1), lambda v: v, r"the transpose of M is wrong: <M v, w> = .* but <v, M\^T w>"),
        (lambda v: v + v.roll(1, 0), None, "samples influence each other: M v changes"),
        (lambda v: 3 * v + v.roll(1, -1), None, "CG needs a symmetric preconditioner: <M v, w>"),
        (lambda v: v * torch.linspace(-1, 1, N), None, "CG needs a definite preconditioner"),
    ],
)
def test_each_mistake_of_a_preconditioner_is_named(matvec, transpose, message):
    with pytest.raises(ValueError, match="check_operator: Matrix: .*" + message):
        looked_at(operators.Function(matvec, transpose))


def test_a_preconditioner_of_gmres_need_not_be_symmetric():
    assert looked_at(operators.Function(lambda v: 3 * v + v.roll(1, -1)), solver=prdp.GMRES)
    with pytest.raises(ValueError, match="multigrid"):
        looked_at("multigrid")


@pytest.mark.parametrize("a, solver, message", [
    (lambda v: 3 * v + v.roll(1, -1), prdp.CG(3), "CG needs a symmetric A: <A v, w> = .* but <v, A w>"),
    (lambda v: 3 * v + v.cumsum(-1), prdp.MINRES(3), "MINRES needs a symmetric A"),
    (lambda v: v * torch.linspace(-1, 1, N), prdp.CG(3), "CG needs a definite A: <v, A v> is not of one sign"),
    (lambda v: v @ spd_matrices(1, N)[0], prdp.MINRES(3, preconditioner=operators.Function(lambda v: v + v.cumsum(-1))),
     "MINRES needs a symmetric preconditioner"),
    (lambda v: v @ spd_matrices(1, N)[0], prdp.MINRES(3, preconditioner=operators.Function(lambda v: -v)),
     "MINRES needs a positive definite preconditioner: <v, M v> is negative"),
])  # fmt: skip
def test_what_a_method_asks_of_an_operator_is_looked_at(a, solver, message):
    with pytest.raises(ValueError, match=message):
        prdp.check_operator(operators.Function(a), EXAMPLE, solver)
    assert prdp.check_operator(operators.Function(a), EXAMPLE, prdp.GMRES(3))


def test_minres_takes_what_is_indefinite_and_cg_what_is_negative():
    indefinite = operators.Function(lambda v: v * torch.linspace(-1, 1, N))
    assert prdp.check_operator(indefinite, EXAMPLE, prdp.MINRES(3))
    assert prdp.check_operator(operators.Function(lambda v: -v), EXAMPLE, prdp.CG(3))


def test_one_eigenvalue_of_the_other_sign_is_found_among_many():
    for n, smallest in ((30, -1e-6), (200, -1e-3), (900, -0.1)):
        q, _ = torch.linalg.qr(torch.randn(n, n, dtype=torch.float64, generator=torch.Generator().manual_seed(n)))
        for sign in (1.0, -1.0):
            eigenvalues = torch.linspace(1, 50, n, dtype=torch.float64).index_fill(0, torch.tensor(n // 2), smallest)
            a = sign * (q * eigenvalues) @ q.mT
            with pytest.raises(ValueError, match="CG needs a definite A"):
                prdp.check_operator((a + a.mT) / 2, torch.ones(2, n, dtype=torch.float64), prdp.CG(3))
            regular = sign * (q * eigenvalues.abs()) @ q.mT
            assert prdp.check_operator((regular + regular.mT) / 2, torch.ones(2, n, dtype=torch.float64), prdp.CG(3))


def test_one_vector_of_a_matrix_is_an_example():
    assert prdp.check_operator(torch.eye(5, dtype=torch.float64), torch.ones(5, dtype=torch.float64))


def test_a_nearly_singular_operator_that_takes_no_null_space_is_not_told_to_take_one():
    example = torch.zeros(1, 1, 4, 5, dtype=torch.float64)
    A = operators.Diffusion(torch.ones(1, 4, 5, dtype=torch.float64), shift=1e-14, boundary="flux")
    with pytest.raises(ValueError, match="maps the constant to zero, so it is singular: enlarge the shift, or take a"):
        prdp.check_operator(A, example)


def test_a_scheme_that_keeps_the_mean_is_singular_as_its_transpose_tells():
    """Conservative upwind advection and diffusion on a ring: Aᵀ maps the constant to zero, and A another vector."""
    n = 23
    w = 1 + torch.randn(1, n, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    left, d = w.roll(1, -1), 0.05 * n * n
    centre = (w.clamp(min=0) - left.clamp(max=0)) * n + 2 * d
    below, above = -left.clamp(min=0) * n - d, w.clamp(max=0) * n - d
    a = operators.Stencil(torch.stack([centre, below, above], -2), [(0,), (-1,), (1,)], "periodic")
    assert torch.linalg.svdvals(a.dense().reshape(n, n))[-1] < 1e-12
    with pytest.raises(ValueError, match=r"A\^T maps the constant to zero, so A is singular: give left_nullspace="):
        prdp.check_operator(a, torch.zeros(1, 1, n, dtype=torch.float64))


def device(psi, density):
    """Of a potential of some tens beside a density of any size: the product is exponential in the former."""
    d = psi.diff(dim=1)
    flux = density[:, 1:] * torch.exp(-d / 2) - density[:, :-1] * torch.exp(d / 2)
    pad = torch.nn.functional.pad
    return psi - 0.3 * psi.roll(1, 1), density - pad(flux, (0, 1)) + pad(flux, (1, 0))


@pytest.mark.parametrize("top", [1e2, 1e6, 1e10])
@pytest.mark.parametrize("loses_psi", [False, True])
def test_a_tensor_may_hold_numbers_of_any_sizes(top, loses_psi):
    n = 20
    psi = torch.linspace(0, 1, n, dtype=torch.float64) * torch.log(torch.tensor(top))
    u = torch.cat([psi, psi.exp()])[None].repeat(2, 1).requires_grad_()

    def product(v, u):
        at = u[:, :n].detach() if loses_psi else u[:, :n]
        parts = torch.func.jvp(device, (at, u[:, n:]), (v[:, :n], v[:, n:]))[1]
        return torch.cat(parts, 1)

    a = operators.Function(product, tensors=(u,))
    if loses_psi:
        with pytest.raises(ValueError, match=r"the gradient for tensor 0 of shape .* is wrong"):
            prdp.check_operator(a, torch.zeros(2, 2 * n, dtype=torch.float64))
    else:
        assert prdp.check_operator(a, torch.zeros(2, 2 * n, dtype=torch.float64))


def test_null_vectors_that_nobody_named_are_counted():
    """Three graphs in one matrix, each with its constant."""
    one = 5 * torch.eye(5, dtype=torch.float64) - 1
    three = torch.block_diag(one, 2 * one, 1e6 * one)
    vectors = torch.block_diag(*[torch.ones(1, 5, dtype=torch.float64)] * 3)
    example = torch.zeros(2, 15, dtype=torch.float64)
    assert prdp.check_operator(operators.Matrix(three, nullspace=vectors), example)
    with pytest.raises(ValueError, match="A of sample 0 maps 2 vectors to zero that nullspace does not name"):
        prdp.check_operator(operators.Matrix(three, nullspace="constant"), example)
    with pytest.raises(ValueError, match="maps 1 vectors to zero that nullspace does not name"):
        prdp.check_operator(operators.Matrix(three, nullspace=vectors[:2]), example)
    both = torch.stack([three, torch.block_diag(one, torch.eye(10, dtype=torch.float64))])
    of_samples = torch.stack([vectors, vectors * torch.tensor([[1.0], [0.0], [0.0]])])
    assert prdp.check_operator(operators.Matrix(both, nullspace=of_samples), example)
    assert prdp.check_operator(operators.Matrix(torch.diag(10.0 ** torch.arange(0, -15, -1).double())), example)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("seed", range(3))
def test_jumps_and_still_water_are_no_mistakes(seed, dtype):
    """Harmonic means are homogeneous, and upwind schemes have a kink where the wind is zero."""
    generator = torch.Generator().manual_seed(seed)
    pad = torch.nn.functional.pad

    def harmonic(v, k):
        flux = 2 * k[:, 1:] * k[:, :-1] / (k[:, 1:] + k[:, :-1]) * v.diff(dim=1)
        return 1e-3 * v - (pad(flux, (0, 1)) - pad(flux, (1, 0)))

    def upwind(v, c):
        return v + c.clamp(min=0) * (v - v.roll(1, 1)) + c.clamp(max=0) * (v.roll(-1, 1) - v)

    half = torch.rand(1, 60, generator=generator) < 0.5
    small = 1e-5 if dtype == torch.float32 else 1e-10
    k = torch.where(half, 1.0, small).to(dtype).requires_grad_()
    c = torch.where(half, torch.randn(1, 60, generator=generator), 0.0).to(dtype).requires_grad_()
    example = torch.zeros(1, 60, dtype=dtype)
    assert prdp.check_operator(operators.Function(harmonic, tensors=(k,), symmetric=True), example)
    assert prdp.check_operator(operators.Function(upwind, tensors=(c,)), example)


@pytest.mark.parametrize("n", [64, 256])
def test_a_bad_condition_is_no_null_space(n):
    rows = torch.tensor([2.0, -1.0, -1.0]).view(1, 3, 1).expand(1, 3, n)
    for dtype in (torch.float32, torch.float64):
        a = operators.Stencil(rows.to(dtype), [(0,), (-1,), (1,)])
        assert prdp.check_operator(a, torch.zeros(1, 1, n, dtype=dtype))


class TooLargeAtZeros(torch.autograd.Function):
    @staticmethod
    def forward(ctx, v, t):
        ctx.save_for_backward(v, t)
        return v + t * v

    @staticmethod
    def backward(ctx, g):
        v, t = ctx.saved_tensors
        return g * (1 + t), g * v * torch.where(t == 0, 100.0, 1.0)


def test_entries_of_zero_are_looked_at_and_still_water_is_right():
    example = torch.zeros(1, 20, dtype=torch.float64)
    t = torch.zeros(1, 20, dtype=torch.float64)
    t[0, 0] = 1
    wrong = operators.Function(TooLargeAtZeros.apply, tensors=(t.requires_grad_(),), symmetric=True)
    with pytest.raises(ValueError, match=r"the gradient for tensor 0 of shape \(1, 20\) is wrong"):
        prdp.check_operator(wrong, example)

    def upwind(v, c):
        return v + c.clamp(min=0) * (v - v.roll(1, 1)) + c.clamp(max=0) * (v.roll(-1, 1) - v)

    still = torch.zeros(1, 20, dtype=torch.float64, requires_grad=True)
    assert prdp.check_operator(operators.Function(upwind, tensors=(still,)), example)


@pytest.mark.parametrize("boundary", ["flux", "periodic"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_diffusion_that_nothing_holds_has_a_right_gradient(boundary, dtype):
    kappa = 0.5 + torch.rand(2, 6, 5, dtype=dtype, generator=torch.Generator().manual_seed(0))
    A = operators.Diffusion(kappa, shift=0.0, boundary=boundary)
    assert prdp.check_operator(A, torch.ones(2, 1, 6, 5, dtype=dtype))


def test_a_diffusion_that_a_solve_refuses_is_refused_in_the_same_words():
    kappa = torch.ones(1, 6, 5, dtype=torch.float64)
    A = operators.Diffusion(kappa, shift=torch.zeros_like(kappa), boundary="flux")
    with pytest.raises(ValueError, match="neither the shift nor a side holds u, so A is singular"):
        prdp.check_operator(A, kappa[:, None])
