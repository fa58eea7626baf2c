"""`check_operator`: whether an operator's parts agree with each other."""

import math
from collections.abc import Callable, Iterator
from typing import Literal

import torch
from torch import Generator, Tensor

from prdp_torch import _C, _check
from prdp_torch.operators import Function, Operator, Stencil
from prdp_torch.operators.base import full_precision, without_autocast
from prdp_torch.operators.matrix import Matrix, as_operator
from prdp_torch.solve import linear_solve
from prdp_torch.solvers import CG, GMRES, MINRES, Solver

_UNIT_VECTORS = 256
_LANCZOS_STEPS = 64  # of larger operators
_SAMPLES = 4  # whose singular values are looked at


def check_operator(A: Operator | Tensor, example: Tensor, solver: Solver | None = None) -> Literal[True]:
    """Check that the parts of an operator fit each other and a solver. It takes any operator; `operators.Function`
    needs it most.

    Args:
        A: an operator of `prdp_torch.operators`, or a tensor as `linear_solve` takes it.
        example: a right-hand side (batch, ...), or (n,) of a matrix, in float32 or float64, of which only shape and
            dtype are used. In float64 the comparison is sharp; in float32 it finds only large mistakes.
        solver: one that A, and a preconditioner of your own, are to fit, such as `CG(10, preconditioner=M)`.

    It checks that:

    - A is linear, and samples do not influence each other;
    - every tensor that requires grad is among the tensors of the operator;
    - ⟨A v, w⟩ = ⟨v, Aᵀ w⟩;
    - the diagonal, if there is one, agrees with products with unit vectors (at most 256 of them);
    - no row of A is zero, unless a `nullspace` is named;
    - A maps its `nullspace` to zero, and A and Aᵀ the constant only if it is named; in float64, and of at most
      256 unknowns, A maps no other vector to zero;
    - the gradient of ⟨w, A v⟩ for each tensor agrees with finite differences in one random direction;
    - for `CG` and `MINRES` A is symmetric, and for `CG` definite, as far as 64 Lanczos steps tell where A has more than
      256 rows;
    - an operator that preconditions is linear and fits its transpose; for `CG` it is symmetric and definite, for
      `MINRES` positive definite.

    Returns:
        True.

    Raises:
        ValueError: lists what is wrong.

    Examples:
        >>> A = prdp.operators.Function(lambda v, k: k * v, tensors=torch.rand(30, dtype=torch.float64))
        >>> prdp.check_operator(A, torch.zeros(2, 30, dtype=torch.float64))
        True
    """
    who = "check_operator"
    A = as_operator(who, "A", A)
    if _check.dense(who, "example", example).dim() == 1 and isinstance(A, Matrix):
        example = example.unsqueeze(0)  # one vector, as linear_solve takes it
    if example.dim() < 2:
        raise ValueError(f"{who}: example must have shape (batch, ...), got {tuple(example.shape)}")
    if not example.is_floating_point():
        raise TypeError(f"{who}: example must be float32 or float64, got {example.dtype}")
    if solver is not None and not isinstance(solver, Solver):
        raise TypeError(f"{who}: solver must be a Solver such as CG(10), got {_check.shown(solver)}")
    A, example = A.of(map(full_precision, A.tensors)), full_precision(example)
    generator = Generator().manual_seed(0)
    v, w = (_noise(example, generator) for _ in range(2))
    with torch.no_grad(), without_autocast(example):
        if A.kind == "diffusion":  # a solve refuses in words what a product answers with NaN
            linear_solve(A, v, GMRES(0), backward="none")
        wrong = [
            *_products(A, v, w),
            *_null_space(A, v),
            *_captures(A, v),
            *_diagonal(A, v),
            *_gradients(A, v, w, generator),
            *_fits(A, solver, A, v, w),
            *_preconditioner(A, solver, v, w),
        ]
    if wrong:
        raise ValueError(f"{who}: {type(A).__name__}: " + "; ".join(wrong))
    return True


def _noise(like: Tensor, generator: Generator) -> Tensor:
    return torch.randn(like.shape, generator=generator, dtype=like.dtype).to(like.device)


def _dot(v: Tensor, w: Tensor) -> Tensor:
    """One product per sample."""
    return (v * w).flatten(1).sum(1)


def _norm(v: Tensor) -> Tensor:
    norm: Tensor = v.flatten(1).norm(dim=1)
    return norm


