"""Objects of the compiled library that are kept from call to call."""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

Made = TypeVar("Made")


class Kept(Generic[Made]):
    """An object of the compiled library, made anew by `make` where the values that it is made of have changed.
    Copies and pickles begin without one."""

    def __init__(self, make: Callable[..., Made]) -> None:
        self.make = make
        self._last: tuple[tuple[Any, ...], Made] | None = None

    def of(self, *values: Any) -> Made:
        last = self._last
        if last is None or last[0] != values:
            last = self._last = values, self.make(*values)
        return last[1]

    def __deepcopy__(self, memo: dict[int, Any]) -> "Kept[Made]":
        return Kept(self.make)

    def __reduce__(self) -> tuple[Any, ...]:
        return Kept, (self.make,)
