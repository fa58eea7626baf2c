"""Matrices, and what else is taken for an operator."""

from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor

from prdp_torch import _C, _check, torch_private
from prdp_torch.operators.base import Operator, full_precision, null_spaces_of
from prdp_torch.types import NullSpace


class Matrix(Operator):
    """A matrix: a tensor (n, n) or (batch, n, n), dense or sparse CSR. A sparse one gets gradients on its pattern; if
    you need them, use `Matrix.csr`, because torch may make the gradient of a CSR tensor dense.

    `nullspace` and `left_nullspace` are those of `Stencil`: "constant" or vectors (k, n), or (batch, k, n)."""

    is_sparse_parameter = False

    def __init__(self, matrix: Tensor, nullspace: NullSpace = None, left_nullspace: NullSpace = None) -> None:
        if not isinstance(matrix, torch.Tensor):
            raise TypeError(f"Matrix: expected a torch tensor, got {type(matrix).__name__}")
        if matrix.layout == torch.sparse_csr:
            self.kind: str = "csr"
            with torch_private.without_transforms():
                given = {"crow": matrix.crow_indices(), "col": matrix.col_indices(), "values": matrix.values()}
            self.is_sparse_parameter = isinstance(matrix, torch.nn.Parameter)
        elif matrix.layout == torch.strided:
            self.kind = "dense"
            given = {"matrix": matrix}
        else:
            raise ValueError(
                f"linear_solve: A must be a dense or sparse CSR tensor, got {matrix.layout}; take A.to_sparse_csr()"
            )
        if matrix.dim() not in (2, 3) or matrix.shape[-1] != matrix.shape[-2]:
            hint = "; if it is a field, give an operator that is made of it, such as Diffusion" * (matrix.dim() > 3)
            raise ValueError(
                f"linear_solve: A must have shape (n, n) or (batch, n, n), got {tuple(matrix.shape)}{hint}"
            )
        if self.kind == "csr" and given["crow"].shape[-1] != matrix.shape[-1] + 1:
            raise ValueError(
                f"linear_solve: a CSR matrix of {matrix.shape[-1]} rows needs a crow of one more, got "
                f"{given['crow'].shape[-1]}"
            )
        like = given["values" if self.kind == "csr" else "matrix"]
        super().__init__([], [], given, null_spaces_of("Matrix", nullspace, left_nullspace, like))
        if self.kind == "csr":
            _check_csr_gradient(matrix, given["crow"], given["col"])

    def apply(self, v: Tensor) -> Tensor:
        """Return A v, with gradients. v: (batch, n), or (n,)."""
        return super().apply(v.unsqueeze(0)).squeeze(0) if _is_lone(v) else super().apply(v)

    def apply_transpose(self, v: Tensor) -> Tensor:
        """Return Aᵀ v, with gradients. v: (batch, n), or (n,)."""
        return super().apply_transpose(v.unsqueeze(0)).squeeze(0) if _is_lone(v) else super().apply_transpose(v)

    def dense(self, dtype: torch.dtype = torch.float64) -> Tensor:
        """Return A as a matrix (n, n), or (batch, n, n) if it differs between samples."""
        self._check_dense_dtype(dtype)
        converted = self.of([t.to(dtype) if t.is_floating_point() else t for t in self.tensors])
        return Operator.dense(converted, dtype)

    def __repr__(self) -> str:
        values = self.tensors[2] if self.kind.endswith("csr") else self.tensors[0]
        of_one = values.dim() == 1 + (not self.kind.endswith("csr"))
        samples = "" if of_one else f"batch={values.shape[0]}, "
        stored = f"{values.shape[-1]} entries" if self.kind.endswith("csr") else "dense"
        n = self._unknowns()
        return f"Matrix({samples}{n} × {n}, {stored}, {values.dtype})"

    def _unknowns(self) -> int:
        return self.tensors[0].shape[-1] - self.kind.endswith("csr")

    @classmethod
    def csr(
        cls,
        crow: Tensor,
        col: Tensor,
        values: Tensor,
        size: int | Sequence[int],
        nullspace: NullSpace = None,
        left_nullspace: NullSpace = None,
    ) -> Self:
        """A sparse matrix by its compressed rows, as `torch.sparse_csr_tensor` takes them.

        Args:
            crow: (n + 1,) whole numbers, where each row starts in col and values.
            col: (nnz,) whole numbers, the column of each stored entry.
            values: (nnz,), or (batch, nnz) for a matrix per sample on one pattern; float32 or float64. The
                gradient arrives here, in this shape.
            size: (n, n) or n; (batch, n, n) with values (batch, nnz).
            nullspace, left_nullspace: "constant" or vectors (k, n), or (batch, k, n), as for `Stencil`.

        Raises TypeError or ValueError where the shapes do not fit each other.
        """
        for name, tensor in (("crow", crow), ("col", col)):
            if _check.dense("Matrix.csr", name, tensor).dtype not in (torch.int32, torch.int64):
                raise TypeError(f"Matrix.csr: {name} must hold whole numbers (int32 or int64), got {tensor.dtype}")
        if full_precision(_check.dense("Matrix.csr", "values", values)).dtype not in (torch.float32, torch.float64):
            raise TypeError(f"Matrix.csr: values must be float32 or float64, got {values.dtype}")
        if not isinstance(size, (tuple, list)):
            size = (_check.whole("Matrix.csr", "size", size),) * 2
        size = tuple(_check.whole("Matrix.csr", "every extent of size", n) for n in size)
        batch = values.shape[:-1]
        is_square = len(size) in (2, 3) and size[-2] == size[-1] > 0
        if values.dim() not in (1, 2) or not is_square or size[:-2] not in ((), batch):
            raise ValueError(
                "Matrix.csr: size must be (n, n), or (batch, n, n) with values of shape (batch, nnz), "
                f"got {size} with values of shape {tuple(values.shape)}"
            )
        n = size[-1]
        for name, tensor, length in (("crow", crow, n + 1), ("col", col, values.shape[-1])):
            if tensor.shape not in ((length,), (*batch, length)):
                raise ValueError(f"Matrix.csr: {name} must have shape ({length},), got {tuple(tensor.shape)}")
        made = cls.__new__(cls)
        made.kind = "csr"
        null_spaces = null_spaces_of("Matrix.csr", nullspace, left_nullspace, values)
        Operator.__init__(made, [], [], {"crow": crow, "col": col, "values": values}, null_spaces)
        return made