def _products(A: Operator, v: Tensor, w: Tensor, name: str = "A") -> Iterator[str]:
    rounding = 1e3 * torch.finfo(v.dtype).eps
    av, aw, atw = A.apply(v), A.apply(w), A.apply_transpose(w)
    scale = _norm(av) + _norm(aw)
    if (_norm(A.apply(2 * v + w) - (2 * av + aw)) > rounding * scale).any():
        yield f"{name} is not linear: {name} (2 v + w) differs from 2 {name} v + {name} w"
    left, right = _dot(av, w), _dot(v, atw)
    bound = rounding * (_norm(av) * _norm(w) + _norm(v) * _norm(atw))
    if ((left - right).abs() > bound).any():
        worst = (left - right).abs().argmax()
        at = f"<{name} v, w> = {left[worst]:.6g} but <v, {name}^T w> = {right[worst]:.6g}"
        yield f"the transpose{'' if name == 'A' else f' of {name}'} is wrong: {at}"
    if len(v) > 1:
        other = v.clone()
        other[0] = w[0]
        if (_norm(A.apply(other) - av)[1:] > rounding * scale[1:]).any():
            yield f"samples influence each other: {name} v changes in a sample whose v did not"


def _null_space(A: Operator, v: Tensor) -> Iterator[str]:
    if A.kind.startswith("singular_"):
        try:  # the first solve looks
            linear_solve(A, v, GMRES(1, restart=1), backward="none", on_failure="return")
        except ValueError as error:
            yield str(error).removeprefix(f"{type(A).__name__}: ")
            return
        yield from _unnamed_null_vectors(A, v)
        return

    empty = (A.apply(v) == 0) & (A.apply(v.flatten(1).roll(1, 1).view_as(v)) == 0)
    if empty.any():
        count, first = int(empty.flatten(1).sum(1).max()), tuple(empty.nonzero()[0, 1:].tolist())
        rows = f"row {first} of A is zero" if count == 1 else f"{count} rows of A are zero, such as {first}"
        yield f"{rows}: put 1 on the diagonal there, or leave these unknowns out"
        return

    def is_mapped_to_zero(constant: Tensor, by: Callable[[Tensor], Tensor] = A.apply) -> bool:
        # Beside each row's own size: a row of one holds the constant, whatever stands in the others.
        sizes, product = by(v).abs(), by(constant).abs()
        shares = torch.where(sizes > 0, product / sizes, product.ne(0).to(v.dtype))
        return bool((shares.flatten(1).square().mean(1).sqrt() <= 1e3 * torch.finfo(v.dtype).eps).any())

    ones = torch.ones_like(v)
    if not is_mapped_to_zero(ones):
        if is_mapped_to_zero(ones, A.apply_transpose):
            yield (
                "A^T maps the constant to zero, so A is singular: give left_nullspace='constant' and, as nullspace, "
                "the vector that A maps to zero"
            )
            return
        yield from _unnamed_null_vectors(A, v)
        return
    shape = tuple(v.shape[1:])
    if len(shape) > 1 and shape[0] > 1:  # another constant in each channel
        unlike = torch.linspace(1, 2, shape[0]).to(v).view(-1, *[1] * (len(shape) - 1))
        if not is_mapped_to_zero(ones * unlike):
            vector = f"torch.ones{(1, *shape)}"
            yield f"A maps the constant of all channels to zero, so it is singular: give nullspace={vector}"
            return
    can_name_it = isinstance(A, Stencil | Matrix | Function)
    remedy = "give nullspace='constant'" if can_name_it else "enlarge the shift, or take a shorter time step"
    yield f"A maps the constant to zero, so it is singular: {remedy}"


def _unnamed_null_vectors(A: Operator, v: Tensor) -> Iterator[str]:
    """Of a small A, whose singular values are quickly found: those that rounding cannot tell from zero."""
    n = v[0].numel() if len(v) else 0
    # In float32 rounding hides too much to tell a null vector from a bad condition.
    if not 0 < n <= _UNIT_VECTORS or v.dtype != torch.float64 or not isinstance(A, Stencil | Matrix | Function):
        return
    columns = []
    for i in range(n):
        unit = torch.zeros_like(v).flatten(1)
        unit[:, i] = 1.0
        columns.append(A.apply(unit.view_as(v)).flatten(1)[:_SAMPLES])
    matrices = torch.stack(columns, 2)
    # The sizes of rows and columns say nothing of singularity.
    for axis in (2, 1):
        sizes = matrices.abs().amax(axis, keepdim=True)
        matrices = matrices / torch.where(sizes > 0, sizes, 1.0)
    if not matrices.isfinite().all():
        return
    values = torch.linalg.svdvals(matrices)
    bound = 10 * n * torch.finfo(v.dtype).eps * values[:, :1]
    # Between a null space and the rest there is a gap.
    gap = torch.where(values > bound, values, float("inf")).amin(1) > 1e3 * bound[:, 0]
    named = _named(A, v)
    more = (values <= bound).sum(1) * gap - (named[:_SAMPLES] if isinstance(named, Tensor) else named)
    worst = int(more.argmax())
    if more[worst] > 0:
        yield f"A of sample {worst} maps {more[worst]} vectors to zero that nullspace does not name"


