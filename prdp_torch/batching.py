"""The batching rules of the library's ops: what torch.func.vmap makes of a solve.

A mapped axis is folded into the batch, as samples do not influence each other. Where all samples share a
tensor that is mapped, such as a matrix, the entries are solved one after the other. Where no tensor of A is mapped,
each sample has an A of its own, and there are no more samples than entries, one sample is solved after the other: what
is made of an A, such as its factors, serves all its right-hand sides.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol, cast

import torch
from torch import Tensor

from prdp_torch import _C, torch_private
from prdp_torch.solvers import packed_options
from prdp_torch.types import Report

_COUNTS = len(packed_options("", 0, 0.0, 0, None)[1])  # of a solve without a preconditioner


class _Map(Protocol):
    """What torch tells a batching rule beside the mapped axes."""

    batch_size: int


def _linear_solve(
    info: _Map,
    in_dims: Sequence[Any],
    b: Tensor,
    tensors: list[Tensor],
    kind: str,
    shape: list[int],
    parameters: list[float],
    transposed: bool,
    x0: Tensor | None,
    names: list[str],
    counts: list[int],
    numbers: list[float],
    inverse: list[Tensor],
) -> tuple[Any, Any]:
    size, op = info.batch_size, torch.ops.prdp.linear_solve
    dim_of_b, dims_of_tensors, *_, dim_of_x0, _, _, _, dims_of_inverse = in_dims
    samples = b.shape[0 if dim_of_b is None else int(dim_of_b == 0)]

    def entries(t: Tensor | None, dim: int | None) -> Tensor | None:  # the mapped axis in front
        return t if t is None else t.expand(size, *t.shape) if dim is None else t.movedim(dim, 0)

    def solved(b: Tensor, tensors: list[Tensor], x0: Tensor | None, inverse: list[Tensor]) -> Any:
        return op(b, tensors, kind, shape, parameters, transposed, x0, names, counts, numbers, inverse)

    of_b, of_x0 = cast(Tensor, entries(b, dim_of_b)), entries(x0, dim_of_x0)
    mapped = [dim is not None for dim in dims_of_tensors]
    own = _of_samples(tensors, kind, len(shape), samples)
    if not any(mapped) and any(own) and not inverse and 0 < samples <= size:
        found = []
        for s in range(samples):
            of_one = [t[s : s + 1] if is_own else t for t, is_own in zip(tensors, own, strict=True)]
            found.append(solved(of_b[:, s], of_one, None if of_x0 is None else of_x0[:, s], inverse))
        return [torch.stack(parts, 1) for parts in zip(*found, strict=True)], [0] * len(found[0])
    folded = _fold(tensors, dims_of_tensors, kind, len(shape), size, samples, b)
    # A preconditioner, whose kind is the last of the names and whose shape is behind the counts.
    axes = len(counts) - _COUNTS
    folded_inverse = _fold(inverse, dims_of_inverse, names[-1], axes, size, samples, b) if inverse else []
    if folded is None or folded_inverse is None:
        arguments = b, tensors, kind, shape, parameters, transposed, x0, names, counts, numbers, inverse
        return _one_by_one(op, info, in_dims, arguments)
    results = solved(of_b.flatten(0, 1), folded, None if of_x0 is None else of_x0.flatten(0, 1), folded_inverse)
    return [t.unflatten(0, (size, samples)) for t in results], [0] * len(results)


def _of_samples(tensors: list[Tensor], kind: str, axes: int, batch: int) -> list[bool]:
    """Which tensors of an operator hold a part for each sample of the batch."""
    dims = _C.batched_axes(kind, axes, len(tensors)) or [0] * len(tensors)
    return [n > 0 and t.dim() == n and t.shape[0] == batch for t, n in zip(tensors, dims, strict=True)]


def _fold(
    tensors: list[Tensor], in_dims: Sequence[int | None], kind: str, axes: int, size: int, batch: int, like: Tensor
) -> list[Tensor] | None:
    """The tensors of an operator on `size` · `batch` samples like `like`; None where there is no such operator."""
    tensors = [t if dim is None else t.movedim(dim, 0) for t, dim in zip(tensors, in_dims, strict=True)]
    mapped = [dim is not None for dim in in_dims]
    dims = _C.batched_axes(kind, axes, len(tensors))
    if dims is None:  # a Function: unknown which of its tensors have a batch axis
        return None if tensors else []
    folded = []
    for t, is_mapped, n in zip(tensors, mapped, dims, strict=True):
        if batch == 1 and any(mapped) and n == t.dim() - is_mapped + 1 and n > 1:
            t = t.unsqueeze(int(is_mapped))  # has no batch axis: it is that of the only sample
        of_samples = t.dim() - is_mapped == n and n > 0
        if is_mapped:
            if n == 1 and t.dim() == 1:  # a number for all, such as nu, becomes one for each
                t, of_samples = t[:, None].expand(size, batch), True
            if not of_samples or t.shape[1] != batch or (n == 1 and t.dtype != like.dtype):
                return None
            folded.append(t.flatten(0, 1))
        elif of_samples and t.shape[0] == batch:
            folded.append(t.expand(size, *t.shape).flatten(0, 1))
        else:
            folded.append(t)
    return folded


def _one_by_one(
    op: Callable[..., Any], info: _Map, in_dims: Sequence[Any], arguments: Sequence[Any]
) -> tuple[Any, Any]:
    """The op for one entry after the other; its results with the mapped axis in front."""

    def pick(argument: Any, dim: Any, i: int) -> Any:
        if isinstance(dim, (list, tuple)):
            return [pick(*pair, i) for pair in zip(argument, dim, strict=True)]
        return argument if dim is None else argument.select(dim, i)

    if info.batch_size == 0:
        return _no_entries(op, in_dims, arguments)
    return _stacked([op(*pick(arguments, in_dims, i)) for i in range(info.batch_size)])


def _stacked(results: Sequence[Any]) -> tuple[Any, Any]:
    """Results of several calls, each a tensor or a list of results, stacked; and 0 for each, the mapped axis."""
    if isinstance(results[0], torch.Tensor):
        return torch.stack(list(results)), 0
    parts = [_stacked(part) for part in zip(*results, strict=True)]
    return [stacked for stacked, _ in parts], [axes for _, axes in parts]


def _no_entries(op: Callable[..., Any], in_dims: Sequence[Any], arguments: Sequence[Any]) -> tuple[Any, Any]:
    """What one after the other gives where the mapped axis is empty: tensors without memory tell its shapes."""
    devices = []

    def without_memory(argument: Any, dim: Any) -> Any:
        if isinstance(dim, (list, tuple)):
            return [without_memory(*pair) for pair in zip(argument, dim, strict=True)]
        if not isinstance(argument, torch.Tensor):
            return argument
        devices.append(argument.device)
        shape = [n for axis, n in enumerate(argument.shape) if axis != dim]
        return argument.new_empty(shape, device="meta")

    def empty(one: Any) -> Any:
        if isinstance(one, torch.Tensor):
            return one.new_empty((0, *one.shape), device=devices[0])
        return [empty(part) for part in one]

    _, axes = _stacked([one := op(*without_memory(arguments, in_dims))])
    return empty(one), axes


def _loop(op: Callable[..., Any]) -> Callable[..., tuple[Any, Any]]:
    """The batching rule of a derivative that sums over the batch: it cannot be folded."""
    return lambda info, in_dims, *arguments: _one_by_one(op, info, in_dims, arguments)


torch.library.register_vmap("prdp::linear_solve", _linear_solve)
torch.library.register_vmap("prdp::unrolled_vjp", _loop(torch.ops.prdp.unrolled_vjp))
torch.library.register_vmap("prdp::unrolled_jvp", _loop(torch.ops.prdp.unrolled_jvp))


def transposed(matvec: Callable[..., Tensor], v: Tensor, tensors: list[Tensor]) -> Tensor:
    """Aᵀ v by torch.func: A is linear, so its derivative is the same everywhere."""
    pullback = torch.func.vjp(lambda x: matvec(x, *tensors), torch.zeros_like(v))[1]
    product: Tensor = pullback(v)[0]
    return product


def product_rule(matvec: Callable[..., Tensor], cotangent: Tensor, u: Tensor, tensors: list[Tensor]) -> list[Tensor]:
    """∂⟨λ, A u⟩ with respect to each tensor of A by torch.func; zeros for those of whole numbers."""
    wanted = [i for i, t in enumerate(tensors) if t.is_floating_point() or t.is_complex()]

    def product(*changed: Tensor) -> Tensor:
        given = list(tensors)
        for i, t in zip(wanted, changed, strict=True):
            given[i] = t
        return matvec(u, *given)

    pullback = torch.func.vjp(product, *[tensors[i] for i in wanted])[1]
    gradients = dict(zip(wanted, pullback(cotangent), strict=True))
    return [gradients[i] if i in gradients else torch.zeros_like(t) for i, t in enumerate(tensors)]


def outlive_transforms(report: Report) -> Report | None:
    """A report without the wrappers of the transforms that run, which must not leave them; the axes that are
    mapped come first. None in a compiled function, which cannot take the wrappers off."""
    if not torch_private.transforms_are_active():
        return report
    if torch.compiler.is_compiling():
        return None
    return cast(Report, tuple(torch_private.unwrapped(t) for t in report))
