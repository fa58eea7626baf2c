"""Linear operators A on batches of vectors.

A vector is (batch, channel, *shape) for operators on grids, with one channel unless an operator says otherwise, and
(batch, n) for matrices. The tensors of an operator (nu, winds, a matrix) get gradients through `apply` and through
`linear_solve`.
"""

import warnings

import torch

from prdp_torch import _C, _check, batching


class Operator:
    """The base of all operators. `kind`, `shape`, `parameters` and `tensors` describe it to the compiled library."""

    kind: str

    def __init__(self, shape, parameters, tensors, null_spaces=()):
        self.shape = shape
        self.parameters = parameters
        self.tensors = [full_precision(t) for t in (*tensors, *null_spaces)]
        if null_spaces:
            self.kind = "singular_" + self.kind
        if not torch.compiler.is_compiling():
            _C.check_operator(self.kind, self.shape, self.parameters, self.tensors)

    def __repr__(self):
        tensors = ", ".join(f"{t:.4g}" if t.dim() == 0 else f"tensor{tuple(t.shape)}" for t in self.tensors)
        return f"{type(self).__name__}(shape={tuple(self.shape)}, parameters={self.parameters}, tensors=[{tensors}])"

    def apply(self, v):
        """Return A v, with gradients. v has the shape of a right-hand side."""
        return torch.ops.prdp.apply(v, self.tensors, self.kind, self.shape, self.parameters, False)

    def apply_transpose(self, v):
        """Return Aᵀ v, with gradients."""
        return torch.ops.prdp.apply(v, self.tensors, self.kind, self.shape, self.parameters, True)

    def diagonal(self):
        """Return the diagonal of A, in a shape that broadcasts against a batch of vectors."""
        return torch.ops.prdp.diagonal(self.tensors, self.kind, self.shape, self.parameters)

    def dense(self, dtype=torch.float64):
        """Return A as a matrix (n, n), or (batch, n, n) if it differs between samples. Only for small n."""
        return torch.ops.prdp.dense(self.tensors, self.kind, self.shape, self.parameters, dtype)


class Poisson(Operator):
    """The Laplacian with zero boundary values: Σ_d (v_{i-1} - 2 v_i + v_{i+1}) / dx_d². It is negative definite.

    Args:
        shape: the grid of unknowns, (N,), (Ny, Nx) or (Nz, Ny, Nx).
        length: the side of the domain, one number or one per axis in the order of `shape`; dx = length/(N + 1).
    """

    kind = "poisson"

    def __init__(self, shape, length=1.0):
        shape = _check.shape("Poisson", shape)
        super().__init__(shape, _check.lengths("Poisson", length, len(shape)), [])


class Heat(Operator):
    """The operator of an implicit Euler step of the heat equation: I - nu dt L, with the Laplacian L of `Poisson`.

    Args:
        shape, length: as in `Poisson`.
        nu: diffusivity >= 0, length²/time; a number or a 0-dimensional tensor, which gets a gradient.
        dt: time step > 0.
    """

    kind = "heat"

    def __init__(self, shape, nu, dt, length=1.0):
        shape = _check.shape("Heat", shape)
        parameters = [_check.real("Heat", "dt", dt), *_check.lengths("Heat", length, len(shape))]
        super().__init__(shape, parameters, [real_tensor("Heat", "nu", nu)])


class Burgers(Operator):
    """The operator of an implicit Euler step of Burgers' equation on a periodic grid: I + dt Γ - nu dt L on each
    velocity channel.

    Γ = Σ_d max(w⁻, 0) B_d + min(w⁺, 0) F_d is first-order upwind advection. B and F are backward and forward
    differences, and w∓ are the winds at the lower and upper face of a cell. Rows sum to 1, and entries off the
    diagonal are <= 0.

    Args:
        winds: (batch, 1, N) or (batch, 2, Ny, Nx); batch 1 is for all samples alike. Channel 0 is the velocity
            along x, the last axis, and channel 1 that along y. The dtype is that of the vectors.
        nu, dt: as in `Heat`.
        length: as in `Poisson`, but dx = length/N.

    Source: paper, appendix C.5.
    """

    kind = "burgers"

    def __init__(self, winds, nu, dt, length=1.0):
        super().__init__(*flow("Burgers", "winds", winds, nu, dt, length))


