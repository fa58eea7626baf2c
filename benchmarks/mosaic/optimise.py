"""The optimisers of the tasks, the same for all solvers."""

import numpy as np
import torch


def lbfgs(value_and_gradient, start, iterations):
    """SciPy's L-BFGS, in float64. Returns the last point and the loss after each iteration."""
    from scipy.optimize import minimize  # with the peers

    shape, losses = np.shape(start), []

    def flat(point):
        value, gradient = value_and_gradient(point.reshape(shape))
        return float(value), np.asarray(gradient, np.float64).ravel()

    def note(intermediate_result):
        losses.append(float(f"{intermediate_result.fun:.4g}"))

    found = minimize(flat, np.ravel(start).astype(np.float64), jac=True, method="L-BFGS-B", callback=note,
                     options={"maxiter": iterations, "maxfun": 20 * iterations, "ftol": 0.0, "gtol": 0.0})  # fmt: skip
    return found.x.reshape(shape), losses


def adam(value_and_gradient, start, iterations, learning_rate):
    """Returns the last point and the values before each update."""
    point = torch.tensor(np.asarray(start, np.float64), requires_grad=True)
    optimiser = torch.optim.Adam([point], lr=learning_rate)
    values = []
    for _ in range(iterations):
        value, gradient = value_and_gradient(point.detach().numpy().copy())
        values.append(float(value))
        point.grad = torch.tensor(np.asarray(gradient, np.float64))
        optimiser.step()
    return point.detach().numpy(), values
