"""The base of all operators, and what several of them need."""

import functools
import inspect
import math
import weakref
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor

from prdp_torch import _C, _check, torch_private
from prdp_torch.types import NullSpace, Number

# What the compiled library reads.
DESCRIPTION = ("kind", "shape", "parameters", "tensors")


class Operator:
    """The base of all operators. `kind`, `shape`, `parameters` and `tensors` describe it to the compiled library.

    The tensors are those that its user gave, and `names` their arguments; a number has no name."""

    kind: str
    shape: list[int]
    parameters: list[float]
    tensors: list[Tensor]
    names: list[str | None]
    stands_for: "Operator | None" = None  # the constant operator of a step, in a call with other tensors

    def __init__(
        self,
        shape: list[int],
        parameters: list[float],
        given: Mapping[str, Number],
        null_spaces: tuple[Tensor, ...] = (),
    ) -> None:
        who = type(self).__name__
        self.shape = shape
        self.parameters = parameters
        self._given = tuple(given)
        self.names = [name if isinstance(t, Tensor) else None for name, t in given.items()]
        self.tensors = [real_tensor(who, name, t) for name, t in given.items()]
        if null_spaces:
            self.kind = "singular_" + self.kind
            self.tensors += null_spaces
            self.names += _names_of(*null_spaces)
        # A Parameter is trained, so it stays what it is; the ops take it for float32 too.
        self.tensors = [t if isinstance(t, torch.nn.Parameter) else full_precision(t) for t in self.tensors]
        if not torch.compiler.is_compiling():
            _C.check_operator(self.kind, self.shape, self.parameters, [full_precision(t) for t in self.tensors])

    if not TYPE_CHECKING:

        def __setattr__(self, name: str, value: object) -> None:
            made = "tensors" in self.__dict__ and not torch.compiler.is_compiling()
            if made and name not in DESCRIPTION and name in _arguments(type(self)):
                raise AttributeError(f"{type(self).__name__}: {name} cannot be set later; make a new operator")
            super().__setattr__(name, value)

    def __repr__(self) -> str:
        of = {name: shown(t) for name, t in zip(self._given, self.tensors, strict=False)}
        of |= {name: str(value) for name, value in self._settings().items()}
        if self.kind.startswith("singular_"):
            of["nullspace"] = shown(self.tensors[-2])
        return f"{type(self).__name__}(shape={tuple(self.shape)}{''.join(f', {k}={v}' for k, v in of.items())})"

    def _settings(self) -> dict[str, object]:
        """What `parameters` say, by the names of their arguments."""
        return {}

    def of(self, tensors: Iterable[Tensor]) -> Self:
        """The same operator, made of other tensors."""
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        other.tensors = list(tensors)
        return other

    def explain_freed_graphs(self) -> None:
        """From now on, say in a second backward pass that reaches results of operations among the tensors why there is
        none: torch's own error names neither them nor what to do."""
        for name, t in zip(self.names, self.tensors, strict=True):
            if t.requires_grad and not t.is_leaf and not torch_private.transforms_are_active():
                t.register_hook(functools.partial(_refuse_freed, f"{type(self).__name__}: {name}", weakref.ref(t)))

    def apply(self, v: Tensor) -> Tensor:
        """Return A v, with gradients. v has the shape of a right-hand side. Where a null space is named, the product is
        without its part along the left one, also if that is wrong."""
        self._check_vector("apply", v)
        product: Tensor = torch.ops.prdp.apply(v, self.tensors, self.kind, self.shape, self.parameters, False)
        return product

    def apply_transpose(self, v: Tensor) -> Tensor:
        """Return Aᵀ v, with gradients."""
        self._check_vector("apply_transpose", v)
        product: Tensor = torch.ops.prdp.apply(v, self.tensors, self.kind, self.shape, self.parameters, True)
        return product

    def diagonal(self) -> Tensor:
        """Return the diagonal of A, in a shape that broadcasts against a batch of vectors."""
        diagonal: Tensor = torch.ops.prdp.diagonal(self.tensors, self.kind, self.shape, self.parameters)
        return diagonal

    def dense(self, dtype: torch.dtype = torch.float64) -> Tensor:
        """Return A as a matrix (n, n), or (batch, n, n) if it differs between samples, in float64 unless `dtype` says
        otherwise; with a null space that is named, the matrix of `apply`. Only for small n: ValueError if it would not
        fit into the memory of the machine."""
        self._check_dense_dtype(dtype)
        self._check_dense_fits(dtype)
        matrix: Tensor = torch.ops.prdp.dense(self.tensors, self.kind, self.shape, self.parameters, dtype)
        return matrix

    def _check_dense_dtype(self, dtype: object) -> None:
        if dtype not in (torch.float32, torch.float64):
            raise TypeError(f"{type(self).__name__}.dense: dtype must be torch.float32 or torch.float64, got {dtype!r}")

    def _check_vector(self, name: str, v: object) -> None:
        if not torch.compiler.is_compiling():
            _check.dense(f"{type(self).__name__}.{name}", "v", v)

    def _unknowns(self) -> int:
        """The length of a vector, in all its channels."""
        return math.prod(self.shape)

    def _check_dense_fits(self, dtype: torch.dtype) -> None:
        axes = _C.batched_axes(self.kind, len(self.shape), len(self.tensors))
        if axes is None:  # a Function, whose vectors may be of any length
            return
        batch = max((t.shape[0] for t, n in zip(self.tensors, axes, strict=True) if t.dim() == n > 0), default=1)
        n, there = self._unknowns(), _C.physical_memory()
        needed = 2 * batch * n * n * dtype.itemsize  # the columns, and the matrix
        if needed > there:
            raise ValueError(
                f"{type(self).__name__}: dense() of {n} unknowns would take {needed / 1e9:.3g} GB, and this machine "
                f"has {there / 1e9:.3g} GB; apply() needs no matrix"
            )


