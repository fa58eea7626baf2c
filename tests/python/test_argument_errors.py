"""Arguments and settings out of range, of a wrong type or misspelt: clear errors, tested by their words."""

import math
import re

import numpy as np
import pytest
import torch
from helpers import field
from test_errors import heat

import prdp_torch as prdp
from prdp_torch import operators


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: prdp.Jacobi(-1), "Jacobi: max_iter must be >= 0, got -1"),
        (lambda: prdp.Jacobi(2**63), f"Jacobi: max_iter must be less than 2\\*\\*63, got {2**63}"),
        (
            lambda: prdp.Heat((2**70,), 1e-3, 1.0, prdp.Jacobi(1)),
            r"Heat: every extent of shape must be less than 2\*\*63",
        ),
        (lambda: prdp.CG(3, rtol=10**400), r"CG: rtol must be less than 2\*\*1024"),
        (lambda: prdp.CG(3, rtol=-1e-5), "CG: rtol must be >= 0, got -1e-05"),
        (lambda: prdp.SteepestDescent(3, rtol=math.nan), "SteepestDescent: rtol must be >= 0, got nan"),
        (lambda: heat(backward="adjoint"), "backward: unknown name 'adjoint'; allowed: implicit, unrolled, none"),
        (
            lambda: heat(on_failure="ignore"),
            "on_failure: unknown name 'ignore'; allowed: raise, warn, return, zero_grad",
        ),
        (lambda: heat(adjoint_max_iter=-2), "Heat: adjoint_max_iter must be >= 0, got -2"),
        (lambda: heat(adjoint_rtol=-1.0), "Heat: adjoint_rtol must be >= 0, got -1"),
        (lambda: prdp.Heat((30,), -1e-3, 1.0, prdp.Jacobi(1)), "Heat: nu must be finite and >= 0, got -0.001"),
        (lambda: prdp.Heat((30,), 1e-3, -1.0, prdp.Jacobi(1)), "Heat: dt must be finite and > 0, got -1"),
        (lambda: prdp.Poisson((0,), prdp.Jacobi(1)), r"Poisson: every extent of shape must be >= 1, got \[0\]"),
    ],
)
def test_arguments_out_of_range(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_step_costs_no_memory_until_it_is_taken():
    for kind in (prdp.Heat, prdp.Burgers, prdp.NavierStokes):
        assert kind((10**7, 10**7), 1e-3, 1.0, prdp.Jacobi(1)).max_iter == 1  # a field would take 400 TB
        with pytest.raises(ValueError, match=r"\[1099511627776, 1099511627776\] has more than 2\*\*63 numbers"):
            kind((2**40, 2**40), 1e-3, 1.0, prdp.Jacobi(1))


def test_arguments_out_of_range_where_they_reach_the_op():
    a, b = operators.Heat((5,), 1e-3, 1.0), field((5,))
    solver = prdp.Jacobi(3)
    solver.max_iter = -1
    with pytest.raises(ValueError, match="linear_solve: max_iter must be >= 0, got -1"):
        prdp.linear_solve(a, b, solver)
    with pytest.raises(ValueError, match="linear_solve: adjoint_rtol must be >= 0, got -1"):
        prdp.linear_solve(a, b, prdp.Jacobi(3), adjoint_rtol=-1.0)
    with pytest.raises(ValueError, match="backward: unknown name 'both'"):
        prdp.linear_solve(a, b, prdp.Jacobi(3), backward="both")


def test_a_viscosity_that_turns_bad_is_found_at_the_step():
    nu = torch.tensor(1e-3, dtype=torch.float64)
    step = prdp.Heat((5,), nu, 1.0, solver=prdp.Jacobi(3))
    nu.fill_(-1.0)
    with pytest.raises(ValueError, match="Heat: nu must be finite and >= 0, got -1"):
        step(field((5,)))


def test_k_must_stay_a_number_of_iterations():
    step = heat()
    with pytest.raises(ValueError, match="Heat: max_iter must be >= 0, got -3"):
        step.max_iter = -3
    assert step.max_iter == 3


def test_tolerances_are_checked_when_they_are_set():
    step = heat()
    for wrong, error, message in (("x", TypeError, "must be a real number, got 'x'"), (-1, ValueError, "must be >= 0")):
        for name in ("rtol", "adjoint_rtol"):
            with pytest.raises(error, match=f"Heat: {name} {message}"):
                setattr(step, name, wrong)
    step.rtol, step.adjoint_rtol = 0, None
    assert step.rtol == 0.0 and step.adjoint_rtol is None


def test_wrong_kinds_of_arguments():
    with pytest.raises(TypeError, match=r"solver must be a Solver such as Jacobi\(10\), got 'jacobi'"):
        prdp.linear_solve(torch.eye(2), torch.ones(2), "jacobi")
    with pytest.raises(TypeError, match=r"Heat: solver must be a Solver such as Jacobi\(10\), got 10"):
        heat(solver=10)
    with pytest.raises(TypeError, match="A must be an operator or a tensor, got list"):
        prdp.linear_solve([[1.0]], torch.ones(1), prdp.Jacobi(1))


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: prdp.Jacobi(2.5), "Jacobi: max_iter must be a whole number, got 2.5"),
        (lambda: prdp.Jacobi(True), "Jacobi: max_iter must be a whole number, got True"),
        (lambda: prdp.CG(3, rtol="tight"), "CG: rtol must be a real number, got 'tight'"),
        (lambda: prdp.Heat(30, 1e-3, 1.0, prdp.Jacobi(1)), r"Heat: shape must be a tuple .* such as \(30,\), got 30"),
        (lambda: prdp.Poisson((30.5,), prdp.Jacobi(1)), "Poisson: every extent of shape must be a whole number"),
        (lambda: prdp.Heat((30,), "a", 1.0, prdp.Jacobi(1)), "Heat: nu must be a real number, got 'a'"),
        (lambda: prdp.Heat((30,), 1e-3, None, prdp.Jacobi(1)), "Heat: dt must be a real number, got None"),
        (lambda: operators.Heat((30,), 1e-3, torch.tensor(0.1)), r"got tensor\(0.1000\); take .item\(\), as it"),
        (lambda: heat(backward=None), "Heat: backward must be a string, got None"),
        (lambda: heat(adjoint_max_iter="3"), "Heat: adjoint_max_iter must be a whole number, got '3'"),
        (lambda: heat()([0.0] * 30), "Heat: u must be a torch tensor, got list"),
        (lambda: heat()(torch.zeros(2, 1, 30).to_sparse()), "Heat: u must be a dense tensor, got one of layout"),
        (lambda: setattr(heat(), "max_iter", 1.5), "Heat: max_iter must be a whole number, got 1.5"),
        (lambda: prdp.linear_solve(torch.eye(2), [1.0, 2.0], prdp.Jacobi(1)), "linear_solve: b must be a torch tensor"),
        (lambda: prdp.PRDPController(heat()), r"PRDPController: steppers must be a list such as \[heat\], got Heat"),
        (lambda: prdp.PRDPController([3]), "PRDPController: a stepper must have max_iter, got 3"),
        (lambda: prdp.PRDPController(tau=0.9), "PRDPController: unknown setting 'tau'; allowed: tau_step, tau_stop"),
        (lambda: prdp.PRDPController(delta=2.5), "PRDPController: delta must be a whole number, got 2.5"),
        (lambda: prdp.PRDPController().step("low"), "PRDPController: metric must be a real number, got 'low'"),
    ],
)  # fmt: skip
def test_wrong_types(call, message):
    with pytest.raises(TypeError, match=message):
        call()


