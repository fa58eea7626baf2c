"""`ImplicitStep`: a step of an equation of your own."""

import copy
from collections.abc import Callable
from typing import Unpack

import torch
from torch import Tensor

from prdp_torch import operators, torch_private
from prdp_torch.operators.matrix import as_operator
from prdp_torch.solvers import Solver
from prdp_torch.stepper import Stepper
from prdp_torch.types import Backward, StepOptions


class ImplicitStep(Stepper):
    """Make a stepper of your own equation: it solves A(u) u_next = b(u) and does all that the built-in ones do.

    Args:
        operator: a function that takes u and returns an operator of `prdp_torch.operators` of any kind, or one
            operator for all u. The state u has the shape of the operator's vectors, (batch, ...).
        rhs: a function that takes u and returns b, with the shape and dtype of u. None takes u itself.
        solver, backward and the other options: as in `Stepper`.

    Gradients reach u and every tensor that A(u) and b(u) are made of. If `operator` or `rhs` is an `nn.Module`, it
    becomes a submodule, so its Parameters are trained, moved and saved with the stepper. The same holds for the
    tensors of a constant operator. It does not hold for variables that a plain function captures.

    Raises:
        TypeError, ValueError: A(u), b(u) and u do not fit each other. This is checked before any work.

    Examples:
        >>> nu, dt = torch.nn.Parameter(torch.tensor(1e-3)), 0.1
        >>> step = prdp.ImplicitStep(
        ...     lambda u: prdp.operators.Heat((30,), nu, dt), lambda u: u + dt * (u - u**3), prdp.CG(max_iter=5)
        ... )
        >>> states = step.rollout(u0, 10)  # (batch, 1, 30) -> (batch, 11, 1, 30)
    """

    def __init__(
        self,
        operator: Callable[[Tensor], operators.Operator | Tensor] | operators.Operator | Tensor,
        rhs: Callable[[Tensor], Tensor] | None = None,
        solver: Solver = None,  # type: ignore[assignment]  # None is refused
        backward: Backward = "implicit",
        **options: Unpack[StepOptions],
    ) -> None:
        who = type(self).__name__
        if isinstance(rhs, Solver) and solver is None:
            raise TypeError(f"{who}: rhs must be a function of u or None, got {rhs!r}; write solver={rhs!r}")
        super().__init__(solver, backward, **options)
        if isinstance(operator, (operators.Operator, Tensor)):
            operator = ConstantOperator(as_operator(who, "operator", operator))
        if not callable(operator):
            raise TypeError(f"{who}: operator must be a function of u or an operator, got {operator!r}")
        if rhs is not None and not callable(rhs):
            raise TypeError(f"{who}: rhs must be a function of u or None, got {rhs!r}")
        self.operator_at = operator
        self.rhs_at = rhs

    def operator(self, u: Tensor) -> operators.Operator | Tensor:
        """A(u) as an operator."""
        return self.operator_at(u)

    def rhs(self, u: Tensor) -> Tensor:
        """b(u), the right-hand side of the step from u."""
        return u if self.rhs_at is None else self.rhs_at(u)


class ConstantOperator(torch_private.HearsOfMoves):
    """One operator for all u. Its tensors move, save and train as those of a module do; a number given as
    nu stays one."""

    def __init__(self, operator: operators.Operator) -> None:
        super().__init__()
        self._operator = copy.copy(operator)
        for i, tensor in enumerate(operator.tensors):
            if isinstance(tensor, torch.nn.Parameter):
                self.register_parameter(f"tensor{i}", tensor)
            elif tensor.dim() > 0 or tensor.requires_grad:
                self.register_buffer(f"tensor{i}", tensor)
        self.moved()

    def forward(self, u: Tensor) -> operators.Operator:
        return self._operator

    def moved(self) -> None:
        """Take the tensors as the module has them now."""
        held = {
            **dict(self.named_parameters(recurse=False, remove_duplicate=False)),
            **dict(self.named_buffers(recurse=False, remove_duplicate=False)),
        }
        self._operator.tensors = [held.get(f"tensor{i}", t) for i, t in enumerate(self._operator.tensors)]