def _named(A: Operator, v: Tensor) -> Tensor | int:
    """How many null vectors are named, of each sample or of all."""
    if not A.kind.startswith("singular_"):
        return 0
    basis, channels = A.tensors[-2], v.shape[1] if v.dim() > 2 else 1
    if basis.numel() == 0:
        return channels
    if basis.dim() > v.dim():
        return basis.ne(0).flatten(2).any(2).sum(1)
    return len(basis) * (1 if basis.dim() == v.dim() and v.dim() > 2 else channels)


def _captures(A: Operator, v: Tensor) -> Iterator[str]:
    tensors = [t.detach() for t in A.tensors]
    with torch.enable_grad():
        if torch.ops.prdp.apply(v, tensors, A.kind, A.shape, A.parameters, False).requires_grad:
            yield "matvec uses a tensor that requires grad but is not among its tensors: no gradient reaches it"


def _diagonal(A: Operator, v: Tensor) -> Iterator[str]:
    try:
        diagonal = A.diagonal()
    except ValueError as error:
        if "is not known" in str(error):
            return
        raise
    try:
        flat = diagonal.to(v.dtype).expand_as(v).flatten(1)
    except RuntimeError:
        yield f"the diagonal has shape {tuple(diagonal.shape)}, which does not broadcast against {tuple(v.shape)}"
        return
    n, rounding = flat.shape[1], 1e3 * max(torch.finfo(v.dtype).eps, torch.finfo(diagonal.dtype).eps)
    for i in torch.linspace(0, n - 1, min(n, _UNIT_VECTORS)).round().long().tolist():
        unit = torch.zeros_like(v).flatten(1)
        unit[:, i] = 1.0
        product = A.apply(unit.view_as(v)).flatten(1)
        found, expected = flat[:, i], product[:, i]
        if ((found - expected).abs() > rounding * _norm(product)).any():
            yield f"the diagonal is wrong: entry {i} is {found[0]:.6g}, by the product {expected[0]:.6g}"
            return


def _gradients(A: Operator, v: Tensor, w: Tensor, generator: Generator) -> Iterator[str]:
    kind, given = A.kind.removeprefix("singular_"), A.tensors
    if kind != A.kind:
        given = given[:-2]  # without its null spaces, which need not be those of the operator that is changed
    if A.kind == "singular_diffusion":  # without them, a diffusion that nothing holds is refused
        given = [given[0], torch.where(given[1] == 0, 1.0, given[1]), *given[2:]]
    here: Tensor = torch.ops.prdp.apply(v, list(given), kind, A.shape, A.parameters, False)
    sizes = torch.maximum(here.abs(), A.apply(w).abs())
    w = w / torch.where(sizes > 0, sizes, 1.0)  # so that the rows of a product, of any sizes, count alike
    found = _C.product_rule(w, v, given, kind, A.shape, A.parameters)
    for i, (t, gradient) in enumerate(zip(given, found, strict=True)):
        if not t.is_floating_point() or not t.numel():
            continue
        eps = max(torch.finfo(v.dtype).eps, torch.finfo(t.dtype).eps)
        step = eps ** (1 / 3)
        direction = _noise(t, generator) * _own_sizes(t)  # a part of each entry, as they may differ in size
        direction = torch.where(t == 0, direction.abs(), direction)  # as h of a side may not be less

        def changed(s: float, i: int = i, t: Tensor = t, direction: Tensor = direction) -> float:
            tensors = [t + s * direction if j == i else other for j, other in enumerate(given)]
            product: Tensor = torch.ops.prdp.apply(v, tensors, kind, A.shape, A.parameters, False)
            return ((product - here) * w).sum().item() / s

        above, below = changed(step), changed(-step)
        if math.isnan(below):  # as of h < 0: two steps up in its place
            below = changed(step / 2)
        terms = torch.zeros_like(direction) if gradient is None else gradient * direction
        slope = terms.sum().item()
        rounding = 40 * eps / step * float((w * sizes).abs().sum())
        bound = rounding + 20 * step * terms.abs().sum().item()
        # Where the two differ the product bends, or has kinks, as an upwind scheme has in still water.
        bound += abs(above - below)
        if not min(above, below) - bound <= slope <= max(above, below) + bound:
            yield (
                f"the gradient for tensor {i} of shape {tuple(t.shape)} is wrong: "
                f"{slope:.6g} along a direction in which the product changes by {(above + below) / 2:.6g}"
            )


