"""Maps of gradients: implicit beside unrolled, float32 beside float64, and how few iterations still train."""

import math

import torch

from benchmarks.atlas import problems
from benchmarks.atlas.solves import spaced
from prdp_torch.experiments import scenes
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train
from prdp_torch.solvers import CG, GMRES, Direct, Jacobi
from prdp_torch.steppers import Burgers, Heat


def gradient(stepper, u, cotangent):
    """Of ⟨cotangent, step(u)⟩ with respect to u and nu, as one vector per sample."""
    u = u.clone().requires_grad_()
    stepper(u).backward(cotangent)
    return u.grad.double().flatten(1)


def relative(found, true):
    """The error relative to the truth: the median over the samples."""
    return float(((found - true).norm(dim=1) / true.norm(dim=1)).median())


def make(kind, solver, backward, n=64):
    options = {"solver": solver, "backward": backward, "on_failure": "return"}
    if kind == "heat":
        return Heat((n,), 20.0 / (n + 1) ** 2, 1.0, **options)
    return Burgers((n,), 1e-3, 20.0 / n, **options)


def states(kind, n=64, dtype=torch.float64):
    _, u = problems.heat(1.0, n) if kind == "heat" else problems.burgers(1.0, n)
    return u.to(dtype), problems.noise(*u.shape, seed=1, dtype=dtype)


def implicit_unrolled(quick):
    """Error of the gradient for the state after K iterations, at nu dt/dx² = 20 and CFL number 20."""
    panels = {
        "heat, Jacobi": ("heat", lambda k: Jacobi(k, rtol=0.0), [1, 4, 16, 64, 256]),
        "heat, CG": ("heat", lambda k: CG(k, rtol=0.0), [1, 2, 4, 8, 16, 32]),
        "Burgers, Jacobi": ("burgers", lambda k: Jacobi(k, rtol=0.0), [1, 4, 8, 16, 32, 64, 128]),
        "Burgers, GMRES(4)": ("burgers", lambda k: GMRES(restart=4, max_iter=k, rtol=0.0), [1, 2, 4, 8, 16, 32]),
    }
    found = {}
    for name, (kind, solver, budgets) in panels.items():
        budgets = budgets[:2] if quick else budgets
        u, cotangent = states(kind)
        exact = make(kind, Direct(), "implicit")
        true, solution = gradient(exact, u, cotangent), exact(u).flatten(1)
        errors = {"implicit": [], "unrolled": [], "solution": []}
        for k in budgets:
            errors["solution"].append(relative(make(kind, solver(k), "none")(u).flatten(1), solution))
            for backward in ("implicit", "unrolled"):
                errors[backward].append(relative(gradient(make(kind, solver(k), backward), u, cotangent), true))
        found[name] = {"x": budgets, "lines": errors}
    jacobi, gmres = found["heat, Jacobi"]["lines"], found["Burgers, GMRES(4)"]["lines"]
    same = max(abs(i - u) for i, u in zip(jacobi["implicit"], jacobi["unrolled"], strict=True))
    better = sum(i < u for i, u in zip(gmres["implicit"], gmres["unrolled"], strict=True))
    answer = (
        f"with Jacobi they agree for b (to {max(same, 1e-16):.0e}); with GMRES the implicit one is closer for {better} "
        f"of {len(gmres['implicit'])} budgets"
    )
    return {"panels": found, "answer": answer}


def float32_gradient(quick):
    """Error of the gradient with converged solves in float32 and in float64, the worst sample, over the CFL number."""
    n, x = 64, spaced(0.1, 320, 2 if quick else 8)
    solvers = {"Jacobi": Jacobi(3000), "GMRES(2)": GMRES(restart=2, max_iter=1500), "GMRES(10)": GMRES(max_iter=300)}
    u, cotangent = states("burgers", n)
    panels = {}
    for backward in ("implicit", "unrolled"):
        lines = panels[backward] = {}
        for name, solver in solvers.items():
            for dtype in (torch.float32, torch.float64):
                errors = lines[f"{name}, {str(dtype).removeprefix('torch.')}"] = []
                for cfl in x:
                    true = gradient(Burgers((n,), 1e-3, cfl / n, Direct()), u, cotangent)
                    step = Burgers((n,), 1e-3, cfl / n, solver, backward=backward, on_failure="return")
                    found = gradient(step, u.to(dtype), cotangent.to(dtype))
                    errors.append(float(((found - true).norm(dim=1) / true.norm(dim=1)).max()))
    implicit, unrolled = panels["implicit"], panels["unrolled"]
    excess = max(
        single / double
        for name in solvers
        for single, double in zip(implicit[f"{name}, float32"], implicit[f"{name}, float64"], strict=True)
        if double > 1e-6  # else its own rounding, about 1e-7
    )
    small = unrolled["GMRES(2), float64"]
    off = next((cfl for cfl, error in zip(x, small, strict=True) if error > 0.1), math.nan)
    answer = (
        f"implicit: no, at most {excess:.1f} times the error of float64; unrolled GMRES(2) is off from CFL {off:g} on "
        "in both"
    )
    return {"x": x, "panels": panels, "answer": answer}


def few_iterations(quick):
    """The scene heat_1d with constant K, and with what chooses K by itself."""
    scene = scenes.load("heat_1d")
    scene.training.intervals = 3 if quick else 100
    budgets = [1, 25] if quick else [1, 2, 3, 4, 5, 6, 8, 10, 15, 25]
    metric = [train(scene, Refinement.constant(k))["metric"][-1] for k in budgets]
    automatic = train(scene, Refinement.auto())
    tolerated = 1.1 * metric[-1]
    fewest = next(k for k, error in zip(budgets, metric, strict=True) if error <= tolerated)
    return {
        "x": budgets,
        "lines": {"constant K": metric},
        "auto": automatic["metric"][-1],
        "fewest": fewest,
        "answer": f"K = {fewest} is within 10 % of K = {budgets[-1]}",
    }