def shown(t: Tensor) -> str:
    """A tensor in a repr: a number as it is, "constant" for the basis that stands for it, and the shape of others."""
    if t.dim() == 0:
        return f"{t:.4g}"
    return f"tensor{tuple(t.shape)}" if t.numel() > 0 else "'constant'"


def _refuse_freed(what: str, made: weakref.ref[Tensor], _: Tensor) -> None:
    """A hook of a tensor."""
    t = made()
    if t is not None and torch_private.graph_is_freed(t):
        raise RuntimeError(
            f"{what} is a result of operations, whose graph an earlier backward pass has freed. Make the operator anew "
            "for each update; ImplicitStep takes a function of u that does so. Or call backward(retain_graph=True)"
        )


def real_tensor(who: str, name: str, value: Number) -> Tensor:
    """A number as the 0-dimensional tensor that the library takes; a tensor as it is."""
    if isinstance(value, Tensor):
        return value
    return kept_numbers(_check.real(who, name, value))


def kept_numbers(values: float | list[float]) -> Tensor:
    """A tensor in float64 on the CPU, under any default device; one to train with, even where it is made in inference
    mode."""
    if not torch.compiler.is_compiling() and torch.is_inference_mode_enabled():
        with torch.inference_mode(False):
            return torch.tensor(values, dtype=torch.float64, device="cpu")
    return torch.tensor(values, dtype=torch.float64, device="cpu")


@functools.cache
def _arguments(kind: type) -> frozenset[str]:
    """What an operator of the library is made of; it would not see a later change. Those of a user's own class are the
    user's."""
    return frozenset(inspect.signature(kind).parameters if kind.__module__.startswith("prdp_torch.") else ())


def full_precision(t: Tensor) -> Tensor:
    """float32 for float16 and bfloat16 under torch.autocast, as the solves take them there."""
    low = t.dtype in (torch.float16, torch.bfloat16) and torch.is_autocast_enabled(t.device.type)
    return t.float() if low else t


def without_autocast(t: Tensor) -> AbstractContextManager[object]:
    """Within it, torch's operations on the device of t compute in the dtypes that they are given."""
    device = t.device.type
    on = torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device)
    return torch.autocast(device, enabled=False) if on else nullcontext()


def null_spaces_of(who: str, right: NullSpace, left: NullSpace, like: Tensor | None) -> tuple[Tensor, ...]:
    """The two bases for the compiled library, an empty one for "constant"; none without a null space."""
    if right is None and left is None:
        return ()
    if right is None:
        raise ValueError(f"{who}: left_nullspace= stands beside nullspace=, which is missing")
    basis = _basis(who, "nullspace", right, like)
    return basis, basis if left is None or left is right else _basis(who, "left_nullspace", left, like)


def _names_of(right: Tensor, left: Tensor) -> list[str | None]:
    """The names of two bases; "constant" has none."""
    names = ["nullspace", "nullspace" if left is right else "left_nullspace"]
    return [name if basis.numel() > 0 else None for name, basis in zip(names, (right, left), strict=True)]


def _basis(who: str, name: str, value: NullSpace, like: Tensor | None) -> Tensor:
    if isinstance(value, str) and value == "constant":
        return torch.empty(0) if like is None else like.new_empty(0)
    if not isinstance(value, Tensor) or value.dim() == 0:
        raise TypeError(f"{who}: {name} must be None, 'constant' or a tensor (k, *shape), got {value!r:.80}")
    return _check.dense(who, name, value)
