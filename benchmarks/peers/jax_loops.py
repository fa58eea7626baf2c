"""JAX, jitted: the same iterations over stencils, implicit derivative; K is a constant, or an argument."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import gmres as library_gmres

from benchmarks.entries import Entry
from benchmarks.peers import stencils


class Backend:
    @staticmethod
    def stack(parts, axis):
        return jnp.stack(parts, axis)

    @staticmethod
    def roll(v, shift, axis):
        return jnp.roll(v, shift, axis)

    @staticmethod
    def pad(v, axis):
        widths = [(0, 0)] * v.ndim
        widths[axis] = (1, 1)
        return jnp.pad(v, widths)


def jacobi(stencil, transposed, b, k):
    scale = 1 / stencil.diagonal
    return jax.lax.fori_loop(1, k, lambda _, u: (b - stencil.off_diagonal(u)) * scale, b * scale)


def cg(stencil, transposed, b, k):
    """Of a symmetric operator."""

    def step(_, state):
        x, r, p, rr = state
        q = stencil.apply(p)
        alpha = rr / _dot(p, q)
        x, r = x + alpha * p, r - alpha * q
        after = _dot(r, r)
        return x, r, r + after / rr * p, after

    return jax.lax.fori_loop(0, k, step, (jnp.zeros_like(b), b, b, _dot(b, b)))[0]


def _dot(v, w):
    return (v * w).sum((1, 2, 3), keepdims=True)


def _dots(basis, w):
    return jnp.stack([(v * w).reshape(len(w), -1).sum(1) for v in basis])


def _spread(scalars, like):
    return scalars.reshape(-1, *[1] * (like.ndim - 1))


def _norm(v):
    return jnp.sqrt((v * v).reshape(len(v), -1).sum(1))


def gmres(stencil, transposed, b, cycles, m):
    """GMRES(m), one Gram–Schmidt pass, Givens rotations, the loop over the cycle unrolled."""
    apply = stencil.transpose if transposed else stencil.apply

    def cycle(_, x):
        r = b - apply(x)
        size = _norm(r)
        basis = [r / _spread(size, r)]
        columns, rotations, rhs = [], [], [size]
        for j in range(m):
            w = apply(basis[j])
            column = list(_dots(basis, w))
            for h, v in zip(column, basis, strict=True):
                w = w - _spread(h, w) * v
            length = _norm(w)
            basis.append(w / _spread(length, w))
            for i, (c, s) in enumerate(rotations):
                column[i], column[i + 1] = c * column[i] + s * column[i + 1], c * column[i + 1] - s * column[i]
            diagonal = jnp.sqrt(column[j] ** 2 + length**2)
            c, s = column[j] / diagonal, length / diagonal
            rotations.append((c, s))
            columns.append([*column[:j], diagonal])
            rhs[j:] = [c * rhs[j], -s * rhs[j]]
        y = [None] * m
        for j in reversed(range(m)):
            y[j] = (rhs[j] - sum(columns[k][j] * y[k] for k in range(j + 1, m))) / columns[j][j]
        return x + sum(_spread(y[j], x) * basis[j] for j in range(m))

    return jax.lax.fori_loop(0, cycles, cycle, jnp.zeros_like(b))


def from_the_library(stencil, transposed, b, cycles, m):
    """jax.scipy's GMRES, the tolerance off."""
    apply = stencil.transpose if transposed else stencil.apply

    def solve(b, *coefficients):
        return library_gmres(apply, b, tol=0.0, atol=0.0, restart=m, maxiter=cycles)[0]

    return solve(b)


def compiled(stencil, loop, k, *extra):
    """(forward, both) of arrays, jitted."""

    @jax.custom_vjp
    def solve(b):
        return loop(stencil, False, b, k, *extra)

    solve.defvjp(lambda b: (solve(b), None), lambda _, g: (loop(stencil, True, g, k, *extra),))

    def both(b, g):
        u, pull = jax.vjp(solve, b)
        return u, pull(g)[0]

    return jax.jit(solve), jax.jit(both)


