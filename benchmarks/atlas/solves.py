"""Maps of solves: how many products with A a method takes, and what it says where it breaks."""

import math
from typing import NamedTuple

import torch

from benchmarks.atlas import problems
from prdp_torch import operators
from prdp_torch.solve import SolveStatus, linear_solve
from prdp_torch.solvers import CG, GMRES, BiCGStab, Chebyshev, Direct, Jacobi, SteepestDescent


def solve(a, b, solver):
    return linear_solve(a, b, solver, backward="none", on_failure="return")


class Outcome(NamedTuple):
    share: float
    """Of the samples, those that are solved."""
    status: str
    """The most frequent one."""
    products: float | None
    """With A, the median over the samples; None where some are not solved."""


def outcome(a, b, solver):
    info = solve(a, b, solver)[1]
    share = float((info.status > 0).double().mean())
    products = float(info.operator_applications.double().median()) if share == 1.0 else None
    return Outcome(share, SolveStatus(int(info.status.mode().values)).name, products)


def spaced(low, high, count):
    """Numbers from low to high, even in their logarithms, of two digits."""
    return [
        float(f"{x:.2g}") for x in torch.logspace(*map(math.log10, (low, high)), count, dtype=torch.float64).tolist()
    ]


def lines(x, problem, solvers):
    """Products with A of each solver over x."""
    return {
        "x": x,
        "lines": {name: [outcome(*problem(value), solver).products for value in x] for name, solver in solvers.items()},
    }


def table(x, rows, problem, solver_of):
    """What comes of each row over x."""
    cells = [[outcome(*problem(value), solver_of(row)) for value in x] for row in rows]
    of = {field: [[getattr(cell, field) for cell in row] for row in cells] for field in Outcome._fields}
    return {"x": x, "rows": [str(row) for row in rows], **of}


def _table_of_solvers(x, problem, solvers, of_x="every CFL number"):
    """A table, whose answer are the solvers that solve every sample everywhere."""
    data = table(x, list(solvers), problem, solvers.get)
    always = " · ".join(name for name, row in zip(data["rows"], data["share"], strict=True) if min(row) == 1.0)
    return {**data, "answer": f"{of_x}: {always}"}


