"""`ImplicitStep`: a step of an equation of your own."""

import copy

import torch

from prdp_torch import operators
from prdp_torch.stepper import Stepper


class ImplicitStep(Stepper):
    """Solve A(u) u_next = b(u) for an equation of your own, with all that the built-in steppers have.

    Args:
        operator: a function u → operator of `prdp_torch.operators` (of any kind, `Matrix` and `Function`
            included), or one operator for all u. The state u is (batch, ...), as the operator's vectors.
        rhs: a function u → b of the shape and dtype of u; b is the state itself where None.
        solver, backward and the other options: as in `Stepper`.

    Gradients reach u and every tensor that A(u) and b(u) are made of. An `nn.Module` among the two becomes a
    submodule, so that its Parameters are trained, moved and saved with the stepper; so do the tensors of a
    constant operator. What a plain function closes over belongs to its owner.

    Raises TypeError or ValueError where A(u), b(u) and u do not fit each other, before any work.

    >>> nu, dt = torch.nn.Parameter(torch.tensor(1e-3)), 0.1
    >>> step = prdp.ImplicitStep(
    ...     lambda u: prdp.operators.Heat((30,), nu, dt), lambda u: u + dt * (u - u**3), prdp.CG(max_iter=5)
    ... )
    >>> states = step.rollout(u0, 10)  # (batch, 1, 30) -> (batch, 11, 1, 30)
    """

    def __init__(self, operator, rhs=None, solver=None, backward="implicit", **options):
        super().__init__(solver, backward, **options)
        who = type(self).__name__
        if isinstance(operator, (operators.Operator, torch.Tensor)):
            operator = ConstantOperator(operators.as_operator(who, "operator", operator))
        if not callable(operator):
            raise TypeError(f"{who}: operator must be a function of u or an operator, got {operator!r}")
        if rhs is not None and not callable(rhs):
            raise TypeError(f"{who}: rhs must be a function of u or None, got {rhs!r}")
        self.operator_at = operator
        self.rhs_at = rhs

    def operator(self, u):
        """A(u) as an operator."""
        return self.operator_at(u)

    def rhs(self, u):
        """b(u), the right-hand side of the step from u."""
        return u if self.rhs_at is None else self.rhs_at(u)


class ConstantOperator(torch.nn.Module):
    """One operator for all u. Its tensors move, save and train as those of a module do; a number given as
    nu stays one."""

    def __init__(self, operator):
        super().__init__()
        self._operator = copy.copy(operator)
        for i, tensor in enumerate(operator.tensors):
            if isinstance(tensor, torch.nn.Parameter):
                self.register_parameter(f"tensor{i}", tensor)
            elif tensor.dim() > 0 or tensor.requires_grad:
                self.register_buffer(f"tensor{i}", tensor)
        self._collect()

    def forward(self, u):
        return self._operator

    def _apply(self, fn, recurse=True):
        super()._apply(fn, recurse)
        self._collect()
        return self

    def _collect(self):
        """The tensors as the module has them now."""
        held = {**self._parameters, **self._buffers}
        self._operator.tensors = [held.get(f"tensor{i}", t) for i, t in enumerate(self._operator.tensors)]
