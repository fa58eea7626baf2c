"""The adjoint solve of a Function is compared with its solve: <lambda, b> = <u, u_bar> but for their residuals."""

import gc
import warnings

import pytest
import torch

import prdp_torch as prdp
from prdp_torch import operators

SAYS = "this Function's transpose is not that of the A that was solved"


def matrix(n=12, dtype=torch.float64, seed=0, skew=1.0):
    noise = torch.randn(n, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (6 * torch.eye(n, dtype=torch.float64) + skew * noise / 2).to(dtype)


def gradient(a, solver, inputs=None, dtype=torch.float64, n=12, seed=1, on_failure="raise"):
    b, weights = torch.randn(2, 3, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)
    b.requires_grad_(inputs is None)
    u, _ = prdp.linear_solve(a, b, solver, on_failure=on_failure)
    return torch.autograd.grad((u * weights).sum(), b if inputs is None else inputs)[0]


@pytest.mark.usefixtures("always")
@pytest.mark.parametrize("wrong", ["symmetric", "transpose", "captured", "tensors alone"])
def test_a_wrong_transpose_is_said(wrong):
    m = matrix()
    scale = torch.tensor(1.0, dtype=torch.float64)
    calls = 0

    def product(v):
        nonlocal calls
        calls += 1
        return v @ m.mT

    if wrong == "symmetric":
        a = operators.Function(product, symmetric=True)
    elif wrong == "transpose":
        a = operators.Function(product, transpose=lambda v: 2 * (v @ m))
    elif wrong == "captured":
        a = operators.Function(product, transpose=lambda v: v @ (m + 0.5 * torch.eye(12, dtype=m.dtype)))
    else:
        scale.requires_grad_()
        a = operators.Function(lambda v, s: s * v @ m.mT, tensors=scale, symmetric=True)
    with pytest.warns(UserWarning, match=SAYS):
        gradient(a, prdp.GMRES(9, restart=12), scale if wrong == "tensors alone" else None)


@pytest.mark.usefixtures("always")
def test_a_buffer_that_is_back_in_its_place_is_said():
    """functional_call() swaps tensors for the call alone; the adjoint solve comes after it."""

    class Scaled(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.register_buffer("k", torch.tensor(2.0, dtype=torch.float64))

        def forward(self, b):
            return prdp.linear_solve(operators.Function(lambda v: self.k * v), b, prdp.GMRES(3))[0]

    b = torch.ones(1, 4, dtype=torch.float64, requires_grad=True)
    u = torch.func.functional_call(Scaled(), {"k": torch.tensor(3.0, dtype=torch.float64)}, b)
    with pytest.warns(UserWarning, match=SAYS):
        u.sum().backward()


@pytest.mark.usefixtures("always")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize(
    "solver",
    [prdp.GMRES(2, restart=3), prdp.GMRES(9, rtol=1e-2), prdp.BiCGStab(4), prdp.BiCGStab(60), prdp.Direct(),
     prdp.Jacobi(3), prdp.Jacobi(80), prdp.SteepestDescent(5, rtol=0.0)],
    ids=repr,
)  # fmt: skip
def test_a_right_one_says_nothing_however_few_iterations_ran(solver, dtype):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message=f".*{SAYS}")
        for seed in range(20):
            m = matrix(dtype=dtype, seed=seed, skew=1.0 if seed % 2 else 1e-3)
            if seed % 3 == 0:  # rows of any size
                m = m * torch.logspace(0, -5, 12, dtype=dtype)[:, None]
            scale = torch.tensor(1.0, dtype=dtype, requires_grad=True)
            a = operators.Function(
                lambda v, s, m=m: s * (v @ m.mT), lambda v, s, m=m: s * (v @ m), scale, lambda s, m=m: s * m.diagonal()
            )
            gradient(a, solver, scale if seed % 2 else None, dtype, seed=seed + 100, on_failure="warn")


@pytest.mark.usefixtures("always")
@pytest.mark.parametrize("solver", [prdp.GMRES(9, restart=12), prdp.BiCGStab(20), prdp.Direct()], ids=repr)
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_a_number_of_a_loop_is_said(backward, solver):
    """The product is made again in the backward pass, when the loop is over."""
    m = matrix()
    u = torch.ones(1, 12, dtype=torch.float64, requires_grad=True)
    for c in (0.5, 1.0, 2.0):
        a = operators.Function(lambda v: v + c * (v @ m.mT))  # noqa: B023
        u, _ = prdp.linear_solve(a, u, solver, backward)
    with pytest.warns(UserWarning, match="the functions still see what they captured, tensors and numbers"):
        u.sum().backward()


@pytest.mark.usefixtures("always")
@pytest.mark.parametrize("dtype, factor", [(torch.float32, 1.03), (torch.float64, 1 + 1e-5)], ids=str)
@pytest.mark.parametrize("create_graph", [False, True])
@pytest.mark.parametrize("start", [False, True])
def test_a_product_that_has_changed_a_little_is_said(dtype, factor, create_graph, start):
    m, c = matrix(dtype=dtype), 1.0
    b = torch.ones(2, 12, dtype=dtype, requires_grad=True)
    a = operators.Function(lambda v: v + c * (v @ m.mT))
    u, _ = prdp.linear_solve(a, b, prdp.BiCGStab(6), "unrolled", x0=torch.zeros_like(b) if start else None)
    c = factor
    with pytest.warns(UserWarning, match=r"\|b - A u\| is .* now, and was"):
        torch.autograd.grad(u.sum(), b, create_graph=create_graph)


@pytest.mark.usefixtures("always")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("solver", [prdp.CG(60, rtol=1e-2), prdp.CG(40), prdp.BiCGStab(40), prdp.MINRES(100)], ids=repr)
def test_a_derivative_that_rounding_has_made_wrong_is_no_other_product(solver, dtype):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message=".*is not the A that was solved")
        for seed in range(5):
            kappa = torch.randn(1, 24, 24, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
            diffusion = operators.Diffusion((1 + seed % 2) * kappa.exp().to(dtype))
            b = torch.rand(2, 1, 24, 24, generator=torch.Generator().manual_seed(seed)).to(dtype).requires_grad_()
            u, _ = prdp.linear_solve(
                operators.Function(diffusion.apply, symmetric=True), b, solver, "unrolled", on_failure="return"
            )
            torch.autograd.grad(u.square().sum(), b)


@pytest.mark.usefixtures("always")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize(
    "solver",
    [prdp.GMRES(2, restart=3), prdp.BiCGStab(4), prdp.BiCGStab(60), prdp.Jacobi(3), prdp.SteepestDescent(5, rtol=0.0),
     prdp.CG(5), prdp.CG(50), prdp.MINRES(7)],
    ids=repr,
)  # fmt: skip
def test_iterations_that_are_differentiated_say_nothing(solver, dtype):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message=".*is not the A that was solved")
        for seed in range(10):
            m = matrix(dtype=dtype, seed=seed)
            if isinstance(solver, (prdp.CG, prdp.MINRES, prdp.SteepestDescent)):
                m = m @ m.mT
            b = torch.randn(3, 12, generator=torch.Generator().manual_seed(seed)).to(dtype).requires_grad_()
            scale = torch.tensor(1.0, dtype=dtype, requires_grad=True)
            a = operators.Function(
                lambda v, s, m=m: s * (v @ m.mT), lambda v, s, m=m: s * (v @ m), scale, lambda s, m=m: s * m.diagonal()
            )
            u, _ = prdp.linear_solve(a, b, solver, "unrolled", on_failure="return")
            torch.autograd.grad(u.square().sum(), (b, scale))


