"""A gradient beside central differences in random directions."""

import numpy as np

STEPS = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 5.0)  # relative to the root mean square of the point


def compare(value, point, gradient, directions, seed=0, steps=STEPS):
    """The cosine and the median relative error of the directional derivatives, at the best of the step sizes, and the
    error at each of them. The directions are normal with a root mean square of 1."""
    generator = np.random.default_rng(seed)
    point, gradient = np.asarray(point, np.float64), np.asarray(gradient, np.float64)
    scale = np.sqrt((point**2).mean())
    chosen = generator.standard_normal((directions, *point.shape))
    exact = np.array([(gradient * direction).sum() for direction in chosen])
    if not np.isfinite(exact).all():
        return {"finite": False}
    found = []
    for step in steps:
        h = step * scale
        slopes = np.array([(value(point + h * d) - value(point - h * d)) / (2 * h) for d in chosen])
        errors = np.abs(exact / slopes - 1)
        cosine = exact @ slopes / (np.linalg.norm(exact) * np.linalg.norm(slopes))
        found.append({"step": step, "cosine": float(cosine), "median_error": float(np.median(errors))})
    finite = [of_step for of_step in found if np.isfinite(of_step["median_error"])]
    best = min(finite, key=lambda of_step: of_step["median_error"])
    return {"finite": True, **best, "errors": [float(f"{of_step['median_error']:.3g}") for of_step in found]}
