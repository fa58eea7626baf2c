"""Right-hand sides of `ImplicitStep` that take A beside u, or capture it."""

import copy
import functools
import warnings

import pytest
import torch
from helpers import field

import prdp_torch as prdp
from prdp_torch import operators

N = 9


def step_with_boundary_values(rhs):
    """And A, of which b is made as well."""
    A = prdp.operators.Diffusion(torch.nn.Parameter(torch.rand(1, 8, dtype=torch.float64) + 0.5), shift=10.0)
    return A, prdp.ImplicitStep(A, rhs(A), prdp.Direct())


def exact_with_boundary_values(kappa, u):
    A = prdp.operators.Diffusion(kappa, shift=10.0)
    b = 10.0 * u + A.boundary_rhs(values=2.0)
    return torch.linalg.solve(A.dense(), b.flatten(1).T).T.view_as(u)


def test_a_right_hand_side_may_take_the_operator():
    """Then b follows A into copies, `functional_call` and ensembles."""
    u = torch.randn(2, 1, 8, dtype=torch.float64)
    _, step = step_with_boundary_values(lambda A: lambda u, A: 10.0 * u + A.boundary_rhs(values=2.0))
    kappa = step.operator_at.kappa.detach().clone()
    torch.testing.assert_close(step(u), exact_with_boundary_values(kappa, u))
    assert torch.equal(step.rhs(u), 10.0 * u + step.operator(u).boundary_rhs(values=2.0))
    other = copy.deepcopy(step)
    with torch.no_grad():
        other.operator_at.kappa.mul_(3.0)
    torch.testing.assert_close(other(u), exact_with_boundary_values(3.0 * kappa, u))
    of = {"operator_at.kappa": 2.0 * kappa}
    torch.testing.assert_close(torch.func.functional_call(step, of, u), exact_with_boundary_values(2.0 * kappa, u))
    torch.testing.assert_close(step.rollout(u, 2)[:, 1], exact_with_boundary_values(kappa, u))
    assert torch.autograd.gradcheck(
        lambda k: torch.func.functional_call(step, {"operator_at.kappa": k}, u), kappa.requires_grad_()
    )


@pytest.mark.parametrize(
    "rhs",
    [
        lambda A: lambda u: 10.0 * u + A.boundary_rhs(values=2.0),
        lambda A: lambda u, A=A: 10.0 * u + A.boundary_rhs(values=2.0),
        lambda A: lambda u, kappa=A.kappa: u * kappa,
    ],
)
def test_a_right_hand_side_that_captures_the_operator_says_so_where_it_would_be_wrong(rhs):
    u = torch.randn(2, 1, 8, dtype=torch.float64)
    A, step = step_with_boundary_values(rhs)
    step(u)  # is right
    with pytest.warns(UserWarning, match="still uses '(A|kappa)' of the original"):
        copy.deepcopy(step)
    with pytest.raises(ValueError, match=r"rhs captures '(A|kappa)', .* let it take A beside u"):
        torch.func.functional_call(step, {"operator_at.kappa": 2.0 * A.kappa.detach()}, u)
    step.load_state_dict({"operator_at.kappa": 2.0 * A.kappa.detach()}, assign=True)
    with pytest.raises(ValueError, match="rhs captures"):
        step(u)


class OwnCall(torch.nn.Module):
    def __call__(self, u):
        return super().__call__(u, 2.0)

    def forward(self, u, factor):
        return factor * u


class WithOperator(torch.nn.Module):
    def forward(self, u, A):
        return A.apply(u)


def wrapped(u):
    return 2.0 * u


wrapped.__wrapped__ = lambda u, factor: factor * u


@pytest.mark.parametrize("rhs", [
    lambda u, factor=2.0: factor * u, lambda u, *rest: 2.0 * u, lambda u, *, factor=2.0: factor * u, OwnCall(), wrapped,
    functools.partial(torch.mul, other=2.0), torch.compile(lambda u: 2.0 * u, backend="eager"),
    torch.compile(OwnCall(), backend="eager"), torch.nn.DataParallel(OwnCall()),
])  # fmt: skip
def test_functions_of_u_alone_get_no_operator(rhs):
    u = field((N,))
    a = operators.Heat((N,), 0.1, 0.1)
    torch.testing.assert_close(
        prdp.ImplicitStep(a, rhs, prdp.Direct())(u), prdp.linear_solve(a, 2 * u, prdp.Direct())[0]
    )


@pytest.mark.parametrize("rhs", [
    lambda u, A: A.apply(u), WithOperator(), torch.compile(lambda u, A: A.apply(u), backend="eager"),
    torch.compile(WithOperator(), backend="eager"), torch.nn.DataParallel(WithOperator()),
    torch.compile(torch.nn.DataParallel(WithOperator()), backend="eager"),
])  # fmt: skip
def test_functions_of_two_arguments_get_it(rhs):
    u = field((N,))
    step = prdp.ImplicitStep(operators.Heat((N,), 0.1, 0.1), rhs, prdp.Direct())
    torch.testing.assert_close(step(u), u)


def test_a_right_hand_side_that_is_set_later_is_asked_anew():
    u = field((N,))
    step = prdp.ImplicitStep(operators.Heat((N,), 0.1, 0.1), lambda u, A: A.apply(u), prdp.Direct())
    step.rhs_at = lambda u: u
    torch.testing.assert_close(step(step.operator(u).apply(u)), u)


def test_a_subclass_adds_to_a_right_hand_side_that_takes_the_operator():
    class Heated(prdp.ImplicitStep):
        def rhs(self, u):
            return super().rhs(u) + 1.0

    u = field((N,))
    a = operators.Heat((N,), 0.1, 0.1)
    step = Heated(a, lambda u, A: A.apply(u), prdp.Direct())
    torch.testing.assert_close(step(u), prdp.linear_solve(a, a.apply(u) + 1.0, prdp.Direct())[0])


def test_what_is_no_tensor_of_the_operator_may_be_captured():
    """Another tensor of it, one that is not replaced, the same values, and an attribute with the name of a global."""
    u = torch.randn(2, 1, 8, dtype=torch.float64)
    kappa, shift = torch.rand(1, 8, dtype=torch.float64) + 1, torch.tensor(0.5, dtype=torch.float64)
    A = operators.Diffusion(kappa, shift=shift)
    step = prdp.ImplicitStep(A, lambda u: shift * u, prdp.Direct())
    found = torch.func.functional_call(step, {"operator_at.kappa": 2 * kappa}, u)
    expected = prdp.linear_solve(operators.Diffusion(2 * kappa, shift=shift), shift * u, prdp.Direct())[0]
    assert torch.equal(found, expected)
    parameter = torch.nn.Parameter(kappa)
    step = prdp.ImplicitStep(operators.Diffusion(parameter, shift=1.0), lambda u: u * parameter.detach(), prdp.Direct())
    assert torch.equal(torch.func.functional_call(step, {"operator_at.kappa": parameter.detach()}, u), step(u))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        holder = torch.nn.ModuleList([GLOBAL, prdp.ImplicitStep(A, lambda u: Named.GLOBAL * u, prdp.Direct())])
        copy.deepcopy(holder)


class Named:
    GLOBAL = 3.0


GLOBAL = torch.nn.Linear(2, 2)
