"""Kernels of a GPU: compiled when they are first needed, or before."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from prdp_torch import _C
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
    before = set(_C.kernels_made())
    state = example.detach().clone().requires_grad_(backward)
    with torch.enable_grad() if backward else torch.no_grad():
        found = step(state)
        results = [u for u in ([found] if isinstance(found, Tensor) else found) if u.requires_grad]
        parameters = list({leaf for u in results for leaf in leaves_of(u)} - {state})
        for wanted in ([state], parameters, [state, *parameters]):  # kernels differ by what a gradient is asked of
            if results and wanted:
                ones = [torch.ones_like(u) for u in results]
                torch.autograd.grad(results, wanted, ones, retain_graph=True, allow_unused=True)
    return [name for name in _C.kernels_made() if name not in before]