@pytest.mark.parametrize("make, expected", [
    (lambda: prdp.Heat((8,), 1e-2, 1.0, prdp.CG(5), onfailure="warn"),
     "Heat: unknown argument 'onfailure'; allowed: shape, nu, dt, solver, backward, length, .*, on_failure"),
    (lambda: prdp.Flow((8, 8), 1e-2, 1e-3, bounday="wall"), "Flow: unknown argument 'bounday'; allowed: .*boundary"),
    (lambda: prdp.ImplicitStep(lambda u: None, solver=prdp.CG(5), strat="state"),
     "ImplicitStep: unknown argument 'strat'; allowed: operator, rhs, .*, start"),
])  # fmt: skip
def test_an_argument_that_no_stepper_has_is_named_with_those_it_has(make, expected):
    with pytest.raises(TypeError, match=expected):
        make()


@pytest.mark.parametrize("name, expected", [
    ("max_iters", "Heat: no setting 'max_iters'; did you mean 'max_iter'?"),
    ("adjoint_tol", "Heat: no setting 'adjoint_tol'; did you mean 'adjoint_rtol'?"),
    ("onfailure", "Heat: no setting 'onfailure'; did you mean 'on_failure'?"),
    ("solver", "Heat: the solver cannot be set later; max_iter, rtol, restart and preconditioner can"),
])  # fmt: skip
def test_a_misspelt_setting_is_refused(name, expected):
    step = heat()
    with pytest.raises(AttributeError, match=re.escape(expected)):
        setattr(step, name, 50)
    assert not hasattr(step, name) and step.max_iter == 3