class NavierStokes(Operator):
    """The operator of an implicit Euler step of the incompressible Navier-Stokes equations on a periodic staggered
    grid, linearised about `velocity`.

    Vectors are (batch, 3, Ny, Nx). Their channels are u₁ along x on the left face of each cell, u₂ along y on its
    lower face, and p in its centre:

        A = [[C₁, 0, G₁], [0, C₂, G₂], [D₁, D₂, 0]],    C_k = I/dt + Γ_k - nu L

    The divergence D uses forward differences, and the gradient G = -Dᵀ backward differences. Γ_k is first-order
    upwind advection with the velocity at the points of u_k. Constant pressure is the null vector of A and of Aᵀ.

    Args:
        velocity: (batch or 1, 2 or 3, Ny, Nx). A third channel, the pressure, has no influence.
        nu, dt: as in `Heat`.
        length: as in `Poisson`, but dx = length/N.

    Source: paper, appendix C.6.
    """

    kind = "navier_stokes"

    def __init__(self, velocity, nu, dt, length=1.0):
        super().__init__(*flow("NavierStokes", "velocity", velocity, nu, dt, length))


class Stencil(Operator):
    """An operator of your own on a grid of 1 to 3 axes, given by its coefficients at every point. It is the same for
    every channel of v:

        (A v)[i] = Σ_k coefficients[k, i] · v[i + offsets[k]]

    It has everything that the built-in operators have: CPU loops, every solver except `Chebyshev`, and both kinds of
    gradients. It is fastest if `offsets` are nearest neighbours, such as
    [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)] in two dimensions.

    Args:
        coefficients: (batch, k, *shape), or (1, k, *shape) for all samples alike; float32 or float64, as the
            vectors (batch, channel, *shape). They get gradients. Where a neighbour lies outside the grid its
            coefficient has no influence, but it must be finite.
        offsets: k tuples of whole numbers, one entry for each axis of shape, at most two cells along each.
        boundary: "zero" (v is 0 outside the grid) or "periodic", one for all axes or one for each.
        nullspace: what A maps to zero, where it is singular: "constant" (in each channel), or vectors (k, *shape). Then
            b, u and cotangents are taken without their part there, and a b that has one beyond rtol is INCONSISTENT.
        left_nullspace: what Aᵀ maps to zero, as many vectors. None takes those of nullspace, as for symmetric A.

    Raises:
        ValueError, TypeError: the arguments do not fit together. This is checked before any work.

    Examples:
        >>> A = operators.Stencil(torch.stack([1 + a + b, -a, -b], 1), [(0,), (-1,), (1,)], boundary="periodic")
    """

    kind = "stencil"

    def __init__(self, coefficients, offsets, boundary="zero", nullspace=None, left_nullspace=None):
        dim = _check.dense("Stencil", "coefficients", coefficients).dim() - 2
        if not 1 <= dim <= 3:
            raise ValueError(
                "Stencil: coefficients must have shape (batch or 1, k, *shape) with 1 to 3 axes in shape, got "
                f"{tuple(coefficients.shape)}"
            )
        self.offsets = _offsets(offsets, dim)
        self.boundary = (boundary,) * dim if isinstance(boundary, str) else tuple(boundary)
        if len(self.boundary) != dim or not set(self.boundary) <= {"zero", "periodic"}:
            raise ValueError(
                f"Stencil: boundary must be 'zero' or 'periodic', one for all axes or one for each of {dim}, "
                f"got {boundary!r}"
            )
        periodic = [float(b == "periodic") for b in self.boundary]
        cells = [float(n) for offset in self.offsets for n in offset]
        null_spaces = _null_spaces("Stencil", nullspace, left_nullspace, coefficients)
        super().__init__(list(coefficients.shape[2:]), periodic + cells, [coefficients], null_spaces)

    def __repr__(self):
        shape, tensors = tuple(self.shape), ", ".join(f"tensor{tuple(t.shape)}" for t in self.tensors)
        return f"Stencil(shape={shape}, offsets={self.offsets}, boundary={self.boundary}, tensors=[{tensors}])"