def test_what_was_written_to_is_not_compared():
    m = matrix()
    b = torch.ones(1, 12, dtype=torch.float64)
    scale = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    u, _ = prdp.linear_solve(operators.Function(lambda v, s: s * v @ m.mT, tensors=scale), b, prdp.GMRES(5, restart=12))
    b.zero_()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message=f".*{SAYS}")
        u.sum().backward()


def test_another_wrong_transpose_is_said_again():
    """Each code has a warning of its own: one that was mended wrongly is not silent."""
    m = matrix()

    def solve(transpose):
        gradient(operators.Function(lambda v: v @ m.mT, transpose=transpose), prdp.GMRES(9, restart=12))

    with pytest.warns(UserWarning, match=SAYS):
        solve(lambda v: 2 * (v @ m))
    with pytest.warns(UserWarning, match=SAYS):
        solve(lambda v: v @ m.mT)
    for _ in range(2):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            solve(lambda v: v @ m)


def test_a_wrong_transpose_is_said_where_another_one_has_gone():
    """A later code may have the address of an earlier one."""
    m = matrix()
    for k in range(6):
        scope = {"m": m}
        exec(f"def transpose(v): return {k + 2}.0 * (v @ m)", scope)
        with pytest.warns(UserWarning, match=SAYS):
            a = operators.Function(lambda v: v @ m.mT, transpose=scope["transpose"])
            gradient(a, prdp.GMRES(9, restart=12))
        del a, scope
        gc.collect()
