"""This library: finite volumes as an `operators.Stencil`, solved by CG and differentiated by itself."""

import torch

import prdp_torch as prdp

PRECONDITIONER = "multigrid" if hasattr(prdp, "Multigrid") else "diagonal"
OFFSETS = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]


class Ours:
    CANNOT = {}  # noqa: RUF012

    def __init__(self, plate):
        self.plate = plate
        self.solver = prdp.CG(20 * plate.nx, rtol=1e-10, preconditioner=PRECONDITIONER)

    def temperatures(self, rho):
        with torch.no_grad():
            return self._solve(self._conductivity(rho)).numpy()

    def compliance(self, rho):
        return self._with_gradient(rho, self._compliance)

    def misfit(self, rho, observed):
        return self._with_gradient(rho, lambda k, t: ((t - torch.as_tensor(observed)) ** 2).sum())

    def forward(self, rho):
        """NaN where a step of the differences has left the conductivities that are positive."""
        with torch.no_grad():
            k = self._conductivity(rho)
            return self._compliance(k, self._solve(k)).item() if bool((k > 0).all()) else float("nan")

    def _with_gradient(self, rho, value_of):
        rho = torch.as_tensor(rho).clone().requires_grad_()
        k = self._conductivity(rho)
        value = value_of(k, self._solve(k))
        value.backward()
        return value.item(), rho.grad.numpy()

    def _conductivity(self, rho):
        return self.plate.conductivity(torch.as_tensor(rho))

    def _compliance(self, k, t):
        q, h = self.plate.flux, self.plate.h
        return (q * h * (t[:, -1] + q * h / (2 * k[:, -1]))).sum()

    def _solve(self, k):
        along_y, along_x = _harmonic(k[:-1], k[1:]), _harmonic(k[:, :-1], k[:, 1:])
        pad = torch.nn.functional.pad
        low_x, high_x = pad(along_x, (1, 0)), pad(along_x, (0, 1))
        low_y, high_y = pad(along_y, (0, 0, 1, 0)), pad(along_y, (0, 0, 0, 1))
        to_the_left = pad(2 * k[:, :1], (0, k.shape[1] - 1))  # T = 0 half a cell away
        diagonal = low_x + high_x + low_y + high_y + to_the_left
        coefficients = torch.stack([diagonal, -low_x, -high_x, -low_y, -high_y])[None]
        b = torch.zeros_like(k)
        b[:, -1] = self.plate.flux * self.plate.h
        operator = prdp.operators.Stencil(coefficients, OFFSETS, boundary="zero")
        u, info = prdp.linear_solve(operator, b[None, None], self.solver)
        if not info.solved[0]:
            raise RuntimeError(f"CG: residual {info.residual[0]:.1e} after {info.iterations[0]} iterations")
        return u[0, 0]


def _harmonic(a, b):
    return 2 * a * b / (a + b)
