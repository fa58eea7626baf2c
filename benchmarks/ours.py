"""This library on a problem: every solver that fits, in every derivative mode."""

from typing import NamedTuple

import prdp_torch as prdp


class Entry(NamedTuple):
    """A way to solve a problem. `prepare(k)` gives two callables: the solution, and (solution, gradient),
    finished when they return."""

    label: str
    mode: str  # "implicit" or "unrolled"
    ks: list  # budgets to run; [None] where there is none to choose
    prepare: callable
    applications: callable = None  # (forward, both) products with A of a run with K
    same_as: str | None = None  # the method of ours that runs the same iteration with the same K


def budgets(k):
    """From one iteration to four times the usual number."""
    return sorted({max(1, round(k * share)) for share in (0.03, 0.06, 0.12, 0.25, 0.5, 1, 2, 4)})


def methods(problem):
    """{label: (K to solver, budgets)}."""
    exact = {"direct": (lambda k: prdp.Direct(k, rtol=0.0), [1])}
    if problem.name.startswith("heat"):
        few = budgets(max(6, problem.k // 3))
        return {
            "Jacobi": (problem.solver, budgets(problem.k)),
            "Chebyshev": (lambda k: prdp.Chebyshev(k, rtol=0.0), budgets(problem.k // 2)),
            "steepest descent": (lambda k: prdp.SteepestDescent(k, rtol=0.0), budgets(problem.k)),
            "CG": (lambda k: prdp.CG(k, rtol=0.0), few),
        } | exact
    if problem.name.startswith("burgers"):
        jacobi = {"Jacobi": (lambda k: prdp.Jacobi(k, rtol=0.0), budgets(2 * problem.k))}
        return {"GMRES(2)": (problem.solver, budgets(problem.k))} | jacobi | exact
    stokes = {
        "GMRES(6), Stokes": (
            lambda k: prdp.GMRES(k, rtol=0.0, restart=6, preconditioner="stokes"), [1, 2, 4, 8])
    }  # fmt: skip
    return {"GMRES(8)": (problem.solver, budgets(problem.k))} | stokes | exact


def entries(problem, modes=("implicit", "unrolled")):
    for label, (solver, ks) in methods(problem).items():
        for mode in modes:
            if mode == "unrolled" and label == "direct":
                continue  # the same computation as implicit

            def prepare(k, solver=solver, mode=mode):
                return calls(problem, solver(k), mode)

            def applications(k, solver=solver, mode=mode):
                return products(problem, solver(k), mode)

            yield Entry(label, mode, ks, prepare, applications)


def calls(problem, solver, mode):
    leaf = problem.b.clone().requires_grad_()

    def forward():
        return prdp.linear_solve(problem.operator, problem.b, solver, backward="none", on_failure="return")[0]

    def both():
        leaf.grad = None
        u, _ = prdp.linear_solve(problem.operator, leaf, solver, backward=mode, on_failure="return")
        u.backward(problem.g)
        return u.detach(), leaf.grad

    return forward, both


def products(problem, solver, mode):
    """Products with A or Aᵀ of (the solve, the solve and its derivative), means over the batch."""
    leaf = problem.b.clone().requires_grad_()
    u, info = prdp.linear_solve(problem.operator, leaf, solver, backward=mode, on_failure="return")
    u.backward(problem.g)
    forward = float(info.operator_applications.double().mean())
    # The reverse of the unrolled mode takes as many products as the iterations, the final residual aside.
    back = forward if info.adjoint is None else float(info.adjoint.operator_applications.double().mean())
    return forward, forward + back
