"""torch-fem: bilinear finite elements with one conductivity per element. Its temperatures are at the nodes."""

import numpy as np
import torch
from torchfem import PlanarHeat
from torchfem.materials import IsotropicConductivity2D


class Elements:
    CANNOT = {}  # noqa: RUF012

    def __init__(self, plate):
        torch.set_default_dtype(torch.float64)
        self.plate = plate
        x, y = np.meshgrid(plate.h * np.arange(plate.nx + 1), plate.h * np.arange(plate.ny + 1))
        self.nodes = torch.as_tensor(np.stack([x.ravel(), y.ravel()], 1))
        first = (np.arange(plate.ny)[:, None] * (plate.nx + 1) + np.arange(plate.nx)).ravel()
        corners = np.stack([first, first + 1, first + plate.nx + 2, first + plate.nx + 1], 1)
        self.elements = torch.as_tensor(corners)
        load = np.full(plate.ny + 1, plate.flux * plate.h)
        load[[0, -1]] /= 2
        self.right = torch.arange(plate.ny + 1) * (plate.nx + 1) + plate.nx
        self.load = torch.zeros(len(self.nodes), 1)
        self.load[self.right, 0] = torch.as_tensor(load)

    def temperatures(self, rho):
        with torch.no_grad():
            return self._solve(self.plate.conductivity(torch.as_tensor(rho))).numpy()

    def forward(self, rho):
        with torch.no_grad():
            return self._compliance(self._solve(self.plate.conductivity(torch.as_tensor(rho)))).item()

    def compliance(self, rho):
        return self._with_gradient(rho, self._compliance)

    def misfit(self, rho, observed):
        return self._with_gradient(rho, lambda t: ((t - torch.as_tensor(observed)) ** 2).sum())

    def _with_gradient(self, rho, value_of):
        rho = torch.as_tensor(rho).clone().requires_grad_()
        value = value_of(self._solve(self.plate.conductivity(rho)))
        value.backward()
        return value.item(), rho.grad.numpy()

    def _compliance(self, t):
        return (self.load[:, 0] * t).sum()

    def _solve(self, k):
        material = IsotropicConductivity2D(kappa=k.ravel(), rho=torch.ones(k.numel()))
        model = PlanarHeat(self.nodes, self.elements, material)
        model.constraints[:: self.plate.nx + 1] = True
        model.heat_flux = self.load
        return model.solve(rtol=1e-10, atol=1e-12, differentiable_parameters=k if k.requires_grad else None)[0][:, 0]