class Diffusion(Operator):
    """Diffusion on the cells of a box by finite volumes: A u = shift·u - ∇·(κ ∇u), the same for every channel of u.

    It is symmetric. Where neither a side nor the shift holds u, A is singular; the constant is then its `nullspace`
    (see `Stencil`). Values and fluxes at the sides that are not zero belong to b: `boundary_rhs` makes that part.

    Args:
        kappa: (batch, *shape), or (1, *shape) for all samples alike, κ > 0 in the centres of the cells; shape has 1 to
            3 axes. Gets a gradient, which is formed from fluxes: in float32 it keeps digits that the gradient of a
            `Stencil`'s coefficients loses.
        shift: a number, or a tensor like kappa, which gets a gradient. With 1/dt, A is a step of ∂u/∂t = ∇·(κ ∇u) by
            implicit Euler, with b = u/dt.
        boundary: "zero" (u = 0 on the side, half a cell from the nearest centre), "flux" (none passes) or "periodic":
            one for all sides, one for each axis, or a pair (low, high) for each axis.
        length: the side of the box, one number or one for each axis in the order of `shape`.
        faces: how κ on a face is made of its two cells: "harmonic", which is exact for layers, or "arithmetic".

    Raises:
        ValueError, TypeError: the arguments do not fit together. This is checked before any work.

    Examples:
        >>> A = prdp.operators.Diffusion(torch.rand(1, 64, 64) + 0.1, boundary=["zero", "flux"])
        >>> u, info = prdp.linear_solve(A, torch.ones(1, 1, 64, 64), prdp.CG(20, preconditioner="multigrid"))
    """

    kind = "diffusion"

    def __init__(self, kappa, shift=0.0, boundary="zero", length=1.0, faces="harmonic"):
        dim = _check.dense("Diffusion", "kappa", kappa).dim() - 1
        if not 1 <= dim <= 3:
            raise ValueError(
                "Diffusion: kappa must have shape (batch or 1, *shape) with 1 to 3 axes in shape, got "
                f"{tuple(kappa.shape)}"
            )
        if faces not in ("harmonic", "arithmetic"):
            raise ValueError(f"Diffusion: faces must be 'harmonic' or 'arithmetic', got {faces!r}")
        self.boundary = _sides(boundary, dim)
        self.length = _check.lengths("Diffusion", length, dim)
        self.kappa = kappa
        if isinstance(shift, torch.Tensor) and shift.dim() > 0:
            if shift.dim() != kappa.dim():
                raise ValueError(
                    f"Diffusion: shift must be a number or have the shape of kappa, {tuple(kappa.shape)}, got "
                    f"{tuple(shift.shape)}"
                )
            shift, is_held = shift.unsqueeze(1), True
        else:
            is_held = isinstance(shift, torch.Tensor) or shift != 0
            shift = real_tensor("Diffusion", "shift", shift)
        is_held = is_held or any("zero" in sides for sides in self.boundary)
        codes = [float(("zero", "flux", "periodic").index(side)) for sides in self.boundary for side in sides]
        parameters = [*codes, *self.length, float(faces == "arithmetic")]
        null_spaces = () if is_held else (kappa.new_empty(0).detach(),) * 2
        super().__init__(list(kappa.shape[1:]), parameters, [kappa.unsqueeze(1), shift], null_spaces)

    def boundary_rhs(self, values=0.0, fluxes=0.0):
        """The part of b that given values and fluxes at the sides make, (batch or 1, 1, *shape), with gradients.

        Args:
            values: u on the sides that are "zero".
            fluxes: what flows in, κ ∂u/∂n with the normal n pointing outwards, on the sides that are "flux".
                Each is one number for all sides, or a pair (low, high) for each axis; a number, or a tensor that
                broadcasts to (batch or 1, *side), where side is shape without the axis.
        """
        dim = len(self.shape)
        values, fluxes = (_of_sides(name, given, dim) for name, given in (("values", values), ("fluxes", fluxes)))
        b = torch.zeros_like(self.kappa)
        for axis, sides in enumerate(self.boundary):
            h = self.length[axis] / self.shape[axis]
            for end, side in enumerate(sides):
                if side == "periodic":
                    continue
                at_side = self.kappa.select(axis + 1, -end)
                given = (values if side == "zero" else fluxes)[axis][end]
                added = 2 * at_side * given / h**2 if side == "zero" else torch.ones_like(at_side) * given / h
                if added.shape[0] != b.shape[0]:
                    b = b.expand(added.shape[0], *b.shape[1:])
                place = torch.zeros(self.shape[axis], dtype=b.dtype, device=b.device)
                place[-end] = 1.0
                b = b + added.unsqueeze(axis + 1) * place.view(-1, *(1,) * (dim - axis - 1))
        return b.unsqueeze(1)


