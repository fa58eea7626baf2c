"""This library on a problem: every solver that fits, in every derivative mode."""

import prdp_torch as prdp
from benchmarks.entries import Entry
from benchmarks.peers import stencils
from benchmarks.problems import gradient_of
from prdp_torch import _C


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
    if problem.kappa is not None:
        scaled = lambda k: prdp.CG(k, rtol=0.0, preconditioner="diagonal")  # noqa: E731
        cycles = lambda k: prdp.CG(k, rtol=0.0, preconditioner="multigrid")  # noqa: E731
        few = budgets(problem.k)
        return {
            "CG": (problem.solver, few),
            "CG, diagonal": (scaled, few),
            "CG, multigrid": (cycles, [1, 2, 4, 8]),
        } | exact
    if problem.name.startswith("burgers"):
        jacobi = {"Jacobi": (lambda k: prdp.Jacobi(k, rtol=0.0), budgets(2 * problem.k))}
        return {"GMRES(2)": (problem.solver, budgets(problem.k))} | jacobi | exact
    multigrid = {
        "GMRES(6), multigrid": (
            lambda k: prdp.GMRES(k, rtol=0.0, restart=6, preconditioner="multigrid"), [1, 2, 4, 8])
    }  # fmt: skip
    return {"GMRES(8)": (problem.solver, budgets(problem.k))} | multigrid | exact


def entries(problem, modes=("implicit", "unrolled")):
    for label, (solver, ks) in methods(problem).items():
        for mode in modes:
            if mode == "unrolled" and (label == "direct" or problem.kappa is not None):
                continue  # the same computation as implicit; and the field is there for that one

            def prepare(k, solver=solver, mode=mode):
                return calls(problem, solver(k), mode)

            def applications(k, solver=solver, mode=mode):
                return products(problem, solver(k), mode)

            yield Entry(label, mode, ks, prepare, applications)
    if problem.kappa is not None:
        yield from through_function(problem)


def through_function(problem):
    """CG on `operators.Function`, products of torch operations: what a user writes without a Stencil. As in the eager
    loop, the coefficients are made of the field once, not in every product."""

    def product(v, diagonal, *sides):
        lower, upper = ({axis: sides[2 * axis + first] for axis in (-1, -2)} for first in (0, 1))
        return stencils.Upwind(diagonal, lower, upper, stencils.TorchBackend).apply(v)

    def operator_of(b, kappa):
        a = stencils.diffusion(kappa, problem.dt, stencils.TorchBackend)
        sides = [side[axis] for axis in (-2, -1) for side in (a.lower, a.upper)]
        return prdp.operators.Function(product, tensors=(a.diagonal, *sides), symmetric=True)

    yield Entry(
        "CG, Function", "implicit", [problem.k],
        lambda k: calls(problem, problem.solver(k), "implicit", operator_of),
        lambda k: products(problem, problem.solver(k), "implicit"),
    )  # fmt: skip


def calls(problem, solver, mode, operator_of=None):
    leaves = problem.leaves()
    operator_of = operator_of or problem.operator_of
    operator = operator_of(*(leaf.detach() for leaf in leaves))
    # Only a field is differentiated for besides b: without one the operator stays.
    operator_of_leaves = (lambda *_: operator) if problem.kappa is None else operator_of

    def forward():
        forget(solver)
        return prdp.linear_solve(operator, problem.b, solver, backward="none", on_failure="return")[0]

    def both():
        forget(solver)
        for leaf in leaves:
            leaf.grad = None
        u, _ = prdp.linear_solve(operator_of_leaves(*leaves), leaves[0], solver, backward=mode, on_failure="return")
        u.backward(problem.g)
        return u.detach(), gradient_of(*leaves)

    return forward, both


def forget(solver):
    """The factors of the call before: what is timed is a solve with a new matrix."""
    if solver.method == "direct":
        _C.clear_factorisations()


def products(problem, solver, mode):
    """Products with A or Aᵀ of (the solve, the solve and its derivative), means over the batch."""
    leaf = problem.b.clone().requires_grad_()
    u, info = prdp.linear_solve(problem.operator, leaf, solver, backward=mode, on_failure="return")
    u.backward(problem.g)
    forward = float(info.operator_applications.double().mean())
    # The reverse of the unrolled mode takes as many products as the iterations, the final residual aside.
    back = forward if info.adjoint is None else float(info.adjoint.operator_applications.double().mean())
    return forward, forward + back
