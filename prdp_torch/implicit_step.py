"""`ImplicitStep`: a step of an equation of your own."""

import copy
import inspect
from collections.abc import Callable
from operator import is_
from typing import Any, NamedTuple, Self, Unpack

import torch
from torch import Tensor

from prdp_torch import _check, operators, torch_private
from prdp_torch.closures import closed_over, warn_of_shared
from prdp_torch.operators.matrix import as_operator, hint_for
from prdp_torch.solvers import Solver
from prdp_torch.stepper import Stepper
from prdp_torch.types import Backward, StepOptions


class ImplicitStep(Stepper):
    """Make a stepper of your own equation: it solves A(u) u_next = b(u) and does all that the built-in ones do.

    Args:
        operator: a function that takes u and returns an operator of `prdp_torch.operators` of any kind, or one
            operator for all u. The state u has the shape of the operator's vectors, (batch, ...).
        rhs: a function that takes u, or u and A(u), and returns b, with the shape and dtype of u. None takes u itself.
        solver, backward and the other options: as in `Stepper`.

    Gradients reach u and every tensor that A(u) and b(u) are made of. If `operator` or `rhs` is an `nn.Module`, it
    becomes a submodule, so its Parameters are trained, moved and saved with the stepper. The same holds for the
    tensors of a constant operator, under the names of its arguments, such as `operator_at.kappa`; those of a
    `Function` are tensors_0, tensors_1 and so on. It does not hold for variables that a plain function captures:
    `copy.deepcopy` does not copy them, and warns where it copies a module that they belong to. A b that is made of A
    takes it as an argument: `rhs=lambda u, A: u / dt + A.boundary_rhs(values=2.0)`. In a module of your own, give
    methods, `ImplicitStep(self.operator, self.rhs)`, which copies make their own.

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
        rhs: Callable[..., Tensor] | None = None,
        solver: Solver = None,  # type: ignore[assignment]  # None is refused
        backward: Backward = "implicit",
        **options: Unpack[StepOptions],
    ) -> None:
        who = type(self).__name__
        if isinstance(rhs, Solver) and solver is None:
            raise TypeError(f"{who}: rhs must be a function of u or None, got {rhs!r}; write solver={rhs!r}")
        super().__init__(solver, backward, **options)
        if isinstance(operator, (operators.Operator, Tensor)):
            operator = as_operator(who, "operator", operator)
            if isinstance(operator, operators.Matrix) and operator.is_sparse_parameter:
                raise ValueError(
                    f"{who}: torch cannot copy a sparse Parameter, nor train it by Adam; "
                    "give operators.Matrix.csr(crow, col, values, size) with a Parameter as values"
                )
            operator = ConstantOperator(operator)
        if not callable(operator) or isinstance(operator, Stepper):
            raise TypeError(
                f"{who}: operator must be a function of u or an operator, got {operator!r}{hint_for(operator)}"
            )
        if rhs is not None and not callable(rhs):
            raise TypeError(f"{who}: rhs must be a function of u or None, got {_check.shown(rhs)}")
        self.operator_at = operator
        self.rhs_at = rhs
        self._asked = _Asked(rhs, _takes_two(rhs))

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        other = memo[id(self)] = type(self).__new__(type(self))
        vars(other).update(copy.deepcopy(vars(self), memo))
        warn_of_shared(type(self).__name__, (self.operator_at, self.rhs_at), memo)
        return other

    def operator(self, u: Tensor) -> operators.Operator | Tensor:
        """A(u) as an operator."""
        return self.operator_at(u)

    def rhs(self, u: Tensor) -> Tensor:
        """b(u), the right-hand side of the step from u."""
        if self.rhs_at is None:
            return u
        if self._takes_operator(self.rhs_at):
            return self.rhs_at(u, as_operator(type(self).__name__, "operator(u)", self.operator(u)))
        return self.rhs_at(u)

    def _rhs_with(self, u: Tensor, a: operators.Operator) -> Tensor:
        if type(self).rhs is not ImplicitStep.rhs or "rhs" in vars(self):
            return self.rhs(u)
        rhs = self.rhs_at
        if rhs is None:
            return u
        if self._takes_operator(rhs):
            return rhs(u, a)
        if a.stands_for is not None:
            _refuse_captured(rhs, a.stands_for, a)
        return rhs(u)

    def _takes_operator(self, rhs: Callable[..., Tensor]) -> bool:
        """Whether `rhs_at` takes A beside u; asked anew where it was set later."""
        asked: _Asked | None = vars(self).get("_asked")
        if asked is None or asked.rhs is not rhs:
            asked = self._asked = _Asked(rhs, _takes_two(rhs))
        return asked.takes_two


class _Asked(NamedTuple):
    """A right-hand side, and whether it is a function of two arguments."""

    rhs: Callable[..., Tensor] | None
    takes_two: bool


def _takes_two(rhs: Callable[..., Tensor] | None) -> bool:
    """Whether a function has two arguments without a default. What takes any number, as compiled functions do, is asked
    for the function that it wraps, as the modules of `torch.compile` and of data parallelism are for theirs."""
    if rhs is None:
        return False
    may_tell = [(rhs, False), (rhs, True)]  # the first that has a fixed number of arguments does
    if isinstance(rhs, torch.nn.Module):
        has_own_call = type(rhs).__call__ is not torch.nn.Module.__call__
        may_tell = [*([(rhs, False)] if has_own_call else []), (rhs.forward, False), (rhs.forward, True)]
    for function, follow in may_tell:
        try:
            parameters = inspect.signature(function, follow_wrapped=follow).parameters.values()
        except (TypeError, ValueError):  # of a function of C
            return False
        if all(p.kind is not p.VAR_POSITIONAL for p in parameters):
            positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
            return sum(p.kind in positional and p.default is p.empty for p in parameters) == 2
    parallel = (torch.nn.DataParallel, torch.nn.parallel.DistributedDataParallel)
    inner = rhs.module if isinstance(rhs, parallel) else getattr(rhs, "_orig_mod", None)  # that of torch.compile
    return isinstance(inner, torch.nn.Module) and _takes_two(inner)


class ConstantOperator(torch_private.HearsOfMoves):
    """One operator for all u. The tensors that it was made of are those of this module, under the names of its
    arguments: they move, save and train with it. A number given as nu stays one."""

    def __init__(self, operator: operators.Operator) -> None:
        super().__init__()
        self._operator = copy.copy(operator)
        operator.explain_freed_graphs()
        for name, tensor in zip(operator.names, operator.tensors, strict=True):
            if name is None or name in self._buffers:
                continue
            if isinstance(tensor, torch.nn.Parameter):
                self.register_parameter(name, tensor)
            else:
                self.register_buffer(name, tensor)

    def forward(self, u: Tensor) -> operators.Operator:
        tensors = self._tensors()
        if all(map(is_, tensors, self._operator.tensors)):
            return self._operator
        other = self._operator.of(tensors)  # for this call, such as those of torch.func.functional_call
        if not torch.compiler.is_compiling():
            other.stands_for = self._operator
        return other

    def _moved(self, move: Callable[[Tensor], Tensor]) -> None:
        """Keep the tensors that the module has now."""
        self._operator.tensors = self._tensors()

    def _tensors(self) -> list[Tensor]:
        made_of = zip(self._operator.names, self._operator.tensors, strict=True)
        return [tensor if name is None else getattr(self, name) for name, tensor in made_of]


def _refuse_captured(rhs: object, own: operators.Operator, given: operators.Operator) -> None:
    """Raise ValueError if `rhs` has captured a tensor of its step's operator that another stands for in this call."""
    pairs = zip(own.tensors, given.tensors, strict=True)
    replaced = {id(tensor) for tensor, other in pairs if not _is_same(tensor, other)}
    for name, held in closed_over(rhs):
        if id(held) in replaced:
            raise ValueError(
                f"ImplicitStep: rhs captures {name!r}, whose tensors are not those of this call, as in "
                "torch.func.functional_call; let it take A beside u: rhs=lambda u, A: ..."
            )


def _is_same(own: Tensor, given: Tensor) -> bool:
    """Whether a tensor that is given for another is that one, or its values without a gradient."""
    if own is given:
        return True
    return not (torch_private.transforms_are_active() or given.requires_grad) and given.is_set_to(own)