class Function(Operator):
    """An operator of your own, given by a function for its product with a batch of vectors (batch, ...).

    Args:
        matvec: `matvec(v, *tensors)` returns A v as a new tensor with the shape and dtype of v. It is made of torch
            operations and linear in v. Samples may differ only through `tensors`.
        transpose: the same for Aᵀ v. None takes torch's own derivative of matvec.
        tensors: what A is made of, a tuple of tensors or a single one. They get gradients. A tensor that requires
            grad and reaches matvec in another way is refused.
        diagonal: `diagonal(*tensors)` returns the diagonal of A in a shape that broadcasts against the vectors.
            `Jacobi` and `preconditioner="diagonal"` need it.
        symmetric: whether A = Aᵀ. Then matvec is used for both.
        nullspace, left_nullspace: as for `Stencil`; a vector has the shape of a channel of b (batch, channel, *shape),
            or of b without its batch axis if b has two axes.

    `Direct` multiplies A with unit vectors, so it is for small systems. Call `prdp.check_operator` once to compare
    the functions with each other. A `Function` cannot be created inside `torch.compile`.
    """

    kind = "function"

    def __init__(
        self,
        matvec,
        transpose=None,
        tensors=(),
        diagonal=None,
        symmetric=False,
        nullspace=None,
        left_nullspace=None,
    ):
        for name, function in (("matvec", matvec), ("transpose", transpose), ("diagonal", diagonal)):
            if not callable(function) and (name == "matvec" or function is not None):
                raise TypeError(f"Function: {name} must be callable, got {function!r}")
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
            product if symmetric else _returning_a_tensor("transpose", transpose),
            None if diagonal is None else lambda given: _tensor("diagonal", diagonal(*given)),
            lambda v, given: batching.transposed(matvec, v, given),
            lambda cotangent, u, given: batching.product_rule(matvec, cotangent, u, given),
        )
        self._null_spaces = _null_spaces("Function", nullspace, left_nullspace, None)
        super().__init__([self._products.number], [], tensors, self._null_spaces)

    def __reduce__(self):
        matvec, transpose, diagonal, symmetric = self._made_of
        tensors = tuple(self.tensors[: len(self.tensors) - len(self._null_spaces)])
        return Function, (matvec, transpose, tensors, diagonal, symmetric, *(self._null_spaces or (None, None)))


