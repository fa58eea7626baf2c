"""A flow of `prdp.Flow` as a Tesseract, with the inputs that the flows of Mosaic have."""

from typing import Any, Literal

import numpy as np
import torch
from pydantic import BaseModel, Field
from rollout import rollout
from tesseract_core.runtime import Array, Differentiable, Float32, ShapeDType


class InputSchema(BaseModel):
    v0: Differentiable[Array[(None, None, None, None), Float32]] = Field(
        description="Velocity in the centres of the cells, (nx, ny, nz, d); nz = 1 and d = 2 for a plane flow"
    )
    viscosity: Differentiable[Array[(1,), Float32]] = Field(description="Kinematic viscosity")
    dt: Array[(1,), Float32] = Field(description="Time step")
    steps: int = Field(description="Number of time steps", ge=0)
    domain_extent: float = Field(description="Side of the domain", default=1.0, gt=0)
    boundary: list[Literal["periodic", "wall"]] = Field(
        description="One for all axes, or one per axis in the order x, y, z", default=["periodic"]
    )


class OutputSchema(BaseModel):
    result: Differentiable[Array[(None, None, None, None), Float32]] = Field(
        description="Velocity after the last step, as v0"
    )


def _evaluate(inputs: InputSchema, differentiated: set[str]) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """The tensors that get a gradient, by their names, and the result."""
    tensors = {name: torch.from_numpy(np.array(getattr(inputs, name))) for name in ("v0", "viscosity")}
    wanted = {name: tensors[name].requires_grad_() for name in sorted(differentiated)}
    dt = float(inputs.dt[0])
    return wanted, rollout(**tensors, dt=dt, steps=inputs.steps, extent=inputs.domain_extent, boundary=inputs.boundary)


def apply(inputs: InputSchema) -> OutputSchema:
    return OutputSchema(result=_evaluate(inputs, set())[1].numpy())


def vector_jacobian_product(
    inputs: InputSchema, vjp_inputs: set[str], vjp_outputs: set[str], cotangent_vector: dict[str, Any]
) -> dict[str, Any]:
    wanted, result = _evaluate(inputs, vjp_inputs)
    cotangent = torch.as_tensor(np.array(cotangent_vector["result"]), dtype=result.dtype)
    gradients = torch.autograd.grad(result, list(wanted.values()), cotangent)
    return {name: gradient.numpy() for name, gradient in zip(wanted, gradients, strict=True)}


def abstract_eval(abstract_inputs: Any) -> dict[str, ShapeDType]:
    return {"result": ShapeDType(shape=abstract_inputs.v0.shape, dtype=abstract_inputs.v0.dtype)}
