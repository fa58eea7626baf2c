"""lineax (JAX): its CG and GMRES on the stencils, to its tolerance, differentiated by itself."""

from functools import partial

import jax
import jax.numpy as jnp
import lineax
import numpy as np

from benchmarks.entries import Entry
from benchmarks.peers import stencils
from benchmarks.peers.jax_loops import Backend, run_jitted

RTOL = 1e-5  # also the absolute tolerance: right-hand sides are of unit size, and the test is elementwise
LOOSER = 1e-4  # for diffusion, where float32 stops short of the other


def solve_diffusion(problem, b, kappa):
    stencil = stencils.diffusion(kappa, problem.dt, Backend)
    solver = lineax.CG(LOOSER, LOOSER, max_steps=10 * problem.k)

    def of_one(v):
        shape = jax.eval_shape(lambda: v)
        operator = lineax.FunctionLinearOperator(stencil.apply, shape, lineax.positive_semidefinite_tag)
        return lineax.linear_solve(operator, v, solver, throw=False).value

    return jax.vmap(lambda v: of_one(v[None])[0])(b)


def entries(problem):
    if problem.kappa is not None:
        b, g, kappa = (jnp.asarray(np.asarray(v)) for v in (problem.b, problem.g, problem.kappa))
        prepare = lambda _: run_jitted(partial(solve_diffusion, problem), b, g, kappa)  # noqa: E731
        yield Entry("lineax, CG", "implicit", [None], prepare)
        return
    stencil = stencils.make(problem, Backend, jnp.asarray)
    b, g = (jnp.asarray(np.asarray(v)) for v in (problem.b, problem.g))
    if problem.name.startswith("heat"):
        solver, tags, label = lineax.CG(RTOL, RTOL), lineax.positive_semidefinite_tag, "CG"
    else:
        m = max(20, problem.solver(1).restart)
        solver, tags, label = lineax.GMRES(RTOL, RTOL, restart=m, stagnation_iters=m), (), f"GMRES({m})"

    def regular(v):
        """Navier-Stokes with the mean pressure added: to lineax a singular operator is an error."""
        product = stencil.apply(v)
        if problem.name != "navier_stokes":
            return product
        return product.at[:, 2].add(v[:, 2].mean((-2, -1), keepdims=True))

    def system(b):
        operator = lineax.FunctionLinearOperator(regular, jax.eval_shape(lambda: b), tags)
        return lineax.linear_solve(operator, b, solver, throw=False).value

    def solve(b):
        if problem.winds is not None:  # the samples' matrices differ: the batch is one system
            return system(b)
        return jax.vmap(lambda v: system(v[None])[0])(b)

    def both(b, g):
        u, pull = jax.vjp(solve, b)
        return u, pull(g)[0]

    def prepare(_):
        jitted, jitted_both = jax.jit(solve), jax.jit(both)
        return lambda: jitted(b).block_until_ready(), lambda: jax.block_until_ready(jitted_both(b, g))

    yield Entry(f"lineax, {label}", "implicit", [None], prepare)
