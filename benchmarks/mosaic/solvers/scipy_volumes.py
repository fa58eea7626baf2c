"""SciPy: the same finite volumes, a sparse LU factorisation, and the adjoint by hand."""

import numpy as np
import scipy.sparse
import scipy.sparse.linalg


class Volumes:
    CANNOT = {}  # noqa: RUF012

    def __init__(self, plate):
        self.plate = plate
        cells = np.arange(plate.ny * plate.nx).reshape(plate.ny, plate.nx)
        self.pairs = np.concatenate(
            [np.stack([a.ravel(), b.ravel()]) for a, b in ((cells[:, :-1], cells[:, 1:]), (cells[:-1], cells[1:]))], 1
        )
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
        k = self.plate.conductivity(rho).ravel()
        i, j = self.pairs
        weight = 2 * k[i] * k[j] / (k[i] + k[j])
        diagonal = np.zeros(k.size)
        for cells, added in ((i, weight), (j, weight), (self.left, 2 * k[self.left])):
            np.add.at(diagonal, cells, added)
        entries = (np.concatenate([-weight, -weight, diagonal]),
                   (np.concatenate([i, j, np.arange(k.size)]), np.concatenate([j, i, np.arange(k.size)])))  # fmt: skip
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
