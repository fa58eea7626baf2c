"""Every method on every operator, in every way that it can fail: what is refused, which status it is, what is said."""

import itertools
import re

import pytest
import torch
from helpers import field, statuses

import prdp_torch as prdp
from prdp_torch import operators

K = 200
BY_DIAGONAL = {"preconditioner": "diagonal"}
SOLVERS = {
    "Jacobi": prdp.Jacobi(K),
    "Chebyshev": prdp.Chebyshev(K),
    "SteepestDescent": prdp.SteepestDescent(K),
    "CG": prdp.CG(K),
    'CG with preconditioner="diagonal"': prdp.CG(K, **BY_DIAGONAL),
    "BiCGStab": prdp.BiCGStab(K),
    "GMRES(3)": prdp.GMRES(K, restart=3),
    'GMRES(3) with preconditioner="diagonal"': prdp.GMRES(K, restart=3, **BY_DIAGONAL),
    'GMRES(3) with preconditioner="multigrid"': prdp.GMRES(K, restart=3, preconditioner="multigrid"),
    "Direct": prdp.Direct(),
}
DIVIDING = [name for name in SOLVERS if name == "Jacobi" or "diagonal" in name]
OPERATORS = ["Heat", "Poisson", "Burgers", "NavierStokes", "Stencil", "Function", "Matrix", "CSR"]
PLAIN = ["SteepestDescent", "CG", "BiCGStab", "GMRES(3)", "Direct"]


def is_refused(method, operator):
    """Methods that do not suit an operator, whatever its numbers are."""
    if method == "Chebyshev":
        return operator not in ("Heat", "Poisson")
    if "multigrid" in method:
        return operator in ("Function", "Matrix", "CSR")
    return operator == "Function" and method in DIVIDING


PAIRS = [pair for pair in itertools.product(SOLVERS, OPERATORS) if not is_refused(*pair)]
INF = float("inf")
MATRICES = {  # fine, unless the way to fail is a matter of the matrix
    "inf": [[1.0, INF], [0.0, 1.0]],
    "zero diagonal": [[0.0, 1.0], [1.0, 0.0]],
    "turn": [[0.0, 1.0], [-1.0, 0.0]],
    "singular": [[1.0, 1.0], [1.0, 1.0]],
    "strong": [[1.0, 0.9, 0.9], [0.9, 1.0, 0.9], [0.9, 0.9, 1.0]],
    "small": [[0.1, 0.0], [0.0, 0.1]],
}
COEFFICIENTS = {"zero diagonal": [0.0, 1.0, -1.0], "strong": [1.0, 5.0, 5.0]}


def make_operator(name, way, dtype):
    strength = 50.0 if way == "strong" else 0.1
    bad = INF if way == "inf" else 1.0
    if name == "Heat":
        return operators.Heat((8,), 1e-3, 1.0)
    if name == "Poisson":
        return operators.Poisson((8,))
    if name == "Burgers":
        w = strength * field((8,), batch=1, seed=1, dtype=dtype)
        w[0, 0, 3] *= bad
        return operators.Burgers(w, 1e-3, 1.0)
    if name == "NavierStokes":
        w = strength * field((4, 4), batch=1, channels=3, seed=2, dtype=dtype)
        w[0, 0, 1, 1] *= bad
        return operators.NavierStokes(w, 1e-3, 1.0)
    if name == "Stencil":
        c = torch.tensor(COEFFICIENTS.get(way, [3.0, -1.0, -1.0]), dtype=dtype).view(1, 3, 1).repeat(1, 1, 8)
        c[0, 1, 2] *= bad
        return operators.Stencil(c, [(0,), (-1,), (1,)])
    m = torch.tensor(MATRICES.get(way, [[2.0, 1.0], [1.0, 2.0]]), dtype=dtype)
    if name == "Function":
        return operators.Function(lambda v: v @ m.mT, symmetric=torch.equal(m, m.mT))
    return m.to_sparse_csr() if name == "CSR" else m


