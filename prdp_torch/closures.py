"""What the functions of a step or an operator close over, which copies of them do not copy."""

import contextlib
import dis
import types
import warnings
from collections.abc import Iterator
from typing import Any

import torch

from prdp_torch.operators.base import Operator


def warn_of_shared(who: str, functions: tuple[object, ...], memo: dict[int, Any]) -> None:
    """Warn where functions of a copy go on using a module or a tensor that is copied beside them: `copy.deepcopy`
    hands functions on as they are. `memo` is its argument, what it has copied so far."""
    for function in functions:
        for name, held in closed_over(function):
            if id(held) in memo and memo[id(held)] is not held:
                called = getattr(function, "__name__", function)
                warnings.warn(
                    f"{who}: in this copy, the function {called!r} still uses {name!r} of the original, with its "
                    "parameters. Let rhs take A beside u, or give modules or methods, such as "
                    "ImplicitStep(self.operator, self.rhs, ...): a copy then uses its own",
                    stacklevel=2,
                )
                return


def closed_over(function: object, seen: set[int] | None = None) -> Iterator[tuple[str, object]]:
    """The modules and tensors that a function uses from around it, by their names there; those of operators and of
    functions that it uses as well."""
    seen = set() if seen is None else seen
    if not isinstance(function, types.FunctionType) or id(function) in seen:
        return
    seen.add(id(function))
    for name, held in _names_around(function):
        if isinstance(held, torch.Tensor) or (isinstance(held, torch.nn.Module) and held.state_dict()):
            yield name, held
        elif isinstance(held, Operator):
            yield from ((name, tensor) for tensor in held.tensors)
        else:
            yield from closed_over(held, seen)


def _names_around(function: types.FunctionType) -> Iterator[tuple[str, object]]:
    """The variables of enclosing functions, of defaults, and of the script that the code of a function names. Functions
    from elsewhere, such as those of torch, are left out."""
    code = function.__code__
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):  # not set yet
            yield name, cell.cell_contents
    defaults = function.__defaults__ or ()
    yield from zip(code.co_varnames[code.co_argcount - len(defaults) : code.co_argcount], defaults, strict=True)
    for name in {i.argval for i in dis.get_instructions(code) if i.opname in ("LOAD_GLOBAL", "LOAD_NAME")}:
        held = function.__globals__.get(name)
        if not isinstance(held, types.FunctionType) or held.__globals__ is function.__globals__:
            yield name, held
