"""Copies of steps whose functions close over the module that they belong to."""

import copy
import warnings

import pytest
import torch

import prdp_torch as prdp
from prdp_torch import operators

U = torch.ones(2, 1, 6)


class Closing(torch.nn.Module):
    """As users write it first."""

    def __init__(self, made=lambda self: lambda u: operators.Heat((6,), self.nu, 0.1)):
        super().__init__()
        self.nu = torch.nn.Parameter(torch.tensor(0.5))
        self.step = prdp.ImplicitStep(made(self), solver=prdp.CG(9))

    def forward(self, u):
        return self.step(u)

    def heat(self, u):
        return operators.Heat((6,), self.nu, 0.1)


def of_tensor(self):
    nu = self.nu
    return lambda u: operators.Heat((6,), nu, 0.1)


def through_another(self):
    def nu():
        return self.nu

    return lambda u: operators.Heat((6,), nu(), 0.1)


def constant_function(self):
    return operators.Function(lambda v: v * (1 + self.nu.detach()), symmetric=True)


@pytest.mark.parametrize("made", [*Closing.__init__.__defaults__, of_tensor, through_another, constant_function])
def test_a_copy_that_shares_parameters_in_silence_says_so(made):
    module = Closing(made)
    with pytest.warns(
        UserWarning, match=r"(ImplicitStep|Function): in this copy, .* still uses '(self|nu)' of the orig"
    ):
        copied = copy.deepcopy(module)
    before = copied(U)
    torch.nn.init.zeros_(copied.nu)
    assert torch.equal(copied(U), before)  # what the warning is about


def test_methods_are_copied_with_their_module():
    """The pattern that the warning names."""
    module = Closing(lambda self: self.heat)
    copied = copy.deepcopy(module)
    before = module(U)
    torch.nn.init.zeros_(copied.nu)
    assert torch.equal(copied(U), U) and torch.equal(module(U), before) and not torch.equal(before, U)
    copied(U).sum().backward()
    assert copied.nu.grad is not None


def test_no_warning_where_nothing_is_left_behind():
    nu = torch.tensor(0.5)
    outside = prdp.ImplicitStep(lambda u: operators.Heat((6,), nu, 0.1), solver=prdp.CG(9))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        copied = copy.deepcopy(torch.nn.Sequential(outside))
        copy.deepcopy(Closing().step)  # alone: what it closes over is not copied at all
    assert torch.equal(copied(U), outside(U)) and copied[0].info is not outside.info