def make_rhs(operator, way, dtype):
    """Two samples: zero, which every method solves, and the one in question."""
    if operator in ("Heat", "Poisson", "Burgers", "Stencil"):
        b = field((8,), batch=1, dtype=dtype)
    elif operator == "NavierStokes":
        b = field((4, 4), batch=1, channels=3, dtype=dtype)
        b[:, 2] += (1.0 if way == "mean pressure" else 0.0) - b[:, 2].mean()
    else:
        b = torch.tensor([[1.0, 0.0] if way in ("zero diagonal", "turn") else [1.0, 2.0]], dtype=dtype)
        b = torch.arange(1.0, 4.0, dtype=dtype)[None] if way == "strong" else b
    if way == "nan":
        b.view(-1)[1] = torch.nan
    if way in ("huge", "small"):
        b = b / b.abs().max() * torch.finfo(dtype).max * 0.9
    return torch.cat([torch.zeros_like(b), b])


# Where a failure must come up: what is to be said with it, and of which methods and operators.
KRYLOV = (
    r"A is (not symmetric \(‖A v - Aᵀ v‖ is [\d.]+ ‖A v‖ .*\); take GMRES"
    "|symmetric but not definite to float..: take MINRES)"
)
WEAKER = "(GMRES|CG if A is positive definite, else MINRES)"
WAYS = {
    "nan": ("NONFINITE_INPUT", r" at index \(((0, )+1|1,)\), ",
            "the (right-hand side|cotangent) is NaN or Inf there; look at", PAIRS),
    "inf": ("NONFINITE_OPERATOR", r" at index \([\d, ]+\), ", "A is made of a NaN or Inf; look at the state",
            [(m, o) for m, o in PAIRS if o in ("Burgers", "NavierStokes", "Stencil", "Matrix", "CSR")]),
    "zero diagonal": ("ZERO_DIAGONAL", r" in row \([\d, ]+\), ",
                      "(the pressure rows have a|it divides by the diagonal of A, which has a) zero.*; take [GM].*RES",
                      [(m, o) for m, o in PAIRS
                       if m in DIVIDING and o in ("NavierStokes", "Stencil", "Matrix", "CSR")]),
    "turn": ("BREAKDOWN", r" \(the iterate handed out has relative residual [\d.e-]+ after \d+ iterations\), ",
             f"r·A r is zero for a residual r(: {KRYLOV}|, or u grew without end; take {WEAKER})",
             [(m, o) for m in ("SteepestDescent", "CG", "BiCGStab") for o in ("Function", "Matrix", "CSR")]),
    "singular": ("BREAKDOWN", r" \(the iterate .*\), ",
                 "(A is singular to float64, or nearly so; GMRES solves it"
                 "|.*A is singular, and b lies outside its range[;,].* take a b"
                 f"|.*{KRYLOV}|r·A r is zero for a residual r, or u grew without end; take {WEAKER})",
                 [(m, o) for m in ("CG", "BiCGStab", "GMRES(3)", "Direct") for o in ("Function", "Matrix", "CSR")]
                 + [(m, o) for m in DIVIDING if m != "Jacobi" for o in ("Matrix", "CSR")]),
    "strong": ("DIVERGED", r" \(the iterate .*\), ",
               "the residual grew beyond (1e13 )?‖b‖"
               f"(, as an eigenvalue of I - D⁻¹A is larger than 1.*; take {WEAKER}|: {KRYLOV})",
               [("Jacobi", "Stencil"), ("Jacobi", "Matrix"), ("Jacobi", "CSR"), ("SteepestDescent", "Stencil"),
                ('CG with preconditioner="diagonal"', "Burgers")]),
    "mean pressure": ("INCONSISTENT", r" \(the iterate .*\), ",
                      r"[\d.]+ % of (b|the cotangent) is the mean of its pressure",
                      [(m, "NavierStokes") for m in SOLVERS
                       if m == "BiCGStab" or (m[0] in "GD" and m not in DIVIDING)]),
    "small": ("OVERFLOW", r" \(the iterate .*\), ",
              r"a number left the range of float64 \((‖A‖ is 0.1, )?‖b‖ is (above )?[\d.e+]+\); scale A and b",
              [(m, o) for m in (*PLAIN, "Jacobi") for o in ("Matrix", "CSR")] + [(m, "Function") for m in PLAIN]),
}  # fmt: skip
DTYPE = torch.float64


