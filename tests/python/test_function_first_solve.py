"""What the first solve with a function refuses: products that are not linear, or that mix samples."""

import contextlib

import pytest
import torch
from test_function import right_hand_side

import prdp_torch as prdp
from prdp_torch import operators


def test_a_constant_in_the_product_is_refused_at_the_first_solve():
    """Powers of two scale b, so that its residual would be that of another problem."""
    diagonal = 2 + torch.rand(4, dtype=torch.float64)

    def with_boundary(v):
        return diagonal * v + 1

    a = operators.Function(with_boundary, diagonal=lambda: diagonal)
    for _ in range(2):  # nor does it pass the second time
        with pytest.raises(ValueError, match=r"Function: matvec must be linear, but matvec\(0\) holds ±1; constants"):
            prdp.linear_solve(a, 4 * right_hand_side(), prdp.Jacobi(50))


@pytest.mark.parametrize("dtype, step", [(torch.float32, 1e-2), (torch.float64, 1e-6)])
def test_rounding_in_the_product_of_zero_is_no_constant(dtype, step):
    """A Jacobian by differences: F is evaluated for the whole batch, and F(u0) in another way."""
    u0 = torch.linspace(1, 2, 4, dtype=dtype)
    at_u0 = u0**3 * (1 + torch.finfo(dtype).eps)
    a = operators.Function(lambda v: ((u0 + step * v) ** 3 - at_u0) / step)
    u, _ = prdp.linear_solve(a, right_hand_side().to(dtype), prdp.GMRES(9, rtol=1e-2))
    assert (u * 3 * u0**2 - right_hand_side()).norm() < 0.1 * right_hand_side().norm()


def test_the_first_second_and_fourth_solve_with_this_code_look_whether_it_is_linear():
    def begins_with_zero(scale):
        given = []

        def product(v):
            given.append(v.clone())
            return scale * v

        prdp.linear_solve(operators.Function(product), right_hand_side(), prdp.GMRES(2))
        return not given[0].any()

    assert [begins_with_zero(scale) for scale in (2.0, 3.0, 4.0, 5.0, 6.0)] == [True, True, False, True, False]


def test_a_product_that_is_not_linear_is_refused():
    """As the residual of Newton's method in place of its derivative."""
    b = right_hand_side()
    powers = [lambda v: v + 0.1 * v**3, lambda v: v + v**2]
    upwind = [lambda v: 2 * v + v.relu() - v.relu().roll(1, -1), lambda v: 2 * v + v.abs()]  # linear for v > 0
    for product in (*powers, *upwind):
        for _ in range(2):  # nor does it pass the second time
            with pytest.raises(ValueError, match=r"must be linear, but matvec\(-2 v\) and -2 matvec\(v\) differ by"):
                prdp.linear_solve(operators.Function(product), b, prdp.GMRES(9))


def test_a_product_that_mixes_samples_is_refused():
    b = right_hand_side()
    assert len(b) > 1
    mixing = [lambda v: 3 * v + v.mean(0, keepdim=True), lambda v: 3 * v + v.roll(1, 0)]
    for product in mixing:
        for _ in range(2):  # nor does it pass the second time
            with pytest.raises(ValueError, match=r"matvec must keep samples apart, but matvec\(v\) of sample \d"):
                prdp.linear_solve(operators.Function(product), b, prdp.GMRES(9))
    assert prdp.linear_solve(operators.Function(mixing[0]), b[:1], prdp.GMRES(9))[1].solved.all()  # alone
    b[0] = 0.0
    with pytest.raises(ValueError, match="must keep samples apart"):
        prdp.linear_solve(operators.Function(lambda v: 3 * v + v.sum(0)), b, prdp.GMRES(9))


@pytest.mark.parametrize("share", [0.02, 0.2, 0.5])
def test_samples_that_mix_a_little_are_refused_too(share):
    b = torch.randn(16, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match=r"of sample \d+ depends on the v of sample \d+"):
        prdp.linear_solve(operators.Function(lambda v: 2 * v - share * v.mean(0, keepdim=True)), b, prdp.GMRES(9))


def test_a_step_by_the_whole_batch_and_noise_are_no_mixing():
    g = torch.Generator().manual_seed(0)
    matrix = torch.randn(20, 20, generator=g, dtype=torch.float64)
    matrix = matrix @ matrix.T + 20 * torch.eye(20, dtype=torch.float64)
    point, b = (torch.randn(4, 20, generator=g, dtype=torch.float64) for _ in range(2))

    def residual(u):
        return u @ matrix + 0.05 * u**3

    def by_brown_and_saad(v):
        along, one, two = (point * v).sum(), v.abs().sum(), v.square().sum()
        if two == 0:
            return 0 * v
        least = 1e-6 * one
        step = 1.5e-8 * (along if along.abs() > least else least) / two
        return (residual(point + step * v) - residual(point)) / step

    def noisy(v):
        return v @ matrix * (1 + 3e-3 * torch.randn(v.shape, generator=g, dtype=torch.float64))

    for product in (by_brown_and_saad, noisy):
        a = operators.Function(product, transpose=product)
        _, info = prdp.linear_solve(a, b, prdp.GMRES(40, rtol=1e-2), backward="none", on_failure="return")
        assert len(info.status) == 4


