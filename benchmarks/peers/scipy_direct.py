"""SciPy: sparse LU of the assembled matrix, float64, its factors used again for the gradient."""

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from benchmarks.entries import Entry
from benchmarks.peers import stencils


class Backend:
    stack = staticmethod(np.stack)
    roll = staticmethod(np.roll)
    pad = None


def heat_matrix(problem):
    matrix = sp.identity(problem.unknowns)
    for axis, n in enumerate(problem.shape):
        second = sp.diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(n, n)) * (n + 1) ** 2
        before, after = np.prod(problem.shape[:axis], dtype=int), np.prod(problem.shape[axis + 1 :], dtype=int)
        matrix = matrix - problem.nu * problem.dt * sp.kron(sp.kron(sp.eye(before), second), sp.eye(after))
    return matrix.tocsc()


def upwind_matrix(stencil, sample=...):
    """Of one sample and channel: the stencil's coefficients at the places that rolling takes them from."""
    fields = {axis: [np.asarray(c)[sample].squeeze() for c in (stencil.lower[axis], stencil.upper[axis])]
              for axis in stencil.lower}  # fmt: skip
    index = np.arange(next(iter(fields.values()))[0].size).reshape(next(iter(fields.values()))[0].shape)
    values, columns = [np.asarray(stencil.diagonal)[sample].squeeze()], [index]
    for axis, (lower, upper) in fields.items():
        values += [lower, upper]
        columns += [np.roll(index, 1, axis), np.roll(index, -1, axis)]
    rows = np.tile(index.ravel(), len(values))
    data, at = (np.concatenate([part.ravel() for part in parts]) for parts in (values, columns))
    return sp.csc_array((data.astype(np.float64), (rows, at)), shape=(index.size, index.size))


def matrices(problem):
    """One a sample; a single one where the samples share it."""
    if problem.name.startswith("heat"):
        return [heat_matrix(problem)]
    stencil = stencils.make(problem, Backend, lambda array: array)
    if problem.kappa is not None:
        return [upwind_matrix(stencil)]
    samples = range(len(problem.b))
    if problem.name.startswith("burgers"):
        return [upwind_matrix(stencil, i) for i in samples]
    return [navier_stokes_matrix(stencil, i) for i in samples]


def navier_stokes_matrix(stencil, sample):
    """With the mean of p pinned by one more entry: A is singular by the constant pressure."""
    ny, nx = stencil.ny, stencil.nx
    forward = lambda n: sp.diags_array([1.0, -1.0, 1.0], offsets=[1, 0, 1 - n], shape=(n, n)) * n  # noqa: E731
    d1, d2 = sp.kron(sp.eye(ny), forward(nx)), sp.kron(forward(ny), sp.eye(nx))
    pin = sp.csr_array(([1.0], ([0], [0])), shape=(ny * nx, ny * nx))
    c1, c2 = upwind_matrix(stencil.c1, sample), upwind_matrix(stencil.c2, sample)
    return sp.block_array([[c1, None, -d1.T], [None, c2, -d2.T], [d1, d2, pin]]).tocsc()


def of_field(problem, u, found):
    """κ̄: between two neighbours flows dt n² κ (u_after - u), κ the mean of both."""
    shape = (-1, *problem.shape)
    u, found, total = u.reshape(shape), found.reshape(shape), 0.0
    for axis in (-1, -2):
        step = lambda v: np.roll(v, -1, axis) - v  # noqa: B023, E731
        of_face = -0.5 * problem.dt * problem.shape[axis] ** 2 * (step(found) * step(u)).sum(0)
        total = total + of_face + np.roll(of_face, 1, axis)
    return total


def entries(problem):
    if problem.kappa is not None:
        return [Entry("SciPy, sparse LU", "implicit", [None], lambda _: diffusion_calls(problem))]
    return entries_of_gradients_for_b(problem)


def diffusion_calls(problem):
    b, g = (np.asarray(v).astype(np.float64).reshape(len(v), -1).T for v in (problem.b, problem.g))

    def run(gradient):
        (matrix,) = matrices(problem)
        lu = splu(matrix)
        u = lu.solve(b).T
        if not gradient:
            return u
        found = lu.solve(g, "T").T
        return u, (found, of_field(problem, u, found))

    return lambda: run(False), lambda: run(True)


def entries_of_gradients_for_b(problem):
    assembled = matrices(problem)
    b, g = (np.asarray(v).astype(np.float64).reshape(len(v), -1) for v in (problem.b, problem.g))

    def solve(lu, rhs, trans="N"):
        x = lu.solve(rhs, trans)
        if problem.name == "navier_stokes":
            x[2 * x.shape[0] // 3 :] -= x[2 * x.shape[0] // 3 :].mean(0)
        return x

    def run(gradient):
        factors = [splu(matrix) for matrix in assembled]
        if len(factors) == 1:
            u = solve(factors[0], b.T).T
            return (u, solve(factors[0], g.T, "T").T) if gradient else u
        u = np.stack([solve(lu, v) for lu, v in zip(factors, b, strict=True)])
        if not gradient:
            return u
        return u, np.stack([solve(lu, v, "T") for lu, v in zip(factors, g, strict=True)])

    yield Entry("SciPy, sparse LU", "implicit", [None], lambda _: (lambda: run(False), lambda: run(True)))