@pytest.mark.parametrize("way", WAYS)
def test_every_failure_names_method_operator_sample_number_and_remedy(way):
    status, where, said, pairs = WAYS[way]
    found = []
    for method, operator in PAIRS:
        a, b, solver = make_operator(operator, way, DTYPE), make_rhs(operator, way, DTYPE), SOLVERS[method]
        info = prdp.linear_solve(a, b, solver, on_failure="return")[1]
        failed = info.failed.tolist()
        if not failed[1]:
            continue
        known = "Matrix" if operator == "CSR" else operator
        with pytest.raises(torch.linalg.LinAlgError) as error:
            prdp.linear_solve(a, b, solver)
        text = str(error.value)
        assert text.startswith(f"linear_solve: {sum(failed)} of 2 samples failed: sample "), text
        mine = text[text.index("sample 1 ") :]
        reason = mine if " on " in mine else text  # what is the same is said once, of sample 0
        assert f", {method} on {known}: " in reason and "did not reach its tolerance" not in reason, text
        if statuses(info)[1] == status and (method, operator) in pairs:
            assert re.match(f"sample 1 {status}{where.removesuffix(', ')}", mine), text
            assert re.search(f" on {known}: {said}", reason), text
            found.append((method, operator))
    assert set(found) == set(pairs)


@pytest.mark.parametrize("way", ["nan", "mean pressure", "turn", "singular", "small"])
def test_an_adjoint_solve_says_the_same_of_its_cotangent(way):
    status, _, said, pairs = WAYS[way]
    found = []
    for method, operator in pairs:
        if operator == "NavierStokes" and method in DIVIDING:
            continue  # refused in the forward solve
        b = make_rhs(operator, way, DTYPE)
        u, _ = prdp.linear_solve(
            make_operator(operator, way, DTYPE), torch.zeros_like(b, requires_grad=True), SOLVERS[method]
        )
        known = "Matrix" if operator == "CSR" else operator
        with pytest.raises(
            torch.linalg.LinAlgError,
            match=f"^adjoint solve: 1 of 2 samples failed: sample 1 {status}.* on {known}: {said}",
        ):
            u.backward(b)
        found.append((method, operator))
    assert len(found) >= len(pairs) - len(DIVIDING)


def test_what_does_not_suit_an_operator_is_refused_with_a_remedy():
    for method, operator in itertools.product(SOLVERS, OPERATORS):
        if is_refused(method, operator):
            with pytest.raises(ValueError, match=r"take CG or GMRES|is for Heat, Poisson, Burgers|give diagonal, or"):
                prdp.linear_solve(make_operator(operator, "", DTYPE), make_rhs(operator, "", DTYPE), SOLVERS[method])


def test_float32_is_named_where_its_range_is_left():
    for method in (*PLAIN, "Jacobi"):
        a, b = make_operator("Matrix", "small", torch.float32), make_rhs("Matrix", "small", torch.float32)
        with pytest.raises(torch.linalg.LinAlgError, match=r"left the range of float32 \(.*\); take float64, or scale"):
            prdp.linear_solve(a, b, SOLVERS[method])


def test_a_function_of_nan_is_named():
    """The norm of a function is not known, so that its numbers are not looked at beforehand."""
    for method in PLAIN:
        a, b = make_operator("Function", "inf", DTYPE), make_rhs("Function", "inf", DTYPE)
        info = prdp.linear_solve(a, b, SOLVERS[method], on_failure="return")[1]
        assert statuses(info)[1] == "OVERFLOW" and not info.residual.isnan().any()
        with pytest.raises(
            torch.linalg.LinAlgError,
            match="on Function: A v is NaN or Inf for a vector v of ones; look at the state, the weights or the file",
        ):
            prdp.linear_solve(a, b, SOLVERS[method])
