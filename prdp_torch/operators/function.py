"""Products given by Python functions."""

import copy
import functools
import inspect
import types
import weakref
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import torch
from torch import Tensor

from prdp_torch import _C, _check, batching
from prdp_torch.closures import warn_of_shared
from prdp_torch.operators.base import Operator, null_spaces_of, shown
from prdp_torch.types import NullSpace

Product: TypeAlias = Callable[..., Tensor]
"""`product(v, *tensors)`, a vector of the shape of v."""


class Function(Operator):
    """An operator of your own, given by a function for its product with a batch of vectors (batch, ...).

    Args:
        matvec: `matvec(v, *tensors)` returns A v as a new tensor with the shape and dtype of v. It is made of torch
            operations, which may differentiate (a product with a Hessian or a Jacobian), and linear in v; constants
            belong to b. Samples may differ only through `tensors`.
        transpose: the same for Aᵀ v. None takes torch's own derivative of matvec.
        tensors: what A is made of, a tuple of tensors or a single one. They get gradients. A tensor that requires
            grad and reaches matvec in another way is refused.
        diagonal: `diagonal(*tensors)` returns the diagonal of A in a shape that broadcasts against the vectors.
            `Jacobi` and `preconditioner="diagonal"` need it.
        symmetric: whether A = Aᵀ. Then matvec is used for both.
        nullspace, left_nullspace: as for `Stencil`: vectors have the shape of a channel of b (batch, channel, *shape),
            for each channel, or that of all its channels, such as a pressure alone among other fields. If b has two
            axes, they have that of b without its batch axis.

    `Direct` multiplies A with unit vectors, so it is for small systems. Call `prdp.check_operator` once to compare
    the functions with each other. On the CPU, the first solve refuses a product that is far from linear, the 1st, 2nd,
    4th, 8th, … one that mixes samples, and the backward pass warns where ⟨λ, A u⟩ and ⟨Aᵀ λ, u⟩ differ. Create a
    `Function` outside `torch.compile`: inside, it breaks the graph.
    """

    kind = "function"

    def __init__(
        self,
        matvec: Product,
        transpose: Product | None = None,
        tensors: Tensor | Sequence[Tensor] = (),
        diagonal: Callable[..., Tensor] | None = None,
        symmetric: bool = False,
        nullspace: NullSpace = None,
        left_nullspace: NullSpace = None,
    ) -> None:
        for name, function in (("matvec", matvec), ("transpose", transpose), ("diagonal", diagonal)):
            if not callable(function) and (name == "matvec" or function is not None):
                raise TypeError(f"Function: {name} must be callable, got {_check.shown(function)}")
        if symmetric and transpose is not None:
            raise ValueError("Function: with symmetric=True matvec is its own transpose; give only one of the two")
        if isinstance(tensors, torch.Tensor):
            tensors = (tensors,)
        if not isinstance(tensors, (tuple, list)):
            raise TypeError(f"Function: tensors must be a tuple of tensors, got {tensors!r}")
        tensors = [_check.dense("Function", "every tensor", t) for t in tensors]
        self._made_of = matvec, transpose, diagonal, symmetric
        product = _returning_a_tensor("matvec", matvec)
        self._products = _C.RegisteredProducts(
            product,
            product if symmetric else None if transpose is None else _returning_a_tensor("transpose", transpose),
            None if diagonal is None else lambda given: _tensor("diagonal", diagonal(*given)),
            lambda v, given: batching.transposed(matvec, v, given),
            lambda cotangent, u, given: batching.product_rule(matvec, cotangent, u, given),
            _shared_code(matvec, transpose),
        )
        null_spaces = null_spaces_of("Function", nullspace, left_nullspace, None)
        given = {f"tensors_{i}": t for i, t in enumerate(tensors)}
        super().__init__([self._products.number], [], given, null_spaces)

    if not TYPE_CHECKING:

        @property
        def shape(self) -> list[int]:
            """The number of its products, kept as text: torch.compile would take one that changes for a size."""
            return [int(self._number)]

        @shape.setter
        def shape(self, shape: list[int]) -> None:
            self._number = str(shape[0])

    def __repr__(self) -> str:
        name = getattr(self._made_of[0], "__name__", type(self._made_of[0]).__name__)
        return f"Function({name}, tensors=[{', '.join(map(shown, self.tensors))}])"

    def __deepcopy__(self, memo: dict[int, Any]) -> "Function":
        warn_of_shared("Function", self._made_of[:3], memo)
        made, arguments = self.__reduce__()
        function: Function = made(*copy.deepcopy(arguments, memo))
        return function

    def __reduce__(self) -> tuple[Any, ...]:
        matvec, transpose, diagonal, symmetric = self._made_of
        if self.kind == "function":
            return Function, (matvec, transpose, tuple(self.tensors), diagonal, symmetric)
        *tensors, right, left = self.tensors
        return Function, (matvec, transpose, tuple(tensors), diagonal, symmetric, right, left)


_Codes: TypeAlias = "weakref.WeakKeyDictionary[Any, _C.FunctionCode]"
_CODES: "weakref.WeakKeyDictionary[Any, _Codes]" = weakref.WeakKeyDictionary()  # by matvec, then by transpose


def _code(function: Any) -> Any:
    """What all functions with the same text have in common; of a callable object, the object."""
    while isinstance(function, functools.partial):
        function = function.func
    function = inspect.unwrap(function)
    code = getattr(getattr(function, "__func__", function), "__code__", None)
    return code if isinstance(code, types.CodeType) else function


def _shared_code(matvec: Product, transpose: Product | None) -> _C.FunctionCode:
    """One for all operators that are made of the same code, as those of a step that makes its operator anew."""
    try:
        of_matvec = _CODES.setdefault(_code(matvec), weakref.WeakKeyDictionary())
        return of_matvec.setdefault(_code(_shared_code if transpose is None else transpose), _C.FunctionCode())
    except (TypeError, ValueError):  # neither code nor an object that can be referred to weakly
        return _C.FunctionCode()


def _tensor(name: str, value: object) -> Tensor:
    if isinstance(value, torch.Tensor):
        return value
    raise TypeError(f"Function: {name} must return a torch tensor, got {type(value).__name__}")


def _returning_a_tensor(name: str, function: Product) -> Callable[[Tensor, list[Tensor]], Tensor]:
    """A product as the compiled library calls it."""
    return lambda v, given: _tensor(name, function(v, *given))
