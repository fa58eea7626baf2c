"""Kernels of a GPU: compiled when they are first needed, or before."""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from prdp_torch import _C, _check
from prdp_torch.torch_private import leaves_of


def warm_up(step: Callable[[Tensor], Any], example: Tensor, backward: bool = True) -> list[str]:
    """Compile and load the kernels that `step(example)` needs, and those of its backward pass: of the gradients of the
    state and of every parameter that requires one.

    A kernel takes seconds to compile when it is first needed, and milliseconds to load in later processes. Call this
    before a clock starts, and before a CUDA graph is captured: meanwhile nothing can be compiled. `step` is run once;
    gradients that are there stay as they are.

    Args:
        step: a step such as `prdp.Heat`, or any function of a state. It returns a tensor, or several.
        example: a state with the shape, dtype and device that the step will be called with.
        backward: whether gradients will be taken.

    Returns:
        The kernels that were made, such as "CG of Stencil<float, Grid<1, 64, 64>, …>"; none on the CPU, and none that
        this process had made before.
    """
    _check.dense("warm_up", "example", example)
    before = set(_C.kernels_made())
    state = example.detach().clone().requires_grad_(backward)
    with torch.enable_grad() if backward else torch.no_grad():
        results = [u for u in tensors_in(step(state)) if backward and u.requires_grad]
        parameters = list({leaf for u in results for leaf in leaves_of(u)} - {state})
        # Kernels differ by what a gradient is asked of.
        passes = [[state], parameters, [state, *parameters]] if parameters else [[state]]
        ones = [torch.ones_like(u) for u in results]
        for wanted in passes if results else []:
            more = wanted is not passes[-1]
            torch.autograd.grad(results, wanted, ones, retain_graph=more, allow_unused=True)
    return [name for name in _C.kernels_made() if name not in before]


def tensors_in(found: Any) -> Iterator[Tensor]:
    """The tensors of what a step returns: one, or several in tuples, lists and dicts, among whatever else."""
    if isinstance(found, Tensor):
        yield found
    elif isinstance(found, tuple | list | dict):
        for part in found.values() if isinstance(found, dict) else found:
            yield from tensors_in(part)