@pytest.mark.parametrize("solver, name, allowed", [
    (prdp.CG(5), "max_itr", "max_iter, rtol, preconditioner"),
    (prdp.CG(5), "restart", "max_iter, rtol, preconditioner"),
    (prdp.CG(5), "method", "max_iter, rtol, preconditioner"),
    (prdp.GMRES(max_iter=5), "restrat", "max_iter, rtol, preconditioner, restart"),
    (prdp.Multigrid(), "smooth", "max_iter, rtol, smoothing"),
])  # fmt: skip
def test_a_setting_that_no_solver_has_is_refused(solver, name, allowed):
    with pytest.raises(AttributeError, match=f"^{type(solver).__name__}: no setting '{name}'; allowed: {allowed}$"):
        setattr(solver, name, 50)
    assert name not in vars(solver)


def test_other_attributes_are_free():
    """Those of another name, and all of a user's own stepper and solver."""

    class OwnSolver(prdp.CG):
        max_itr: int

    solver = OwnSolver(5)
    solver.max_itr = 3
    assert solver.max_itr == 3 and solver.max_iter == 5

    class Own(prdp.Stepper):
        def __init__(self):
            super().__init__(prdp.CG(5))
            self.solver, self.max_iters = "mine", 3

        def operator(self, u):
            return operators.Heat((8,), 1e-2, 1.0)

    step = heat()
    step.label, step.name = "fine", "heat"
    assert Own().max_iters == 3 and step.label == "fine"


CSR = (torch.arange(4), torch.arange(3), torch.ones(3))