def _own_sizes(t: Tensor) -> Tensor:
    """Those of the entries; of zeros, the least of them, or 1; 0 of an infinite one, such as the h of a side that
    holds u."""
    sizes = torch.where(t.isfinite(), t.abs(), 0.0)
    least = torch.where(sizes > 0, sizes, float("inf")).amin()
    of_zeros = torch.where(least.isfinite(), least, 1.0)
    return torch.where(sizes > 0, sizes, of_zeros) * t.isfinite()


def _preconditioner(A: Operator, solver: Solver | None, v: Tensor, w: Tensor) -> Iterator[str]:
    if solver is None or solver.preconditioner is None:
        return
    M = solver.preconditioner
    if not isinstance(M, Operator):
        linear_solve(A, v, solver, on_failure="return")  # says itself what it does not fit
        return
    product = M.apply(v)
    if product.shape != v.shape or product.dtype != v.dtype:
        yield (
            f"the preconditioner makes {product.dtype} {tuple(product.shape)} of {v.dtype} {tuple(v.shape)}; "
            "it must keep both"
        )
        return
    yield from _products(M, v, w, "M")
    yield from _fits(M, solver, A, v, w)


def _fits(M: Operator, solver: Solver | None, A: Operator, v: Tensor, w: Tensor) -> Iterator[str]:
    """Whether M, which is A or preconditions it, is symmetric and definite where the method asks for that."""
    if not isinstance(solver, (CG, MINRES)):
        return
    is_a, method = M is A, type(solver).__name__
    name, what = ("A", "A") if is_a else ("M", "preconditioner")
    mv, mw = M.apply(v), M.apply(w)
    left, right = _dot(mv, w), _dot(v, mw)
    bound = 1e3 * torch.finfo(v.dtype).eps * (_norm(mv) * _norm(w) + _norm(v) * _norm(mw))
    if ((left - right).abs() > bound).any():
        worst = (left - right).abs().argmax()
        at = f"<{name} v, w> = {left[worst]:.6g} but <v, {name} w> = {right[worst]:.6g}"
        yield f"{method} needs a symmetric {what}: {at}"
    if is_a and isinstance(solver, MINRES):
        return
    values = _ritz_values(M, v)
    low, high = values.amin(1), values.amax(1)
    nothing = 1e3 * torch.finfo(v.dtype).eps * torch.maximum(-low, high)
    if ((low < -nothing) & (high > nothing) | (torch.maximum(-low, high) == 0)).any():
        yield f"{method} needs a definite {what}: <v, {name} v> is not of one sign"
    elif isinstance(solver, MINRES) and (low < -nothing).any():
        yield f"{method} needs a positive definite {what}: <v, {name} v> is negative"


def _ritz_values(M: Operator, v: Tensor) -> Tensor:
    """Approximate eigenvalues of a symmetric M for each sample, by Lanczos vectors that are kept orthogonal: all of
    them where there are few."""
    n = v[0].numel()
    rounding = 1e3 * torch.finfo(v.dtype).eps
    basis = torch.zeros(len(v), 0, n, dtype=v.dtype, device=v.device)
    q, products, largest = v.flatten(1) / _norm(v)[:, None], [], torch.zeros(())
    for _ in range(min(n, _UNIT_VECTORS if n <= _UNIT_VECTORS else _LANCZOS_STEPS)):
        basis = torch.cat([basis, q[:, None]], 1)
        product = M.apply(q.view_as(v)).flatten(1)
        products.append(product)
        largest = torch.maximum(_norm(product), largest)
        for _ in range(2):  # twice is enough (Giraud, Langou and Rozložník 2005)
            product = product - (basis.mT @ (basis @ product[:, :, None]))[:, :, 0]
        length = _norm(product)
        q = torch.where((length > rounding * largest)[:, None], product / length[:, None], 0.0)
    projected = basis @ torch.stack(products, 2)
    values: Tensor = torch.linalg.eigvalsh((projected + projected.mT) / 2)
    return values
