"""SciPy: the same finite volumes, a sparse LU factorisation, and the adjoint by hand."""

import numpy as np
import scipy.sparse.linalg

from benchmarks import volumes


class Volumes:
    CANNOT = {}  # noqa: RUF012

    def __init__(self, plate):
        self.plate = plate
        cells = np.arange(plate.ny * plate.nx).reshape(plate.ny, plate.nx)
        self.pairs = volumes.neighbours(cells)
        self.left, self.right = cells[:, 0], cells[:, -1]
        self.b = np.zeros(cells.size)
        self.b[self.right] = plate.flux * plate.h

    def temperatures(self, rho):
        return self._factorised(rho).solve(self.b).reshape(rho.shape)

    def forward(self, rho):
        return self._compliance(self.plate.conductivity(rho).ravel(), self.temperatures(rho).ravel())

    def compliance(self, rho):
        k, t = self.plate.conductivity(rho).ravel(), self.temperatures(rho).ravel()
        of_k = self._of_conductivity(k, t, t)  # the operator is symmetric: the adjoint is the temperature
        of_k[self.right] -= (self.plate.flux * self.plate.h) ** 2 / (2 * k[self.right] ** 2)
        return self._compliance(k, t), self._of_rho(of_k, rho)

    def misfit(self, rho, observed):
        factorised = self._factorised(rho)
        t = factorised.solve(self.b)
        difference = t - observed.ravel()
        of_k = self._of_conductivity(self.plate.conductivity(rho).ravel(), t, factorised.solve(2 * difference))
        return float((difference**2).sum()), self._of_rho(of_k, rho)

    def _compliance(self, k, t):
        q, h = self.plate.flux, self.plate.h
        return float((q * h * (t[self.right] + q * h / (2 * k[self.right]))).sum())

    def _factorised(self, rho):
        entries = volumes.entries(self.plate.conductivity(rho).ravel(), self.pairs, self.left)
        return scipy.sparse.linalg.splu(scipy.sparse.csc_matrix(entries), permc_spec="MMD_AT_PLUS_A")

    def _of_conductivity(self, k, t, adjoint):
        """-adjoint · (dA/dk) t, from the fluxes over faces."""
        i, j = self.pairs
        flux = (t[i] - t[j]) * (adjoint[i] - adjoint[j])
        found = np.zeros(k.size)
        np.add.at(found, i, -flux * 2 * k[j] ** 2 / (k[i] + k[j]) ** 2)
        np.add.at(found, j, -flux * 2 * k[i] ** 2 / (k[i] + k[j]) ** 2)
        found[self.left] -= 2 * t[self.left] * adjoint[self.left]
        return found

    def _of_rho(self, of_k, rho):
        return of_k.reshape(rho.shape) * self.plate.conductivity_slope(rho)
