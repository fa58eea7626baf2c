"""All that the library takes from torch beside its public interface, each with the reason.

Where a release of torch changes one of them, `tests/python/test_torch_private.py` fails with its name.
"""

import functools
import sys
from collections.abc import Callable, Mapping
from typing import Any, Self, TypeVar, cast

import torch
from torch import Tensor
from torch._C._functorch import get_unwrapped, is_functorch_wrapped_tensor, maybe_get_bdim

without_transforms = torch._C._DisableFuncTorch
"""A context in which torch.func leaves tensors alone: it does not know sparse ones, whose parts are read in it."""


def transforms_are_active() -> bool:
    """Whether a transform of torch.func runs. Its wrappers must not leave it, and nothing public tells."""
    return bool(torch._C._are_functorch_transforms_active())


def modes_are_active() -> bool:
    """Whether a dispatch mode runs, such as that of fake tensors: then a number becomes a tensor of the mode's kind,
    which must not outlive it. Nothing public tells."""
    return not torch.compiler.is_compiling() and bool(torch._C._len_torch_dispatch_stack())


def is_end_of_recomputation(error: BaseException) -> bool:
    """Whether this is how `torch.utils.checkpoint` leaves what it runs again, once it has what it needs."""
    import torch.utils.checkpoint

    return isinstance(error, torch.utils.checkpoint._StopRecomputationError)


def unwrapped(t: Tensor) -> Tensor:
    """A tensor without the wrappers of the transforms that run; the axes that are mapped come first. Reports of solves
    outlive the transforms, and torch.func has no public way to take a wrapper off."""
    while is_functorch_wrapped_tensor(t):
        dim = maybe_get_bdim(t)
        t = get_unwrapped(t)
        t = t.movedim(dim, 0) if dim > 0 else t
    return t


def number_as_graph_input(holder: object, name: str) -> Any:
    """A whole number, or None, that a module or a part of it holds, inside torch.compile, which otherwise takes it for
    a constant and compiles again for each value. torch.compiler has no such switch for one number: its dynamic_sources
    is a list for the whole process, which therefore has the number only while it is read."""
    if torch.compiler.is_exporting():
        return getattr(holder, name)
    listed = _list_as_dynamic(name)
    number = getattr(holder, name)
    if number is not None:
        number = number + 0  # the number is read where it is used first, which must be here
    _list_as_before(listed)
    return number


F = TypeVar("F", bound=Callable[..., Any])


def _called_while_tracing(function: F) -> F:
    """Called while torch.compile traces, not by what it makes. `torch.compiler.assume_constant_result` is this, but
    imports the compiler, which takes as long as the rest of torch."""
    function._dynamo_marked_constant = True  # type: ignore[attr-defined]
    return function


def disabled_once_imported(call: F, reason: str) -> F:
    """`torch.compiler.disable(call, reason=reason)`, which imports the compiler: that takes as long as the rest of
    torch, so it waits for the first call in a process that has imported it. Until then nothing is compiled."""
    disabled: list[Callable[..., Any]] = []

    @functools.wraps(call)
    def called(*args: Any, **kwargs: Any) -> Any:
        if torch.compiler.is_dynamo_compiling():  # from the first line on, as where a module is compiled
            torch._dynamo.graph_break(msg=reason)
        if "torch._dynamo" not in sys.modules:
            return call(*args, **kwargs)
        if not disabled:
            disabled.append(cast(F, torch.compiler.disable(call, reason=reason)))
        return disabled[0](*args, **kwargs)

    called._torchdynamo_disable = True  # type: ignore[attr-defined]
    called._torchdynamo_disable_msg = reason  # type: ignore[attr-defined]
    return cast(F, called)


@_called_while_tracing
def _list_as_dynamic(name: str) -> str:
    listed: str = torch.compiler.config.dynamic_sources
    torch.compiler.config.dynamic_sources = f"{listed},.*\\b{name}\\b"
    return listed


@_called_while_tracing
def _list_as_before(listed: str) -> None:
    torch.compiler.config.dynamic_sources = listed


def graph_is_freed(t: Tensor) -> bool:
    """Whether a backward pass has freed the graph that t is a result of, so that the nearest node that keeps tensors
    has lost them. Nothing public tells. Nodes show them as `_saved_...`, and raise where they are gone."""
    nodes = [t.grad_fn]
    for node in nodes:  # which grows
        if node is None:
            continue
        for name in (name for name in dir(node) if name.startswith("_saved_") or name == "saved_tensors"):
            try:
                saved = getattr(node, name)
            except RuntimeError:
                return True
            if isinstance(saved[0] if isinstance(saved, tuple) and saved else saved, Tensor):
                return False
        nodes += [before for before, _ in node.next_functions if before not in nodes]
    return False


def leaves_of(t: Tensor) -> list[Tensor]:
    """The tensors whose gradients a backward pass from t computes. Nothing public tells."""
    nodes, seen, leaves = [t.grad_fn], set(), []
    for node in nodes:  # which grows
        if node is None or node in seen:
            continue
        seen.add(node)
        if isinstance(leaf := getattr(node, "variable", None), Tensor):
            leaves.append(leaf)
        nodes += [before for before, _ in node.next_functions]
    return leaves


def calls_have_hooks(module: torch.nn.Module) -> bool:
    """Whether a call of the module runs hooks, its own or those of all modules, beside its forward."""
    places: tuple[Mapping[int, object], ...] = (
        module._forward_hooks,
        module._forward_pre_hooks,
        module._backward_hooks,
        module._backward_pre_hooks,
        torch.nn.modules.module._global_forward_hooks,
        torch.nn.modules.module._global_forward_pre_hooks,
        torch.nn.modules.module._global_backward_hooks,
        torch.nn.modules.module._global_backward_pre_hooks,
    )
    return any(len(hooks) > 0 for hooks in places)


class HearsOfMoves(torch.nn.Module):
    """A module that is told when `to`, `half` and the like have given it new tensors: they all call `_apply`, and
    modules have no public hook for that."""

    def _moved(self, move: Callable[[Tensor], Tensor]) -> None:
        """Called when this module has new tensors, with what made them of the old ones."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self._moved(fn)
        return self


def is_made_by(t: Tensor, node: str) -> bool:
    """Whether a node of this name is in the graph of t. Its name is torch's own."""
    seen, nodes = set(), [t.grad_fn]
    while nodes:
        here = nodes.pop()
        if here is None or here in seen:
            continue
        if here.name() == node:
            return True
        seen.add(here)
        nodes += [before for before, _ in here.next_functions]
    return False
