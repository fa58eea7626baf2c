"""JAX, jitted: explicit steps of incompressible flow in a periodic square, whose pressure is found by FFT, and the
gradient of many of them. The scheme is that of `prdp_torch.Flow` with `diffusion="explicit"`: central differences on a
staggered grid, each component on the faces before its points."""

import jax
import jax.numpy as jnp


def step(flow, nu, dt):
    """The state after one step of (u, v), (batch, ny, nx) each, on the unit square."""
    u, v = flow
    n = u.shape[-1]
    after = lambda a, axis: jnp.roll(a, -1, axis)  # noqa: E731
    before = lambda a, axis: jnp.roll(a, 1, axis)  # noqa: E731
    difference = lambda a, axis: n * (a - before(a, axis))  # noqa: E731
    laplacian = lambda a: sum(n * (difference(after(a, d), d) - difference(a, d)) for d in (-1, -2))  # noqa: E731
    uv = (u + before(u, -2)) * (v + before(v, -1)) / 4
    u_centred, v_centred = (u + after(u, -1)) / 2, (v + after(v, -2)) / 2
    u = u + dt * (nu * laplacian(u) - difference(u_centred**2, -1) - difference(after(uv, -2), -2))
    v = v + dt * (nu * laplacian(v) - difference(after(uv, -1), -1) - difference(v_centred**2, -2))
    divergence = difference(after(u, -1), -1) + difference(after(v, -2), -2)
    p = poisson(divergence)
    return u - difference(p, -1), v - difference(p, -2)


def poisson(divergence):
    """p without mean, L p = divergence, (batch, n, n)."""
    n = divergence.shape[-1]
    of_axis = n**2 * (2 * jnp.cos(2 * jnp.pi * jnp.arange(n) / n) - 2)
    symbol = (of_axis[:, None] + of_axis).at[0, 0].set(1.0)
    p = jnp.fft.rfft2(divergence).at[..., 0, 0].set(0.0) / symbol[:, : n // 2 + 1]
    return jnp.fft.irfft2(p, s=(n, n))


def with_gradient(start, target, steps, nu, dt):
    """A jitted call: (the state some steps after `start`, the gradient for `start` of half its squared distance from
    `target`)."""

    def end(flow):
        return jax.lax.scan(lambda flow, _: (step(flow, nu, dt), None), flow, None, length=steps)[0]

    def both(flow, target):
        found, pull = jax.vjp(end, flow)
        return found, pull(tuple(f - t for f, t in zip(found, target, strict=True)))[0]

    run = jax.jit(both)
    flow, goal = (tuple(jnp.asarray(v[:, d]) for d in range(2)) for v in (start, target))
    return lambda: tuple(jnp.stack(pair, 1) for pair in jax.block_until_ready(run(flow, goal)))