def test_samples_that_a_weight_mixes_later_are_refused_then():
    def solve(weight):
        a = operators.Function(lambda v, w: 2 * v + w * v.roll(1, 0), tensors=(torch.tensor(weight).double(),))
        return prdp.linear_solve(a, right_hand_side(), prdp.GMRES(9))

    solve(0.0)
    with pytest.raises(ValueError, match="must keep samples apart"):
        solve(0.3)


def test_the_step_of_a_product_by_differences_may_be_that_of_the_batch():
    n, dtype = 32, torch.float32
    u = torch.sin(torch.linspace(0, 3, n, dtype=dtype)).repeat(4, 1) * torch.tensor([[1.0], [2.0], [0.5], [1.5]])

    def residual(x):
        x = torch.nn.functional.pad(x, (1, 1))
        return (2 * x[:, 1:-1] - x[:, 2:] - x[:, :-2]) * (n + 1) ** 2 - x[:, 1:-1].exp()

    def product(v):
        step = torch.finfo(dtype).eps ** 0.5 * (1 + u.norm()) / v.norm()
        return (residual(u + step * v) - residual(u)) / step if v.any() else 0 * v

    _, info = prdp.linear_solve(operators.Function(product), torch.ones(4, n), prdp.GMRES(4, 1e-2), backward="none")
    assert info.failed.sum() == 0


@pytest.mark.filterwarnings("ignore:.* matvec is not linear")  # of the u that is found
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e6])
def test_a_derivative_by_differences_is_linear_enough_whatever_the_size_of_b(scale):
    u0 = torch.linspace(1, 2, 4, dtype=torch.float64)
    b = scale * right_hand_side()
    b[0, 0] = torch.nan  # NaN in one sample
    a = operators.Function(lambda v: ((u0 + 1e-3 * v) ** 3 - u0**3) / 1e-3)
    _, info = prdp.linear_solve(a, b, prdp.GMRES(9, rtol=1e-2), on_failure="return")
    assert info.status[0] == prdp.SolveStatus.NONFINITE_INPUT


def test_modules_of_one_class_are_looked_at_each():
    class Scaled(torch.nn.Module):
        def __init__(self, constant):
            super().__init__()
            self.constant = constant

        def forward(self, v):
            return 2 * v + self.constant

    for _ in range(3):
        prdp.linear_solve(operators.Function(Scaled(0.0)), right_hand_side(), prdp.GMRES(2))
    with pytest.raises(ValueError, match=r"matvec\(0\) holds ±1"):
        prdp.linear_solve(operators.Function(Scaled(1.0)), right_hand_side(), prdp.GMRES(2))


def test_a_constant_that_appears_later_is_refused_too():
    def solve(at_the_boundary):
        a = operators.Function(lambda v: 2 * v + at_the_boundary)
        return prdp.linear_solve(a, right_hand_side(), prdp.GMRES(2))

    solve(0.0)
    with pytest.raises(ValueError, match=r"matvec\(0\) holds ±0.1"):
        solve(0.1)


@pytest.mark.parametrize("method", [prdp.CG(20), prdp.GMRES(20), prdp.BiCGStab(20), prdp.MINRES(20), prdp.Direct()])
def test_inference_mode_looks_at_the_transpose_as_well(method):
    """By a product that autograd records, which it does not by itself there."""
    b = torch.randn(2, 1, 8, dtype=torch.float64)
    b = b - b.mean(-1, keepdim=True)

    def solve():
        weight = torch.full((8,), 2.0, dtype=torch.float64)
        a = operators.Function(
            lambda v, w: w * v - v.roll(1, -1) - v.roll(-1, -1), nullspace="constant", tensors=[weight]
        )
        return prdp.linear_solve(a, b, method)[0], prdp.check_operator(a, b)

    expected, _ = solve()
    with torch.inference_mode():
        found, is_right = solve()
    assert is_right and torch.equal(found, expected)


def test_inference_mode_names_a_tensor_that_autograd_cannot_record():
    with torch.inference_mode():
        weight, b = torch.full((8,), 2.0), torch.ones(1, 1, 8)
        a = operators.Function(lambda v: weight * v)
        with pytest.raises(ValueError, match="Function: matvec uses a tensor that was made in inference mode"):
            a.apply_transpose(b)
        handed_over = operators.Function(lambda v, w: w * v, tensors=[weight])
    for mode in (contextlib.nullcontext(), torch.inference_mode()):
        with mode, torch.enable_grad():
            assert torch.equal(handed_over.apply_transpose(b), weight * b)


def test_a_slightly_nonlinear_product_is_told_by_its_residual(always):
    """It is linear enough not to be refused, and its residual is that of another b."""
    b = torch.randn(2, 1, 30, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    a = operators.Function(lambda v: 3 * v - 0.3 * torch.tanh(v.roll(1, -1)))
    with pytest.warns(UserWarning, match=r"matvec is not linear: in sample \d, \|b - A u\| is 0.0"):
        prdp.linear_solve(a, b, prdp.BiCGStab(100, rtol=1e-8))


def test_a_linear_product_is_not():
    b = torch.randn(2, 1, 30, generator=torch.Generator().manual_seed(0), dtype=torch.float32)
    a = operators.Function(lambda v: 3 * v - v.roll(1, -1))
    for scale in (1e-20, 1.0, 1e20):
        prdp.linear_solve(a, scale * b, prdp.BiCGStab(100, rtol=1e-6))
        prdp.linear_solve(a, scale * b, prdp.GMRES(100, restart=5, rtol=0.0), on_failure="return")
