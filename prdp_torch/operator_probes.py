"""What trials learn of a step's operator before they solve: whether it is symmetric or renewed, and a cotangent."""

import torch
from torch import Tensor

from prdp_torch import operators
from prdp_torch.flow import Flow
from prdp_torch.operators.matrix import as_operator
from prdp_torch.stepper import Stepper


def operator_of(step: Stepper, sample: Tensor) -> operators.Operator:
    return as_operator("advise", "operator(u)", step.operator(sample))


def is_renewed(step: Stepper, sample: Tensor, v: Tensor) -> bool:
    """Whether A depends on the state or is trained: whether its tensors have a gradient, or A v changes with u."""
    if isinstance(step, Flow):
        return False
    with torch.enable_grad():
        a = operator_of(step, sample)
    if any(t.requires_grad for t in a.tensors):
        return True
    with torch.no_grad():
        return not torch.equal(a.apply(v), operator_of(step, 0.99 * sample).apply(v))


def is_symmetric(step: Stepper, sample: Tensor, v: Tensor) -> bool:
    """Whether A v and Aᵀ v agree to rounding, entry by entry."""
    if isinstance(step, Flow):
        return True
    with torch.no_grad():
        a = operator_of(step, sample)
        product, transposed = a.apply(v), a.apply_transpose(v)
    return float((product - transposed).abs().max()) <= _rounding(product)


def random_cotangent(step: Stepper, sample: Tensor) -> Tensor:
    """Random, without the mean of a channel whose constants A maps to zero, such as a pressure."""
    c = torch.randn(sample.shape, generator=torch.Generator().manual_seed(0), dtype=sample.dtype).to(sample.device)
    if isinstance(step, Flow):
        return c
    with torch.no_grad():
        a = operator_of(step, sample)
        rounding = _rounding(a.apply(c))
        for channel in range(c.shape[1]) if c.dim() > 2 else (slice(None),):
            constant = torch.zeros_like(c)
            constant[:, channel] = 1.0
            if float(a.apply(constant).abs().max()) <= rounding:
                part = c[:, channel]
                part -= part.flatten(1).mean(1).view(-1, *[1] * (part.dim() - 1))
    return c


def _rounding(v: Tensor) -> float:
    return 100 * torch.finfo(v.dtype).eps * float(v.abs().max())