class Matrix(Operator):
    """A matrix: a tensor (n, n) or (batch, n, n), dense or sparse CSR. A sparse one gets gradients on its pattern; if
    you need them, use `Matrix.csr`, because torch may make the gradient of a CSR tensor dense.

    `nullspace` and `left_nullspace` are those of `Stencil`: "constant" or vectors (k, n)."""

    def __init__(self, matrix, nullspace=None, left_nullspace=None):
        if not isinstance(matrix, torch.Tensor):
            raise TypeError(f"Matrix: expected a torch tensor, got {type(matrix).__name__}")
        if matrix.layout == torch.sparse_csr:
            _warn_of_csr_gradient(matrix)
            self.kind = "csr"
            with torch._C._DisableFuncTorch():  # torch.func does not know sparse tensors
                tensors = [matrix.crow_indices(), matrix.col_indices(), matrix.values()]
        elif matrix.layout == torch.strided:
            self.kind = "dense"
            tensors = [matrix]
        else:
            raise ValueError(f"linear_solve: A must be a dense or sparse CSR tensor, got {matrix.layout}")
        if matrix.dim() not in (2, 3) or matrix.shape[-1] != matrix.shape[-2]:
            raise ValueError(f"linear_solve: A must have shape (n, n) or (batch, n, n), got {tuple(matrix.shape)}")
        if self.kind == "csr" and tensors[0].shape[-1] != matrix.shape[-1] + 1:
            raise ValueError(
                f"linear_solve: a CSR matrix of {matrix.shape[-1]} rows needs a crow of one more, got "
                f"{tensors[0].shape[-1]}"
            )
        super().__init__([], [], tensors, _null_spaces("Matrix", nullspace, left_nullspace, tensors[-1]))

    @classmethod
    def csr(cls, crow, col, values, size, nullspace=None, left_nullspace=None):
        """A sparse matrix by its compressed rows, as `torch.sparse_csr_tensor` takes them.

        Args:
            crow: (n + 1,) whole numbers, where each row starts in col and values.
            col: (nnz,) whole numbers, the column of each stored entry.
            values: (nnz,), or (batch, nnz) for a matrix per sample on one pattern; float32 or float64. The
                gradient arrives here, in this shape.
            size: (n, n) or n; (batch, n, n) with values (batch, nnz).
            nullspace, left_nullspace: "constant" or vectors (k, n), as for `Stencil`.

        Raises TypeError or ValueError where the shapes do not fit each other.
        """
        for name, tensor in (("crow", crow), ("col", col)):
            if _check.dense("Matrix.csr", name, tensor).dtype not in (torch.int32, torch.int64):
                raise TypeError(f"Matrix.csr: {name} must hold whole numbers (int32 or int64), got {tensor.dtype}")
        if _check.dense("Matrix.csr", "values", values).dtype not in (torch.float32, torch.float64):
            raise TypeError(f"Matrix.csr: values must be float32 or float64, got {values.dtype}")
        if not isinstance(size, (tuple, list)):
            size = (_check.whole("Matrix.csr", "size", size),) * 2
        size = tuple(_check.whole("Matrix.csr", "every extent of size", n) for n in size)
        n, batch = size[-1], values.shape[:-1]
        if values.dim() not in (1, 2) or len(size) not in (2, 3) or size[-2] != n or size[:-2] not in ((), batch):
            raise ValueError(
                "Matrix.csr: size must be (n, n), or (batch, n, n) with values of shape (batch, nnz), "
                f"got {size} with values of shape {tuple(values.shape)}"
            )
        for name, tensor, length in (("crow", crow, n + 1), ("col", col, values.shape[-1])):
            if tensor.shape not in ((length,), (*batch, length)):
                raise ValueError(f"Matrix.csr: {name} must have shape ({length},), got {tuple(tensor.shape)}")
        made = cls.__new__(cls)
        made.kind = "csr"
        pattern = [index.expand(*batch, -1) for index in (crow, col)]
        null_spaces = _null_spaces("Matrix.csr", nullspace, left_nullspace, values)
        Operator.__init__(made, [], [], [*pattern, values], null_spaces)
        return made


_warned_of_csr_gradient = False


def _warn_of_csr_gradient(matrix):
    global _warned_of_csr_gradient
    if matrix.requires_grad and torch.is_grad_enabled() and not _warned_of_csr_gradient:
        _warned_of_csr_gradient = True
        warnings.warn(
            "linear_solve: the gradient of a sparse CSR tensor passes through torch, which may make it dense; "
            "operators.Matrix.csr(crow, col, values, size) takes it to the values directly",
            stacklevel=4,
        )


