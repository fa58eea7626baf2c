"""What the functions of a step or an operator close over, which copies of them do not copy."""

import types
import warnings
from collections.abc import Iterator
from typing import Any

import torch


def warn_of_shared(who: str, functions: tuple[object, ...], memo: dict[int, Any]) -> None:
    """Warn where functions of a copy go on using a module or a tensor that is copied beside them: `copy.deepcopy`
    hands functions on as they are. `memo` is its argument, what it has copied so far."""
    for function in functions:
        for name, held in _closed_over(function):
            if id(held) in memo and memo[id(held)] is not held:
                called = getattr(function, "__name__", function)
                warnings.warn(
                    f"{who}: in this copy, the function {called!r} still uses {name!r} of the original, with its "
                    "parameters. Give methods, such as ImplicitStep(self.operator, self.rhs, ...), or modules: a copy "
                    "then uses its own",
                    stacklevel=2,
                )
                return


def _closed_over(function: object) -> Iterator[tuple[str, object]]:
    """The modules and tensors of a function's closure, by their names there; those of functions in it as well."""
    if not isinstance(function, types.FunctionType):
        return
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        try:
            held = cell.cell_contents
        except ValueError:  # not set yet
            continue
        if isinstance(held, torch.Tensor) or (isinstance(held, torch.nn.Module) and held.state_dict()):
            yield name, held
        elif held is not function:
            yield from _closed_over(held)
