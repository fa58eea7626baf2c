"""Arguments at the ends of their ranges: refused by name, or taken for what they are; nothing is bad_alloc."""

import pytest
import torch

import prdp_torch as prdp

TERABYTES = r"would take [\d.e+]+ GB, and this machine has [\d.e+]+ GB"


def heat(**options):
    return prdp.Heat((30,), nu=1e-3, dt=1.0, solver=prdp.Jacobi(2), **options)


def test_a_start_that_is_set_later_is_checked():
    step = heat()
    for wrong, kind in (("State", ValueError), ("", ValueError), (None, TypeError), (1, TypeError)):
        with pytest.raises(kind, match="start"):
            step.start = wrong
        assert step.start == "zero"
    step.start = "state"
    u = torch.randn(2, 1, 30, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    a = step.operator().dense()
    product = u @ a.T
    scale = (u * product).sum(-1, keepdim=True) / product.square().sum(-1, keepdim=True)
    x = scale * u
    for _ in range(2):
        x = x + (u - x @ a.T) / a.diagonal()
    torch.testing.assert_close(step(u), x, rtol=1e-12, atol=0)


def controllers():
    return (
        prdp.PRDPController(),
        prdp.ToleranceController(),
        prdp.LinearSchedule(initial=1, increment=1, maximum=9),
    )


@pytest.mark.parametrize("error", [float("nan"), float("inf"), -1.0])
def test_an_error_that_is_no_number_is_refused_and_changes_nothing(error):
    for controller in controllers():
        before = controller.state_dict()
        name = type(controller).__name__
        with pytest.raises(ValueError, match=f"{name}: error must be finite and >= 0, got "):
            controller.step(error) if isinstance(controller, prdp.ToleranceController) else controller.step(
                1, error=error
            )
        assert controller.state_dict() == before


OF_THE_METRIC = (
    {"history": [(-1.0, 1.0, 1, False, None, None)]},
    {"history": [(1.0, float("inf"), 1, False, None, None)]},
)


@pytest.mark.parametrize(
    "change",
    [
        {"max_iter": -1},
        {"max_iter": "1"},
        {"max_iter": 1.5},
        {"max_iter": 2**63},
        {"checkpoint": float("nan")},
        {"checkpoint": -1.0},
        {"history": [(1.0, 1.0, -3, False, None, None)]},
        *OF_THE_METRIC,
        {"history": [(1.0, 1.0, 1, False, float("nan"), None)]},
        {"history": [(1.0, 1.0, 1, False, None, -1.0)]},
        {"history": [(1.0, 1.0)]},
        {"history": None},
    ],
    ids=str,
)
def test_a_state_that_no_controller_can_have_reached_is_refused_and_changes_nothing(change):
    for controller in controllers():
        controller.step(1.0)
        before = controller.state_dict()
        if isinstance(controller, prdp.LinearSchedule) and change in OF_THE_METRIC:
            continue  # which a schedule ignores
        with pytest.raises(ValueError, match=f"^{type(controller).__name__}: .*(state|max_iter)") as error:
            controller.load_state_dict({**before, **change})
        assert "\n" not in str(error.value) and controller.state_dict() == before


@pytest.mark.parametrize("k", [2**53 + 1, 2**62 + 1, 2**63 - 1])
@pytest.mark.parametrize("ratio", [1e-12, 0.1, 0.5, 1.0])
def test_the_share_of_an_adjoint_solve_lies_between_one_and_k(k, ratio):
    step = heat()
    prdp.PRDPController([step], initial=k, adjoint_ratio=ratio)
    assert step.max_iter == k and 1 <= step.adjoint_max_iter <= k
    assert step.adjoint_max_iter == pytest.approx(ratio * k, rel=1e-9, abs=1)
    prdp.PRDPController([step], initial=3, adjoint_ratio=1e-12)
    assert step.adjoint_max_iter == 1  # none at all would be no gradient
    prdp.PRDPController([step], initial=0, adjoint_ratio=0.5)
    assert step.adjoint_max_iter == 0


@pytest.mark.parametrize("restart", [10**6, 2**62])
def test_a_restart_that_does_not_fit_into_memory_is_refused_with_its_size(restart):
    solver = prdp.GMRES(3, restart=restart)
    step = prdp.Burgers((512, 512), nu=1e-2, dt=1e-2, solver=solver)
    u = torch.randn(1, 2, 512, 512)
    own = prdp.ImplicitStep(step.operator, solver=solver)
    a = step.operator(u)
    calls = [lambda: step(u), lambda: step.rollout(u, 2), lambda: own(u), lambda: prdp.linear_solve(a, u, solver)]
    for call in calls:
        with pytest.raises(
            ValueError, match=f"GMRES: restart = {restart} on 524288 unknowns {TERABYTES}; lower restart"
        ):
            call()
    small = prdp.Burgers((16,), nu=1e-2, dt=1e-2, solver=solver)  # where a restart beyond n is n
    small(torch.randn(2, 1, 16))
    assert small.converged


@pytest.mark.parametrize(
    "operator, unknowns",
    [
        (lambda: prdp.operators.Poisson((2**31, 2**33)), 2**64),
        (lambda: prdp.operators.Poisson((2**30, 2**30)), 2**60),
        (lambda: prdp.operators.Heat((1000, 1000), 1e-3, 1.0), 10**6),
        (lambda: prdp.operators.Burgers(torch.zeros(3, 2, 400, 400), 1e-3, 1.0), 2 * 400**2),
        (lambda: prdp.operators.NavierStokes(torch.zeros(1, 2, 400, 400), 1e-3, 1.0), 3 * 400**2),
        (lambda: prdp.operators.Stencil(torch.ones(1, 1, 10**6), [(0,)]), 10**6),
        (lambda: prdp.operators.Matrix.csr(*csr(10**6)), 10**6),
    ],
    ids=["beyond 2**63", "beyond 2**53", "heat", "burgers", "navier_stokes", "stencil", "csr"],
)
def test_a_dense_matrix_that_does_not_fit_into_memory_is_refused_with_its_size(operator, unknowns):
    a = operator()
    with pytest.raises(ValueError, match=rf"^{type(a).__name__}: dense\(\) of {unknowns} unknowns {TERABYTES}; apply"):
        a.dense()


def csr(n):
    return torch.arange(n + 1), torch.arange(n), torch.ones(n), n


def test_dense_matrices_that_fit_are_made():
    for a in (
        prdp.operators.Poisson((3, 2)),
        prdp.operators.Burgers(torch.zeros(3, 2, 4, 5), 1e-3, 1.0),
        prdp.operators.Matrix(torch.ones(3, 4, 4)),
        prdp.operators.Matrix.csr(*csr(5)),
    ):
        assert a.dense(torch.float32).shape[-1] == a._unknowns()


def test_a_log_of_an_adjoint_solve_is_closed_by_no_code_that_could_be_interrupted():
    step = prdp.ImplicitStep(torch.eye(3), solver=prdp.CG(1))
    assert not hasattr(type(step._adjoint_log), "__del__")
    number = prdp.solve.AdjointLog().number  # of a log that is closed again
    u = torch.ones(2, 3, requires_grad=True)
    step(u).sum().backward()
    assert prdp.solve.AdjointLog().number > number and step.adjoint_info is not None


def test_a_restart_that_does_not_fit_is_refused_by_a_lone_solve_too():
    kappa = torch.ones(1, 1, 1).expand(1, 3000, 3000)
    b = torch.ones(1, 1, 1, 1).expand(1, 1, 3000, 3000)
    solver = prdp.GMRES(max_iter=1, restart=10**7)
    with pytest.raises(ValueError, match=r"GMRES: restart = 10000000 on 9000000 unknowns " + TERABYTES):
        prdp.linear_solve(prdp.operators.Diffusion(kappa), b, solver)
