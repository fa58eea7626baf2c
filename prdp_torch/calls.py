"""How the calls of steppers and controllers are wrapped: what an error leaves behind, and what graphs may hold."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

from prdp_torch import torch_private

P = ParamSpec("P")
T = TypeVar("T")


def forgets_if_it_raises(step: Callable[P, T]) -> Callable[P, T]:
    """A step that raises has no report, and leaves none of an earlier one. Until then, other threads read theirs."""

    @functools.wraps(step)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        if torch.compiler.is_compiling():
            return step(*args, **kwargs)
        try:
            return step(*args, **kwargs)
        except BaseException as error:
            if not torch_private.is_end_of_recomputation(error):
                vars(args[0])["info"] = None
            raise

    return call


def between_graphs(call: Callable[P, T]) -> Callable[P, T]:
    """What torch.compile calls as it is, with a break of the graph; with fullgraph=True the reason is said."""
    reason = f"{call.__qualname__} of prdp_torch is called between graphs, not traced: compile without fullgraph=True"
    return torch_private.disabled_once_imported(call, reason)


def not_in_graphs(call: Callable[P, T]) -> Callable[P, T]:
    """What looks at values, so that no graph can hold it: torch.compile calls it between graphs, torch.export is told
    in words."""

    @functools.wraps(call)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        if torch.compiler.is_exporting():
            raise NotImplementedError(
                f"{call.__qualname__}: torch.export cannot hold a step of Flow, which looks at values; export the "
                "network alone, or an ImplicitStep"
            )
        return call(*args, **kwargs)

    return between_graphs(checked)