def _sides(boundary, dim):
    """The pair (low, high) of each axis."""
    axes = [boundary] * dim if isinstance(boundary, str) else list(boundary)
    pairs = [(of_axis,) * 2 if isinstance(of_axis, str) else tuple(of_axis) for of_axis in axes]
    known = {"zero", "flux", "periodic"}
    if len(pairs) != dim or any(len(pair) != 2 or not set(pair) <= known for pair in pairs):
        raise ValueError(
            "Diffusion: boundary must be 'zero', 'flux' or 'periodic': one for all sides, or one, or a pair "
            f"(low, high), for each of {dim} axes, got {boundary!r}"
        )
    if any(pair.count("periodic") == 1 for pair in pairs):
        raise ValueError(f"Diffusion: boundary: both sides of an axis are periodic or none is, got {boundary!r}")
    return pairs


def _of_sides(name, given, dim):
    """A value for each side: (low, high) for each axis."""
    if isinstance(given, (int, float, torch.Tensor)):
        return [(given, given)] * dim
    if len(given) != dim or any(len(pair) != 2 for pair in given):
        raise ValueError(f"Diffusion: {name} must be one for all sides or a pair (low, high) for each of {dim} axes")
    return given


def _null_spaces(who, right, left, like):
    """The two bases for the compiled library, an empty one for "constant"; none without a null space."""
    if right is None and left is None:
        return ()
    if right is None:
        raise ValueError(f"{who}: left_nullspace= stands beside nullspace=, which is missing")
    return tuple(
        _basis(who, *named, like)
        for named in (("nullspace", right), ("left_nullspace", right if left is None else left))
    )


def _basis(who, name, value, like):
    if isinstance(value, str) and value == "constant":
        return torch.empty(0) if like is None else like.new_empty(0)
    if not isinstance(value, torch.Tensor):
        raise TypeError(f"{who}: {name} must be None, 'constant' or a tensor (k, *shape), got {value!r:.80}")
    return _check.dense(who, name, value).detach()


def as_operator(who, name, value):
    """An operator as it is, a tensor as a `Matrix`; TypeError for all else."""
    if isinstance(value, Operator):
        return value
    if isinstance(value, torch.Tensor):
        return Matrix(value)
    raise TypeError(f"{who}: {name} must be an operator of prdp_torch.operators, got {value!r:.80}")


def _tensor(name, value):
    if isinstance(value, torch.Tensor):
        return value
    raise TypeError(f"Function: {name} must return a torch tensor, got {type(value).__name__}")


def _returning_a_tensor(name, function):
    """A product as the compiled library calls it."""
    return None if function is None else lambda v, given: _tensor(name, function(v, *given))


def _offsets(offsets, dim):
    """As a list of tuples of `dim` whole numbers."""
    if not isinstance(offsets, (tuple, list)) or not all(isinstance(o, (tuple, list)) for o in offsets):
        raise TypeError(f"Stencil: offsets must be a list of tuples such as [(0, 0), (0, -1)], got {offsets!r}")
    for offset in offsets:
        if len(offset) != dim:
            entries = "1 entry" if dim == 1 else f"{dim} entries"
            raise ValueError(
                f"Stencil: every offset must have {entries}, one for each axis of shape, got {tuple(offset)}"
            )
    return [tuple(_check.whole("Stencil", "every entry of an offset", n) for n in offset) for offset in offsets]


def real_tensor(who, name, value):
    """A number as the 0-dimensional tensor that the library takes; a tensor as it is."""
    if isinstance(value, torch.Tensor):
        return value
    return torch.tensor(_check.real(who, name, value), dtype=torch.float64)


def full_precision(t):
    """float32 for float16 and bfloat16 under torch.autocast, as the solves take them there."""
    low = t.dtype in (torch.float16, torch.bfloat16) and torch.is_autocast_enabled(t.device.type)
    return t.float() if low else t


def flow(who, name, winds, nu, dt, length):
    """Shape, parameters and tensors of a flow linearised about winds (batch, channel, *shape)."""
    if _check.dense(who, name, winds).dim() < 3:
        raise ValueError(f"{who}: {name} must have shape (batch, channel, *shape), got {tuple(winds.shape)}")
    parameters = [_check.real(who, "dt", dt), *_check.lengths(who, length, winds.dim() - 2)]
    return list(winds.shape[2:]), parameters, [winds, real_tensor(who, "nu", nu)]