def _gmres(restart, products, **options):
    """As many cycles as there are products for; one of each is for the residual."""
    return GMRES(restart=restart, max_iter=products // (restart + 1), **options)


def _of_burgers(products):
    """Solvers that are given so many products each."""
    return {
        "Jacobi": Jacobi(products),
        "SteepestDescent": SteepestDescent(products),
        "CG": CG(products),
        "BiCGStab": BiCGStab(products // 2),
        **{f"GMRES({m})": _gmres(m, products) for m in (2, 10, 64)},
    }


def stiffness(quick):
    x = spaced(0.01, 1e4, 4 if quick else 13)
    most = 40000
    solvers = {
        "Jacobi": Jacobi(most),
        "Chebyshev": Chebyshev(most),
        "SteepestDescent": SteepestDescent(most),
        "CG": CG(most),
        "GMRES(10)": GMRES(max_iter=4000),
    }
    data = lines(x, problems.heat, solvers)
    at_end = {name: values[-1] for name, values in data["lines"].items()}
    answer = f"at nu dt/dx² = {x[-1]:,.0f}: Jacobi {at_end['Jacobi']:,.0f} products, CG {at_end['CG']:,.0f}"
    return {**data, "answer": answer}


def grid_size(quick):
    x = [8, 16] if quick else [8, 16, 32, 64, 96]
    solvers = {
        "Jacobi": Jacobi(100000),
        "Chebyshev": Chebyshev(100000),
        "SteepestDescent": SteepestDescent(100000),
        "CG": CG(10000),
        "GMRES(10)": GMRES(max_iter=20000),
    }

    def problem(n):
        return operators.Poisson((n, n)), problems.noise(2, 1, n, n)

    data = lines(x, problem, solvers)

    def order(name):
        first, last = data["lines"][name][0], data["lines"][name][-1]
        return math.log(last / first) / math.log(x[-1] / x[0])

    answer = "products as " + ", ".join(f"N^{order(name):.1f} with {name}" for name in ("Jacobi", "Chebyshev", "CG"))
    return {**data, "answer": answer}


def float32_floor(quick):
    """The residual where 1e-7 was asked for, which no solver may meet."""
    x = [16, 512] if quick else [8, 16, 32, 64, 128, 256, 512, 1024, 2048]
    ways = {"CG": lambda n: CG(8 * n, rtol=1e-7), "Direct": lambda n: Direct(max_iter=3, rtol=1e-7)}
    found = {}
    for dtype in (torch.float32, torch.float64):
        for name, solver in ways.items():
            residuals = []
            for n in x:
                _, info = solve(operators.Poisson((n,)), problems.noise(8, 1, n, dtype=dtype), solver(n))
                residuals.append(float(info.residual.max()))
            found[f"{name}, {str(dtype).removeprefix('torch.')}"] = residuals

    def first_above(name):
        return next((n for n, r in zip(x, found[f"{name}, float32"], strict=True) if r > 1e-5), None)

    first = {name: first_above(name) for name in ways}
    answer = ", ".join(f"N = {n} with {name}" for name, n in first.items())
    return {"x": x, "lines": found, "first": first, "answer": f"{answer}; float64 meets it on all of them"}


def contrast(quick):
    x = spaced(1, 1e6, 3 if quick else 13)
    solvers = {
        "CG": CG(20000),
        'CG, preconditioner="diagonal"': CG(20000, preconditioner="diagonal"),
        "GMRES(20)": GMRES(restart=20, max_iter=1000),
        "Jacobi": Jacobi(40000),
    }
    data = lines(x, problems.diffusion, solvers)
    plain, scaled = data["lines"]["CG"], data["lines"]['CG, preconditioner="diagonal"']

    def saves(share):
        return next((c for c, p, s in zip(x, plain, scaled, strict=True) if s <= (1 - share) * p), None)

    third, half = saves(1 / 3), saves(1 / 2)
    points = f"{third or math.nan:,.0f} on, half from {half or math.nan:,.0f} on"
    answer = f"the diagonal saves a third of the products from {points}"
    return {**data, "third": third, "half": half, "answer": answer}


def burgers_solvers(quick):
    return _table_of_solvers(spaced(0.1, 1000, 3 if quick else 9), problems.burgers, _of_burgers(3000))


def burgers_amplitude(quick):
    x = spaced(0.01, 1000, 3 if quick else 11)
    data = _table_of_solvers(x, problems.burgers_of_amplitude, _of_burgers(3000), "every amplitude")
    shares = dict(zip(data["rows"], data["share"], strict=True))
    last = max(value for value, share in zip(x, shares["CG"], strict=True) if share == 1.0)
    return {**data, "last": last, "answer": f"CG up to a Péclet number of {last:g}; {data['answer']}"}


def burgers_restart(quick):
    x = spaced(0.1, 1000, 3 if quick else 9)
    rows = [2, 32] if quick else [1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64]
    data = table(x, rows, problems.burgers, lambda m: _gmres(m, 3000))
    whole = [m for m, row in zip(rows, data["share"], strict=True) if min(row) == 1.0]
    smallest = next((m for m in rows if all(n in whole for n in rows if n >= m)), None)
    solved = [c for c, share in zip(x, data["share"][rows.index(2)], strict=True) if share == 1.0]
    answer = f"m = 2 up to CFL {max(solved):g}, m = {smallest} up to CFL {x[-1]:g}"
    return {**data, "smallest": smallest, "answer": answer}


def flow_solvers(quick):
    x = spaced(0.1, 100, 2 if quick else 7)
    solvers = {
        "Jacobi": Jacobi(4000),
        "SteepestDescent": SteepestDescent(4000),
        "CG": CG(4000),
        "BiCGStab": BiCGStab(2000),
        **{f"GMRES({m})": _gmres(m, 4000) for m in (2, 8, 20, 50)},
        "GMRES(8), multigrid": _gmres(8, 4000, preconditioner="multigrid"),
    }
    return _table_of_solvers(x, problems.flow, solvers)


def flow_grid(quick):
    x = [8, 16] if quick else [8, 16, 32, 48, 64, 96]
    solvers = {
        "BiCGStab": BiCGStab(4000),
        "GMRES(8)": _gmres(8, 8000),
        "GMRES(8), multigrid": _gmres(8, 8000, preconditioner="multigrid"),
    }
    data = lines(x, problems.flow_of_size, solvers)
    taken = [data["lines"][name][-1] for name in ("GMRES(8)", "GMRES(8), multigrid")]
    answer = f"at {x[-1]}²: GMRES(8) {taken[0] or math.nan:,.0f} products, with multigrid {taken[1]:,.0f}"
    return {**data, "answer": answer}


def hyperdiffusion(quick):
    """The boundary of Jacobi is known: ratio = 1/4."""
    x = [0.1, 0.24, 0.26, 1.0] if quick else [*spaced(0.01, 0.2, 6), 0.22, 0.24, 0.26, 0.3, *spaced(0.4, 10.0, 6)]
    solvers = {"Jacobi": Jacobi(40000), "CG": CG(4000), "GMRES(10)": GMRES(max_iter=400)}
    data = lines(x, problems.hyperdiffusion, solvers)
    last = max(value for value, taken in zip(x, data["lines"]["Jacobi"], strict=True) if taken is not None)
    status = outcome(*problems.hyperdiffusion(x[-1]), Jacobi(40000)).status
    answer = f"beyond nu dt/dx⁴ = 1/4: solved at {last:g}, {status} at {x[-1]:g}"
    return {**data, "last": last, "answer": answer}


def known_matrices(quick):
    del quick
    solvers = {
        "Jacobi": Jacobi(3000),
        "SteepestDescent": SteepestDescent(3000),
        "CG": CG(3000),
        "BiCGStab": BiCGStab(3000),
        "GMRES(1)": GMRES(restart=1, max_iter=3000),
        "GMRES(2)": GMRES(restart=2, max_iter=3000),
        "GMRES(16)": GMRES(restart=16, max_iter=3000),
        "Direct": Direct(),
    }
    cases = problems.matrices()
    status = [[outcome(a, b, solver).status for solver in solvers.values()] for a, b in cases.values()]
    solved = {name: sum(row[i].startswith("CONV") for row in status) for i, name in enumerate(solvers)}
    most = max(solved.values())
    best = [name for name, count in solved.items() if count == most]
    answer = f"the status of each; {' and '.join(best)} solve{'s' * (len(best) == 1)} {most} of {len(cases)}"
    return {"x": list(solvers), "rows": list(cases), "status": status, "answer": answer}


def primal_adjoint(quick):
    """Lines: b is an eigenvector, the cotangent is not. Outcomes: how often one of the two converges alone."""
    budgets = [1, 4] if quick else [1, 2, 4, 8, 16, 32, 64, 128, 256]
    points = torch.arange(1, 31, dtype=torch.float64) / 31
    b = torch.sin(2 * math.pi * points)[None, None].requires_grad_()
    residuals = {"primal": [], "adjoint": []}
    for k in budgets:
        u, info = linear_solve(operators.Poisson((30,)), b, SteepestDescent(k))
        u.backward(problems.noise(1, 1, 30))
        residuals["primal"].append(float(info.residual))
        residuals["adjoint"].append(float(info.adjoint.residual))
    outcomes = {}
    solvers = {"SteepestDescent": SteepestDescent(300), "CG": CG(300), "BiCGStab": BiCGStab(150),
               "GMRES(2)": _gmres(2, 300), "GMRES(4)": _gmres(4, 300), "Jacobi": Jacobi(300)}  # fmt: skip
    a, winds = problems.burgers(100.0, n=16, batch=32 if quick else 256)
    cotangent = problems.noise(*winds.shape, seed=1)
    for name, solver in solvers.items():
        u, info = linear_solve(a, winds.clone().requires_grad_(), solver, on_failure="return")
        u.backward(cotangent)
        there, back = info.status > 0, info.adjoint.status > 0
        found = (there & back, there & ~back, ~there & back, ~there & ~back)
        outcomes[name] = [float(which.double().mean()) for which in found]
    only = {name: shares[1] for name, shares in outcomes.items()}
    worst = max(only, key=only.get)
    answer = (
        f"yes: after 1 iteration and not after {budgets[-1]}; with {worst} on {only[worst]:.0%} of random operators"
    )
    return {"x": budgets, "lines": residuals, "outcomes": outcomes, "answer": answer}