@pytest.mark.parametrize("call, error, said", [
    (lambda: prdp.Solver(10), TypeError, "Solver: is the base of all solvers; take one of them, such as CG or GMRES"),
    (lambda: operators.Matrix.csr(*CSR, ()), ValueError, "Matrix.csr: size must be (n, n)"),
    (lambda: operators.Matrix.csr(*CSR, -1), ValueError, "Matrix.csr: size must be (n, n)"),
    (lambda: operators.Matrix(torch.eye(3)).apply([1.0]), TypeError,
     "Matrix.apply: v must be a torch tensor, got list"),
    (lambda: operators.Matrix(torch.eye(3)).dense(torch.int64), TypeError,
     "Matrix.dense: dtype must be torch.float32 or torch.float64, got torch.int64"),
    (lambda: operators.Matrix(torch.eye(3).to_sparse()), ValueError, "torch.sparse_coo; take A.to_sparse_csr()"),
    (lambda: prdp.CG(5, preconditioner=lambda r: r), TypeError, "that returns M⁻¹ r is operators.Function(apply)"),
    (lambda: prdp.linear_solve(lambda v: v, torch.ones(1, 3), prdp.CG(5)), TypeError, "operators.Function(matvec)"),
    (lambda: prdp.ImplicitStep(lambda u: len, None, prdp.CG(5))(torch.ones(1, 3)), TypeError,
     "operators.Function(matvec)"),
    (lambda: prdp.ToleranceController().step(torch.tensor(1j)), TypeError, "error must be a real number, got 1j"),
    (lambda: prdp.PRDPController().step(-0.9), ValueError, "got -0.9; smaller is better, as in 1 - accuracy"),
    (lambda: operators.Matrix(torch.eye(3), nullspace=torch.tensor(1.0)), TypeError,
     "Matrix: nullspace must be None, 'constant' or a tensor (k, *shape), got tensor(1.)"),
    (lambda: prdp.detach_failed(torch.ones(1, 3), heat().info), TypeError,
     "detach_failed: info must be the SolveInfo of the solve that made u, got None"),
    (lambda: prdp.check_operator(torch.eye(3), torch.ones(1, 3), "cg"), TypeError,
     "check_operator: solver must be a Solver such as CG(10), got 'cg'"),
    (lambda: prdp.check_operator(torch.eye(3), torch.ones(1, 3, dtype=torch.int64)), TypeError,
     "check_operator: example must be float32 or float64, got torch.int64"),
    (lambda: operators.Poisson((3,)).dense("float64"), TypeError,
     "Poisson.dense: dtype must be torch.float32 or torch.float64, got 'float64'"),
    (lambda: operators.Poisson((3,)).apply(None), TypeError, "Poisson.apply: v must be a torch tensor, got NoneType"),
    (lambda: prdp.warm_up(heat(), None), TypeError, "warm_up: example must be a torch tensor, got NoneType"),
    (lambda: prdp.linear_solve(torch.eye(3).repeat(2, 1, 1), torch.ones(2, 4, 3), prdp.Direct()), ValueError,
     "got [2, 4, 3]; for several right-hand sides of a matrix, take torch.func.vmap over them"),
    (lambda: prdp.linear_solve(torch.eye(3).repeat(2, 1, 1), torch.ones(2, 3, 1), prdp.Direct()), ValueError,
     "got [2, 3, 1]; for several right-hand sides of a matrix, take torch.func.vmap over them"),
    (lambda: prdp.linear_solve(torch.ones(2, 3, 3), torch.ones(2, 1, 3, 3), prdp.Direct()), ValueError,
     "got [2, 1, 3, 3]; if A is a field, give an operator that is made of it, such as Diffusion"),
    (lambda: prdp.linear_solve(torch.ones(2, 1, 3, 3), torch.ones(2, 1, 3, 3), prdp.Direct()), ValueError,
     "got (2, 1, 3, 3); if it is a field, give an operator that is made of it, such as Diffusion"),
    (lambda: prdp.linear_solve(torch.eye(3), torch.ones(2, 4, 3), prdp.Direct()), ValueError,
     "got [2, 4, 3]; the right-hand sides of one matrix are samples: b.flatten(0, 1)"),
    (lambda: heat().bfloat16()(torch.ones(1, 1, 30, dtype=torch.bfloat16)), TypeError,
     "Heat: expected float32 or float64, got bfloat16; keep the step in float32, and let autocast take the network"),
    (lambda: prdp.linear_solve(torch.eye(3).repeat(2, 1, 1), torch.ones(3), prdp.Direct()), ValueError,
     "A holds 2 matrices, b holds 1 right-hand side; expand b, so that each has its own"),
])  # fmt: skip
def test_what_strangers_tried(call, error, said):
    with pytest.raises(error, match=re.escape(said)):
        call()


def test_an_array_of_one_number_is_a_metric():
    controller = prdp.ToleranceController()
    for error in (np.array(0.5), np.float32(0.4), torch.tensor([0.3]), torch.tensor(0.2)):
        controller.step(error)
    assert [record.error for record in controller.history] == pytest.approx([0.5, 0.4, 0.3, 0.2])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("wanted", [torch.float32, torch.float64])
def test_a_matrix_is_dense_in_any_dtype(dtype, wanted):
    a = torch.rand(2, 3, 3, dtype=dtype)
    crow, col = torch.arange(0, 10, 3), torch.arange(3).repeat(3)
    forms = [operators.Matrix(a), operators.Matrix.csr(crow, col, a.flatten(1), 3), operators.Matrix(a[0])]
    for form, expected in zip(forms, (a, a, a[0]), strict=True):
        assert torch.equal(form.dense(wanted), expected.to(wanted))
    assert torch.equal(operators.Matrix(a[0].to_sparse_csr()).dense(wanted), a[0].to(wanted))
