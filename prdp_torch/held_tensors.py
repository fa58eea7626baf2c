"""Tensors of a step that are state, and those that were set for the next steps alone."""

from typing import Any, cast

import torch
from torch import Tensor


class HoldsTensors(torch.nn.Module):
    """A module with attributes that are tensors or numbers, and may be set at any time.

    A Parameter, a `torch.nn.Buffer`, a number and what the module was made of are state. Another tensor that is set
    later is for the steps that follow, as the output of a network is: copies, pickles and `state_dict` have what was
    there before.
    """

    def _hold(self, name: str, value: object) -> None:
        """Make it state, in place of what is there. Whoever is interrupted leaves the old one or the new one."""
        lent = self._lent()
        is_parameter, is_buffer = isinstance(value, torch.nn.Parameter), value is None or isinstance(value, Tensor)
        if not hasattr(self, name) and is_parameter:
            return self.register_parameter(name, cast(torch.nn.Parameter, value))
        if not hasattr(self, name) and is_buffer:
            return self.register_buffer(name, cast(Tensor | None, value))
        new: dict[str, Any] = self._parameters if is_parameter else self._buffers if is_buffer else vars(self)
        new[name] = value
        self._non_persistent_buffers_set.discard(name)
        for place in (self._buffers, self._parameters, lent, vars(self)):
            if place is not new:
                place.pop(name, None)

    def _set(self, name: str, value: object) -> None:
        """As it is set by a user."""
        if not isinstance(value, Tensor) or isinstance(value, (torch.nn.Parameter, torch.nn.Buffer)):
            return self._hold(name, value)
        # Attributes hide buffers and Parameters, which stay.
        self._lent().setdefault(name, [vars(self)[name]] if name in vars(self) else [])
        vars(self)[name] = value

    def _held(self, name: str) -> Any:
        """What it is now. A compiled graph asks whether it was set for the next steps, as it guards only what it read:
        a Parameter that an attribute hides is still there."""
        return vars(self)[name] if name in self._lent_tensors else getattr(self, name)

    def _lent(self) -> dict[str, list[Any]]:
        """The names of what was set for the next steps, with the attribute that it replaces, if it is one."""
        lent: dict[str, list[Any]] = vars(self).setdefault("_lent_tensors", {})
        return lent

    _lent_tensors: dict[str, list[Any]]

    def __getstate__(self) -> dict[str, Any]:
        """What copies and pickles hold."""
        lent = self._lent()
        state = {name: value for name, value in vars(self).items() if name not in lent}
        state |= {name: kept[0] for name, kept in lent.items() if kept}
        return state | {"_lent_tensors": {}}