def compiled_for_any(stencil, loop, *extra):
    """(forward, both) of arrays and K, jitted: the bound of the loop is traced, so that a new K compiles nothing."""

    @jax.custom_vjp
    def solve(b, k):
        return loop(stencil, False, b, k, *extra)

    solve.defvjp(lambda b, k: (solve(b, k), k), lambda k, g: (loop(stencil, True, g, k, *extra), None))

    def both(b, g, k):
        u, pull = jax.vjp(lambda b: solve(b, k), b)
        return u, pull(g)[0]

    return jax.jit(solve), jax.jit(both)


def diffusion_calls(problem, solve):
    """(forward, both), jitted, of a solve(stencil, b) that is not differentiated itself."""
    b, g, kappa = (jnp.asarray(np.asarray(v)) for v in (problem.b, problem.g, problem.kappa))
    make = lambda kappa: stencils.diffusion(kappa, problem.dt, Backend)  # noqa: E731

    @jax.custom_vjp
    def solution(b, kappa):
        return solve(make(kappa), b)

    def forward(b, kappa):
        u = solution(b, kappa)
        return u, (u, kappa)

    def back(kept, g):
        u, kappa = kept
        found = solve(make(kappa), g)
        _, pull = jax.vjp(lambda kappa: make(kappa).apply(u), kappa)
        return found, pull(-found)[0]

    solution.defvjp(forward, back)
    return run_jitted(solution, b, g, kappa)


def run_jitted(solution, b, g, kappa):
    """(forward, both) of solution(b, κ)."""

    def both(b, kappa, g):
        u, pull = jax.vjp(solution, b, kappa)
        return u, pull(g)

    solve, differentiate = jax.jit(solution), jax.jit(both)
    return lambda: solve(b, kappa).block_until_ready(), lambda: jax.block_until_ready(differentiate(b, kappa, g))


def entries(problem):
    if problem.kappa is not None:
        prepare = lambda k: diffusion_calls(problem, lambda stencil, b: cg(stencil, False, b, k))  # noqa: E731
        yield Entry("JAX jit, CG", "implicit", [problem.k], prepare, same_as="CG")
        return
    stencil = stencils.make(problem, Backend, jnp.asarray)
    b, g = (jnp.asarray(np.asarray(v)) for v in (problem.b, problem.g))

    def prepare(k, loop, extra):
        forward, both = compiled(stencil, loop, k, *extra)
        return lambda: forward(b).block_until_ready(), lambda: jax.block_until_ready(both(b, g))

    if problem.name.startswith("heat"):
        yield Entry(
            "JAX jit, Jacobi", "implicit", [problem.k], partial(prepare, loop=jacobi, extra=()), same_as="Jacobi"
        )
        return
    m = problem.solver(1).restart
    yield Entry(
        f"JAX jit, GMRES({m})", "implicit", [problem.k], partial(prepare, loop=gmres, extra=(m,)), same_as=f"GMRES({m})"
    )


def entry_for_any(problem):
    """The same iterations with K as an argument, for heat, Burgers and Navier-Stokes."""
    stencil = stencils.make(problem, Backend, jnp.asarray)
    b, g = (jnp.asarray(np.asarray(v)) for v in (problem.b, problem.g))
    if problem.name.startswith("heat"):
        method, loop, extra = "Jacobi", jacobi, ()
    else:
        m = problem.solver(1).restart
        method, loop, extra = f"GMRES({m})", gmres, (m,)
    forward, both = compiled_for_any(stencil, loop, *extra)

    def prepare(k):
        bound = jnp.asarray(k)
        return lambda: forward(b, bound).block_until_ready(), lambda: jax.block_until_ready(both(b, g, bound))

    return Entry(f"JAX jit with K traced, {method}", "implicit", [problem.k], prepare, same_as=method)