def _is_lone(v: object) -> bool:
    """Whether it is a vector without an axis for the batch; what it is at all, the product checks."""
    return isinstance(v, Tensor) and v.dim() < 2


def _has_sorted_columns(crow: Tensor, col: Tensor) -> bool:
    """Whether the columns of each row increase, (n + 1,) and (nnz,) or a batch of them."""
    n = crow.shape[-1] - 1
    if col.is_meta or col.numel() == 0:
        return True
    for pointers, columns in zip(crow.view(-1, n + 1), col.view(-1, col.shape[-1]), strict=True):
        rows = torch.arange(n, device=crow.device).repeat_interleave(pointers.diff())
        if not bool(((rows * n + columns).diff() > 0).all()):
            return False
    return True


_warned_of_csr_gradient = False


def _check_csr_gradient(matrix: Tensor, crow: Tensor, col: Tensor) -> None:
    """Refuse a sparse tensor whose gradient torch gets wrong, and warn once of one that it may make dense."""
    global _warned_of_csr_gradient
    if not matrix.requires_grad or not torch.is_grad_enabled() or torch.compiler.is_compiling():
        return
    # Of a CSR tensor that is a leaf, torch gets it right, and of what is computed from it.
    is_wrong = matrix.grad_fn is not None and not _has_sorted_columns(crow, col)
    if is_wrong and torch_private.is_made_by(matrix, "SparseCompressedTensorBackward0"):
        raise ValueError(
            "linear_solve: torch gives the gradient of this sparse CSR tensor to the wrong values, as the columns of a "
            "row are not sorted, or repeat; take operators.Matrix.csr(crow, col, values, size), or sort them"
        )
    if not _warned_of_csr_gradient:
        _warned_of_csr_gradient = True
        _C.warn(
            "linear_solve: the gradient of a sparse CSR tensor passes through torch, which may make it dense; "
            "operators.Matrix.csr(crow, col, values, size) takes it to the values directly"
        )


def as_operator(who: str, name: str, value: object) -> Operator:
    """An operator as it is, a tensor as a `Matrix`; TypeError for all else."""
    if isinstance(value, Operator):
        return value
    if isinstance(value, torch.Tensor):
        return Matrix(value)
    raise TypeError(f"{who}: {name} must be an operator of prdp_torch.operators, got {value!r:.80}{hint_for(value)}")


def hint_for(value: object) -> str:
    """What to give in place of a stepper, or of a function, that was given for an operator; else empty."""
    if hasattr(value, "rollout"):
        return ", which is a stepper" + (f"; see operators.{type(value).__name__}" if hasattr(value, "kind") else "")
    return "; a product A v in a function is operators.Function(matvec)" if callable(value) else ""
