"""Types of arguments in words; the compiled library checks their ranges. Each returns the argument as
the plain type it stands for, or raises TypeError, or ValueError for a number that
this type cannot hold. int and float are asked for first: to ask an abstract class takes as long as the rest."""

import numbers
from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


def shown(value: object) -> str:
    """What was given, for an error: a tensor by its shape, anything else as it prints."""
    if isinstance(value, Tensor) and value.numel() > 1:
        return f"a tensor of shape {tuple(value.shape)}"
    return repr(value)


def whole(who: str, name: str, value: object) -> int:
    if type(value) is int or (isinstance(value, numbers.Integral) and not isinstance(value, bool)):
        number = int(value)
        if abs(number) >= 2**63:
            raise ValueError(f"{who}: {name} must be less than 2**63, got {value}")
        return number
    raise TypeError(f"{who}: {name} must be a whole number, got {shown(value)}")


def real(who: str, name: str, value: object) -> float:
    if type(value) is float:
        return value
    if isinstance(value, numbers.Real) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            raise ValueError(f"{who}: {name} must be less than 2**1024, got a number of more digits") from None
    hint = "; take .item(), as it gets no gradient" if isinstance(value, Tensor) and value.numel() == 1 else ""
    raise TypeError(f"{who}: {name} must be a real number, got {shown(value)}{hint}")


def optional(check: Callable[[str, str, object], T], who: str, name: str, value: object) -> T | None:
    return None if value is None else check(who, name, value)


def string(who: str, name: str, value: object) -> str:
    if isinstance(value, str):
        return value
    raise TypeError(f"{who}: {name} must be a string, got {shown(value)}")


def shape(who: str, value: object) -> list[int]:
    if isinstance(value, (tuple, list)):
        return [whole(who, "every extent of shape", n) for n in value]
    raise TypeError(f"{who}: shape must be a tuple of whole numbers such as (30,), got {shown(value)}")


def lengths(who: str, value: object, axes: int) -> list[float]:
    """The sides of the domain, one per axis; none where all are 1."""
    if not isinstance(value, (tuple, list)):
        sides = [real(who, "length", value)] * axes
    else:
        sides = [real(who, "every length", side) for side in value]
        if len(sides) != axes:
            raise ValueError(f"{who}: length must be one number or one per axis, {axes} here, got {value!r}")
    return [] if all(side == 1.0 for side in sides) else sides


def writes(t: Tensor) -> int | None:
    """How often a tensor was written to; None where nobody counts. A view has the count of its base, which may be
    written to elsewhere: in another state of a history, say."""
    return None if torch.compiler.is_compiling() or t.is_inference() or t._is_view() else t._version


def dense(who: str, name: str, value: object) -> Tensor:
    if not isinstance(value, Tensor):
        raise TypeError(f"{who}: {name} must be a torch tensor, got {type(value).__name__}")
    if value.layout != torch.strided:
        raise TypeError(f"{who}: {name} must be a dense tensor, got one of layout {value.layout}")
    if value.is_nested:
        raise TypeError(f"{who}: {name} must be a dense tensor, got a nested one")
    return value
