"""What the JAX solvers share: many steps, compiled ahead of time, and their gradient.

Each step is recomputed in the reverse pass (`jax.checkpoint`), so that one state per step is stored. That takes much
less memory than storing what each step needs. With JAX-CFD's limiter it also takes half the time, with its central
differences and in PhiFlow hardly more. Exponax is faster without it, and so is there twice."""

import jax
import jax.numpy as jnp
import numpy as np


class JaxFlow:
    CANNOT = {}  # noqa: RUF012
    RECOMPUTE = True

    def __init__(self, box):
        jax.config.update("jax_enable_x64", box.double)
        self.box = box
        self.dtype = jnp.float64 if box.double else jnp.float32

    def enter(self, u):
        """What a step takes, from a state."""
        return u

    def leave(self, carry):
        return carry

    def step(self, carry):
        raise NotImplementedError

    def rollout(self, steps):
        return self._compiled(lambda u: self._advance(u, steps), self._state())

    def gradient(self, steps):
        def misfit(u, target):
            return ((self._advance(u, steps) - target) ** 2).sum()

        return self._compiled(jax.value_and_grad(misfit), self._state(), self._state())

    def mean_drag(self, cylinder):
        start = jnp.asarray(cylinder.start(self.offsets), self.dtype)

        def mean(profile):
            def advance(u, _):
                inflow = u.at[0, :, 0].set(profile).at[1, :, 0].set(0.0)
                u, pressure = self.step_with_pressure(inflow)
                return u, cylinder.drag(self.centred(u), pressure)

            _, drags = jax.lax.scan(jax.checkpoint(advance), start, None, length=cylinder.steps)
            return drags[cylinder.steps // 2 :].mean()

        return self._compiled(jax.value_and_grad(mean), jnp.zeros(cylinder.n, self.dtype))

    def _advance(self, u, steps):
        step = jax.checkpoint(self.step) if self.RECOMPUTE else self.step
        return self.leave(jax.lax.scan(lambda carry, _: (step(carry), None), self.enter(u), None, length=steps)[0])

    def _state(self):
        return jnp.zeros((len(self.box.shape), *self.box.shape), self.dtype)

    def _compiled(self, function, *examples):
        """Compile now, so that what is timed afterwards is the run."""
        run = jax.jit(function).lower(*examples).compile()

        def call(*arguments):
            found = run(*(jnp.asarray(a, e.dtype) for a, e in zip(arguments, examples, strict=True)))
            return jax.tree_util.tree_map(np.asarray, found)

        return call
