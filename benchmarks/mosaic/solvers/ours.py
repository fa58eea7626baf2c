"""This library: `prdp.Flow`, one call per step.

Components are on the low faces, component 0 along the last axis: nothing is converted. Diffusion is explicit where that
is stable, as in the other libraries, else implicit."""

import torch
from torch.utils.checkpoint import checkpoint

import prdp_torch as prdp
from benchmarks.mosaic import fields

if not hasattr(prdp, "Flow"):
    raise ImportError("this prdp_torch has no Flow")


class Ours:
    CANNOT = {}  # noqa: RUF012

    def __init__(self, box):
        dim, h = len(box.shape), box.length / box.shape[0]
        self.box, self.dtype = box, torch.float64 if box.double else torch.float32
        self.offsets = fields.low_faces(dim)
        self.flow = prdp.Flow(
            box.shape,
            box.nu,
            box.dt,
            boundary=("wall", "periodic") if box.boundary == "channel" else "periodic",
            length=box.length,
            obstacle=None if box.obstacle is None else torch.as_tensor(box.obstacle),
            diffusion="explicit" if 2 * dim * box.nu * box.dt <= h**2 else "implicit",
            solver=self.solver(box),
        )

    @staticmethod
    def solver(box):
        return prdp.CG(100, rtol=box.rtol, preconditioner="multigrid")

    def rollout(self, steps):
        @torch.no_grad()
        def run(u0):
            return self._advance(self._tensor(u0), steps)[0].numpy()

        return run

    def gradient(self, steps):
        def run(u0, target):
            u = self._tensor(u0).requires_grad_()
            value = ((self._advance(u, steps) - self._tensor(target)) ** 2).sum()
            value.backward()
            return value.item(), u.grad[0].numpy()

        return run

    def mean_drag(self, cylinder):
        start = self._tensor(cylinder.start(self.offsets))

        def run(profile):
            profile = torch.as_tensor(profile, dtype=self.dtype).requires_grad_()
            u, drags = start, []
            for _ in range(cylinder.steps):
                inflow = u.clone()
                inflow[:, 0, :, 0], inflow[:, 1, :, 0] = profile, 0.0
                u, pressure = self.flow.step_and_pressure(inflow)
                drags.append(cylinder.drag(0.5 * (u[0, 0] + u[0, 0].roll(-1, -1)), pressure[0, 0]))
            mean = torch.stack(drags[cylinder.steps // 2 :]).mean()
            mean.backward()
            return mean.item(), profile.grad.numpy()

        return run

    def _advance(self, u, steps):
        """Single calls: `rollout` returns all states, which nothing here needs."""
        for _ in range(steps):
            u = self.flow(u)
        return u

    def _tensor(self, u):
        return torch.as_tensor(u, dtype=self.dtype)[None]


class Direct(Ours):
    """By FFT in periodic boxes."""

    @staticmethod
    def solver(box):
        return prdp.Direct()


class Recomputed(Direct):
    """The same, with the states of `BLOCK` steps at a time: the backward pass computes them again."""

    BLOCK = 16

    def _advance(self, u, steps):
        if not u.requires_grad:
            return super()._advance(u, steps)
        for done in range(0, steps, self.BLOCK):
            u = checkpoint(super()._advance, u, min(self.BLOCK, steps - done), use_reentrant=False)
        return u
