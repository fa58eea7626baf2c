"""Tensors that a Function captures, and complex ones that it is given."""

import pytest
import torch
from helpers import statuses
from torch.autograd import forward_ad

import prdp_torch as prdp
from prdp_torch import operators


def right_hand_side():
    return torch.randn(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("rhs_requires_grad", [False, True])
def test_tensors_that_would_lose_their_gradient_are_refused(rhs_requires_grad, backward):
    k, b = torch.tensor(2.0, dtype=torch.float64, requires_grad=True), right_hand_side()
    b.requires_grad_(rhs_requires_grad)

    def solve(backward=backward):
        return prdp.linear_solve(operators.Function(lambda v: k * v), b, prdp.GMRES(3), backward=backward)[0]

    with pytest.raises(ValueError, match="matvec uses a tensor that requires grad but is not among its tensors"):
        solve()
    torch.testing.assert_close(solve("none"), b.detach() / 2)
    with torch.no_grad():
        torch.testing.assert_close(solve(), b / 2)
    k.requires_grad_(False)
    torch.testing.assert_close(solve(), b / 2)


def test_each_solve_looks_once_for_what_is_captured():
    recorded = []

    def matvec(v, k):
        recorded.append(torch.is_grad_enabled())
        return k * v

    a = operators.Function(matvec, tensors=torch.tensor([2.0], dtype=torch.float64, requires_grad=True))
    for _ in range(4):
        prdp.linear_solve(a, right_hand_side(), prdp.GMRES(3))
    assert sum(recorded) == 4 + 3  # in the 1st, 2nd and 4th also for tensors that no derivative reaches


def stiffness(x, k):
    """The gradient of the energy of springs of stiffness k."""
    return torch.autograd.grad((k * (x.diff() ** 2 + 0.1 * x.diff() ** 4)).sum(), x, create_graph=True)[0]


def hessian_product(create_graph):
    def matvec(v, x, k, m):
        with torch.enable_grad():
            y = x.detach().requires_grad_()
            return m * v + torch.autograd.grad(stiffness(y, k), y, v, create_graph=create_graph)[0]

    return matvec


def springs(n=9):
    g = torch.Generator().manual_seed(1)
    x = torch.randn(1, n, dtype=torch.float64, generator=g)
    k, m = (torch.rand(size, dtype=torch.float64, generator=g) + 1 for size in (n - 1, n))
    return x, k.requires_grad_(), m.requires_grad_(), torch.randn(1, n, dtype=torch.float64, generator=g)


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("solver", [prdp.CG(60, rtol=1e-13), prdp.MINRES(60, rtol=1e-13), prdp.Direct()], ids=repr)
def test_a_product_may_take_a_derivative_by_a_leaf_of_its_own(solver, backward):
    x, k, m, b = springs()
    backward = "implicit" if isinstance(solver, prdp.Direct) else backward
    a = operators.Function(hessian_product(create_graph=True), tensors=(x, k, m), symmetric=True)
    u, _ = prdp.linear_solve(a, b, solver, backward=backward)
    y = x.clone().requires_grad_()
    hessian = torch.stack([torch.autograd.grad(g, y, create_graph=True)[0][0] for g in stiffness(y, k)[0]])
    exact = torch.linalg.solve(hessian + torch.diag(m), b[0])[None]
    torch.testing.assert_close(u, exact, rtol=1e-9, atol=1e-11)
    found, expected = (torch.autograd.grad(v.square().sum(), (k, m)) for v in (u, exact))
    for g, h in zip(found, expected, strict=True):
        torch.testing.assert_close(g, h, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_a_tensor_that_no_derivative_reaches_is_named(backward, always):
    x, k, m, b = springs()
    a = operators.Function(hessian_product(create_graph=False), tensors=(x, k, m), symmetric=True)
    with pytest.warns(UserWarning, match=r"tensors\[1\] requires grad, but autograd records nothing .* torch.func.jvp"):
        prdp.linear_solve(a, b, prdp.CG(60), backward=backward)
    fixed = operators.Function(hessian_product(create_graph=False), tensors=(x, k.detach(), m), symmetric=True)
    prdp.linear_solve(fixed, b, prdp.CG(60), backward=backward)


@pytest.mark.parametrize("grad_mode", [True, False])
@pytest.mark.parametrize("solver", [prdp.CG(60, rtol=1e-13), prdp.GMRES(6, restart=9, rtol=1e-13), prdp.Direct()])
def test_such_a_product_has_tangents(solver, grad_mode):
    x, k, m, b = springs()
    k, m, dk = k.detach(), m.detach(), torch.linspace(-1, 1, len(k), dtype=torch.float64)
    product = hessian_product(create_graph=True)

    def solve(k):
        return prdp.linear_solve(operators.Function(product, tensors=(x, k, m), symmetric=True), b, solver)[0]

    with torch.set_grad_enabled(grad_mode), forward_ad.dual_level():
        tangent = forward_ad.unpack_dual(solve(forward_ad.make_dual(k, dk))).tangent
    differences = (solve(k + 1e-6 * dk) - solve(k - 1e-6 * dk)) / 2e-6
    torch.testing.assert_close(tangent, differences, rtol=1e-6, atol=1e-8)


def test_a_tensor_that_changes_nothing_is_not_named(always):
    """The last bias of an energy is in no Hessian, and a diagonal may have tensors of its own."""
    net = torch.nn.Sequential(torch.nn.Linear(9, 5), torch.nn.Softplus(), torch.nn.Linear(5, 1)).double()
    x, _, m, b = springs()
    names = [name for name, _ in net.named_parameters()]

    def matvec(v, x, m, *weights):
        def energy(y):
            return torch.func.functional_call(net, dict(zip(names, weights, strict=True)), (y,)).sum()

        return 9 * v + torch.func.vjp(torch.func.grad(energy), x)[1](v)[0]

    tensors = (x, m, *net.parameters())
    a = operators.Function(matvec, tensors=tensors, symmetric=True, diagonal=lambda x, m, *weights: 9 + 0 * m)
    u, _ = prdp.linear_solve(a, b, prdp.CG(60, preconditioner="diagonal"))
    u.sum().backward()
    assert net[0].weight.grad.any() and net[2].bias.grad is None


def test_a_product_that_torch_cannot_record_solves_without_a_word(always):
    _, _, m, b = springs()
    by_numpy = operators.Function(lambda v, m: torch.from_numpy(v.numpy() * m.numpy()), tensors=m, symmetric=True)
    u, _ = prdp.linear_solve(by_numpy, b, prdp.CG(60))
    torch.testing.assert_close(u, b / m, rtol=1e-4, atol=1e-5)
    with pytest.raises(TypeError, match="Function: expected a vector in float32 or float64"):
        prdp.linear_solve(by_numpy, b.long(), prdp.CG(60))


def test_what_is_captured_beside_a_leaf_of_the_product_is_refused():
    x, k, m, b = springs()
    inner = hessian_product(create_graph=True)
    a = operators.Function(lambda v, x, m: inner(v, x, k, m), tensors=(x, m), symmetric=True)
    with pytest.raises(ValueError, match="matvec uses a tensor that requires grad but is not among its tensors"):
        prdp.linear_solve(a, b, prdp.CG(60))
    captured = 2 * k  # not a leaf
    a = operators.Function(lambda v, x, m: inner(v, x, captured, m), tensors=(x, m), symmetric=True)
    with pytest.raises(ValueError, match="matvec uses a tensor that requires grad but is not among its tensors"):
        prdp.linear_solve(a, b, prdp.CG(60))


def test_a_captured_parameter_may_be_frozen_for_a_while():
    k, b = torch.nn.Parameter(torch.tensor(2.0, dtype=torch.float64)), right_hand_side().requires_grad_()
    a = operators.Function(lambda v: k * v)
    k.requires_grad_(False)
    torch.testing.assert_close(prdp.linear_solve(a, b, prdp.GMRES(3))[0], b / 2)
    k.requires_grad_(True)
    with pytest.raises(ValueError, match="matvec uses a tensor that requires grad but is not among its tensors"):
        prdp.linear_solve(a, b, prdp.GMRES(3))


@pytest.mark.filterwarnings("ignore:`torch.jit.script")  # by torch's own forward mode
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_complex_tensors_have_gradients(backward):
    """The symbol of a convolution with drift, against the solve by FFT."""
    n = 8
    k = torch.fft.rfftfreq(n, 1 / n, dtype=torch.float64)
    k[-1] = 0
    u, w = torch.rand(2, n, dtype=torch.float64), torch.rand(2, n, dtype=torch.float64)

    def symbol(c):
        return 1 + 0.1 * k**2 + 1j * c * k

    def product(v, symbol):
        return torch.fft.irfft(torch.fft.rfft(v) * symbol, n=n)

    def of_solve(c):
        a = operators.Function(product, tensors=symbol(c))
        solved, _ = prdp.linear_solve(a, u, prdp.GMRES(5, rtol=1e-13, restart=n), backward=backward)
        return (solved * w).sum()

    def exact(c):
        return (torch.fft.irfft(torch.fft.rfft(u) / symbol(c), n=n) * w).sum()

    c = torch.tensor(0.7, dtype=torch.float64)
    slope = torch.func.grad(exact)(c)
    (found,) = torch.autograd.grad(of_solve(c.requires_grad_()), c)
    torch.testing.assert_close(found, slope, rtol=1e-8, atol=0)
    torch.testing.assert_close(torch.func.grad(of_solve)(c.detach()), slope, rtol=1e-8, atol=0)
    if backward == "implicit":
        curvature = torch.func.hessian(exact)(c.detach())
        torch.testing.assert_close(torch.func.hessian(of_solve)(c.detach()), curvature, rtol=1e-6, atol=0)


def test_a_complex_tensor_that_is_not_finite_fails_its_sample():
    s = torch.ones(2, 1, dtype=torch.complex128)
    s[1] = complex(1, float("nan"))
    a = operators.Function(lambda v, s: (v * s).real, tensors=s)
    _, info = prdp.linear_solve(a, torch.ones(2, 4, dtype=torch.float64), prdp.GMRES(3), on_failure="return")
    assert info.solved.tolist() == [True, False] and statuses(info)[1] == "NONFINITE_OPERATOR"


B = right_hand_side()


def of_captured(k):
    a = operators.Function(lambda v: k * v, symmetric=True)
    return prdp.linear_solve(a, B, prdp.CG(9, rtol=1e-10))[0].sum()


@pytest.mark.filterwarnings("ignore:`torch.jit.script")  # by torch's own forward mode
@pytest.mark.parametrize(
    "transform",
    [
        "grad",
        "jacrev",
        "jacfwd",
        "jvp",
        "vmap of grad",
        "dual tensors",
        "dual tensors without grad",
        "jvp without grad",
    ],
)
def test_what_a_transform_follows_and_a_product_captures_is_refused(transform):
    """It would have no derivative, in silence."""
    k = torch.rand(4, dtype=torch.float64) + 1

    def dual_tensors():
        with torch.autograd.forward_ad.dual_level():
            return of_captured(torch.autograd.forward_ad.make_dual(k, torch.ones_like(k)))

    calls = {
        "grad": lambda: torch.func.grad(of_captured)(k),
        "jacrev": lambda: torch.func.jacrev(of_captured)(k),
        "jacfwd": lambda: torch.func.jacfwd(of_captured)(k),
        "jvp": lambda: torch.func.jvp(of_captured, (k,), (torch.ones_like(k),)),
        "vmap of grad": lambda: torch.func.vmap(torch.func.grad(of_captured))(torch.stack([k, k])),
        "dual tensors": dual_tensors,
        "dual tensors without grad": torch.no_grad()(dual_tensors),
        "jvp without grad": torch.no_grad()(lambda: torch.func.jvp(of_captured, (k,), (torch.ones_like(k),))),
    }
    with pytest.raises(ValueError, match=r"or that forward mode or torch\.func follows, but is not among"):
        calls[transform]()
    of_captured(k)  # nothing follows it here


def test_vmap_without_gradients_may_capture_a_parameter_and_map_over_nothing():
    k = torch.nn.Parameter(torch.rand(4, dtype=torch.float64) + 1)

    def solution(b):
        a = operators.Function(lambda v: k * v, symmetric=True)
        return prdp.linear_solve(a, b, prdp.CG(9, rtol=1e-10), backward="none")[0]

    assert torch.allclose(torch.func.vmap(solution)(B[None]), B / k)
    assert torch.func.vmap(solution)(B[None].expand(0, -1, -1)).shape == (0, 3, 4)


@pytest.mark.parametrize("mapped", ["what is captured", "that and b", "b", "a tensor"])
def test_what_vmap_maps_over_and_a_product_captures_is_refused(mapped):
    def solution(k, b, scale):
        a = operators.Function(lambda v, s: s * k * v, tensors=(scale,), symmetric=True)
        return prdp.linear_solve(a, b, prdp.CG(9, rtol=1e-10))[0]

    k, scales = torch.rand(3, 4, dtype=torch.float64) + 1, torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)
    of_captured, of_b = mapped in ("what is captured", "that and b"), mapped in ("that and b", "b")
    axes = (0 if of_captured else None, 0 if of_b else None, 0 if mapped == "a tensor" else None)
    b = torch.stack([B, 2 * B, 3 * B]) if of_b else B
    given = k if of_captured else k[0], b, scales if mapped == "a tensor" else scales[0]
    if of_captured:
        with pytest.raises(ValueError, match="a tensor that vmap maps over, but that is not among its tensors"):
            torch.func.vmap(solution, axes)(*given)
    else:
        found = torch.func.vmap(solution, axes)(*given)
        factor = scales[:, None, None] if mapped == "a tensor" else 1.0
        assert torch.allclose(found, (b if of_b else B[None].expand(3, -1, -1)) / (factor * k[0]))


@pytest.mark.parametrize("by_numpy", [False, True])
def test_a_product_that_torch_does_not_record_has_no_silent_gradient_of_none(by_numpy):
    k = torch.linspace(1, 2, 5, dtype=torch.float64).requires_grad_()
    b = torch.ones(2, 5, dtype=torch.float64)

    def product(v, k):
        if by_numpy:
            return torch.from_numpy(k.detach().numpy() * v.detach().numpy())
        with torch.no_grad():
            return k * v

    u, _ = prdp.linear_solve(operators.Function(product, product, tensors=(k,)), b, prdp.CG(9))
    with pytest.raises(ValueError, match="torch does not record matvec, so that its tensors would get no gradient"):
        u.sum().backward()
    c = b.clone().requires_grad_()
    u, _ = prdp.linear_solve(operators.Function(product, product, tensors=(k,)), c, prdp.CG(9))
    torch.testing.assert_close(torch.autograd.grad(u.sum(), c)[0], (1 / k.detach()).expand(2, 5))  # is not asked for k
    unused = operators.Function(lambda v, k: 2 * v, symmetric=True, tensors=(k,))
    prdp.linear_solve(unused, b, prdp.CG(9))[0].sum().backward()  # is recorded, and k is not in it
    assert k.grad is None or not k.grad.any()
