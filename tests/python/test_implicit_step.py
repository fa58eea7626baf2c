"""Steps of one's own equations: `ImplicitStep`, and subclasses of `Stepper`."""

import copy
import pickle

import pytest
import torch
import torch._dynamo.testing
from helpers import dense_heat, dense_laplacian, field, modes
from torch.autograd import gradcheck, gradgradcheck

import prdp_torch as prdp
from prdp_torch import fields, operators

N = 9


def viscosity():
    return torch.tensor(2e-2, dtype=torch.float64, requires_grad=True)


def flow(shape=(3, 4), batch=2):
    return fields.project(field(shape, batch, channels=3))


def own_and_built_in(name, nu, **options):
    """An ImplicitStep and the built-in stepper that it must equal, and a state."""
    if name == "heat":
        built_in, u = prdp.Heat((N,), nu, 0.5, **options), field((N,))
        return prdp.ImplicitStep(lambda u: operators.Heat((N,), nu, 0.5), **options), built_in, u
    if name == "burgers":
        built_in, u = prdp.Burgers((3, 4), nu, 0.1, **options), field((3, 4), channels=2)
        return prdp.ImplicitStep(lambda u: operators.Burgers(u, nu, 0.1), **options), built_in, u
    built_in = prdp.NavierStokes((3, 4), nu, 0.1, **options)
    own = prdp.ImplicitStep(lambda u: operators.NavierStokes(u, nu, 0.1), built_in.rhs, **options)
    return own, built_in, flow()


@modes
@pytest.mark.parametrize("name", ["heat", "burgers", "navier_stokes"])
def test_it_equals_the_built_in_steps_to_the_last_bit(name, backward):
    results = []
    for which in range(2):
        nu = viscosity()
        options = {"solver": prdp.GMRES(3, restart=4), "backward": backward, "on_failure": "return"}
        *steppers, u = own_and_built_in(name, nu, **options)
        stepper = steppers[which]
        u.requires_grad_()
        states = stepper.rollout(u, 3)
        weight = torch.randn(states.shape, generator=torch.Generator().manual_seed(5), dtype=u.dtype)
        gradients = torch.autograd.grad((weight * states).sum(), (u, nu))
        infos = [*stepper.info[:4], *(t.nan_to_num(-1.0) for t in stepper.adjoint_info[:4])]
        assert all(t.shape == (2, 3) for t in infos)
        one = stepper(u)
        results.append((states, *gradients, *infos, one, *stepper.info[:4]))
    assert all(torch.equal(*pair) for pair in zip(*results, strict=True))


@modes
def test_a_nonlinear_right_hand_side_against_the_dense_solve(backward):
    nu, r = viscosity(), torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    step = prdp.ImplicitStep(
        lambda u: operators.Heat((N,), nu, 0.1),
        lambda u: u + 0.1 * r * (u - u**3),
        solver=prdp.CG(80, rtol=1e-14),
        backward=backward,
    )
    laplacian = torch.from_numpy(dense_laplacian((N,)))

    def dense(u):
        a = torch.eye(N, dtype=torch.float64) - nu * 0.1 * laplacian
        return torch.linalg.solve(a, (u + 0.1 * r * (u - u**3)).flatten(1).mT).mT.view_as(u)

    u = field((N,)).requires_grad_()
    found, expected = (torch.autograd.grad((f(f(u)) ** 2).sum(), (u, nu, r)) for f in (step, dense))
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)
    assert step.converged


@modes
def test_derivatives_of_a_rollout(backward):
    values = torch.rand(3, N, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) + 2

    def matvec(v, k, s):
        return k * v - s * v.roll(1, -1)

    def run(u, k, s):
        step = prdp.ImplicitStep(
            lambda u: operators.Function(matvec, tensors=(k + u**2, s)),
            lambda u: u.sin(),
            solver=prdp.GMRES(4, restart=9, rtol=1e-14),
            backward=backward,
        )
        return step.rollout(u, 2)

    inputs = (
        torch.randn(3, N, dtype=torch.float64, generator=torch.Generator().manual_seed(2)).requires_grad_(),
        values.requires_grad_(),
        torch.tensor(0.7, dtype=torch.float64, requires_grad=True),
    )
    assert gradcheck(run, inputs)
    assert gradgradcheck(run, inputs, fast_mode=True)


def test_matrices_of_all_kinds_and_one_operator_for_all_states():
    m = torch.from_numpy(dense_heat((N,), 2e-2, 1.0))
    u = torch.randn(4, N, dtype=torch.float64)
    sparse = m.to_sparse_csr()
    csr = operators.Matrix.csr(sparse.crow_indices(), sparse.col_indices(), sparse.values(), N)
    for operator in (m, sparse, csr, operators.Matrix(m), lambda u: m, lambda u: csr):
        step = prdp.ImplicitStep(operator, solver=prdp.CG(50, rtol=1e-13))
        states = step.rollout(u, 2)
        expected = torch.linalg.solve(m, torch.linalg.solve(m, u.mT)).mT
        torch.testing.assert_close(states[:, 2], expected)
        assert states.shape == (4, 3, N)


def test_controllers_refine_it():
    step = prdp.ImplicitStep(operators.Heat((N,), 1.0, 1.0), solver=prdp.Jacobi(7))
    controller = prdp.PRDPController([step], window=1, delta=2)
    assert step.max_iter == 1
    with pytest.warns(UserWarning, match="the metric no longer falls: .*said once") as said:
        refined = [(step(field((N,))), controller.step(1.0))[1] for _ in range(20)]
    assert len(said) == 1
    assert any(refined) and step.max_iter == controller.max_iter > 1
    assert step.info.iterations.tolist() == [step.max_iter - refined[-1]] * 2 or refined[-1]


class Diffusion(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.log_nu = torch.nn.Parameter(torch.tensor(-4.0, dtype=torch.float64))

    def forward(self, u):
        return operators.Heat((N,), self.log_nu.exp(), 0.5)


def test_modules_among_the_callables_are_submodules():
    network = torch.nn.Conv1d(1, 1, 3, padding=1, dtype=torch.float64)
    step = prdp.ImplicitStep(Diffusion(), network, solver=prdp.CG(20))
    assert {name for name, _ in step.named_parameters()} == {"operator_at.log_nu", "rhs_at.weight", "rhs_at.bias"}
    (step(field((N,))) ** 2).sum().backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in step.parameters())
    u = field((N,))
    clones = copy.deepcopy(step), pickle.loads(pickle.dumps(step))
    for clone in clones:
        assert torch.equal(clone(u), step(u)) and clone.adjoint_info is None
        next(clone.parameters()).data.fill_(0.0)
    assert step.operator_at.log_nu == -4.0


def test_what_a_function_closes_over_stays_its_owners():
    nu = torch.nn.Parameter(torch.tensor(1e-2))
    assert list(prdp.ImplicitStep(lambda u: operators.Heat((N,), nu, 0.5), solver=prdp.CG(3)).parameters()) == []


def test_a_constant_operator_is_saved_moved_and_trained_with_the_step():
    nu = torch.nn.Parameter(torch.tensor(1e-2))
    step = prdp.ImplicitStep(operators.Heat((N,), nu, 0.5), solver=prdp.CG(3))
    assert list(step.parameters()) == [nu]
    matrix = torch.eye(N, dtype=torch.float64) * 2
    step = prdp.ImplicitStep(matrix, solver=prdp.CG(3)).float()
    assert step(torch.ones(2, N)).dtype == torch.float32 and matrix.dtype == torch.float64
    other = prdp.ImplicitStep(torch.eye(N), solver=prdp.CG(3))
    other.load_state_dict(step.state_dict())
    torch.testing.assert_close(other(torch.ones(2, N)), torch.full((2, N), 0.5))
    assert prdp.ImplicitStep(operators.Heat((N,), 1e-2, 0.5), solver=prdp.CG(3)).state_dict() == {}
    function = prdp.ImplicitStep(operators.Function(times, tensors=torch.tensor([4.0])), solver=prdp.CG(3))
    for clone in (copy.deepcopy(function), pickle.loads(pickle.dumps(function))):
        torch.testing.assert_close(clone(torch.ones(2, N)), torch.full((2, N), 0.25))


def times(v, k):
    return k * v


def test_a_failure_says_in_which_step_in_both_directions():
    calls = []

    def rhs(u):
        calls.append(None)
        return u / 0.0 if len(calls) == 3 else u

    step = prdp.ImplicitStep(operators.Heat((N,), 1e-2, 0.5), rhs, solver=prdp.CG(3))
    with pytest.raises(torch.linalg.LinAlgError, match="step 3 of 5: linear_solve: 2 of 2 samples failed"):
        step.rollout(field((N,)), 5)
    calls.append(None)
    for create_graph in (False, True):
        states = step.rollout(field((N,)).requires_grad_(), 4)
        cotangent = torch.zeros_like(states)
        cotangent[1, 3] = torch.nan
        with pytest.raises(torch.linalg.LinAlgError, match="step 3 of 4: adjoint solve: 1 of 2 samples failed"):
            states.backward(cotangent, create_graph=create_graph)
    with pytest.raises(torch.linalg.LinAlgError, match=r"^linear_solve: 2 of 2"):
        step(field((N,)) / 0.0)


def test_reports_of_steps_on_which_the_loss_does_not_depend():
    step = prdp.ImplicitStep(operators.Heat((N,), 1e-2, 0.5), solver=prdp.CG(3, rtol=0.0))
    states = step.rollout(field((N,)).requires_grad_(), 4)
    assert step.adjoint_info is None
    states[:, 2].sum().backward()
    assert step.adjoint_info.iterations.tolist() == step.info.adjoint.iterations.tolist() == [[3, 3, 0, 0]] * 2
    with torch.no_grad():
        step(field((N,)))  # a validation keeps the report of the training
    assert step.adjoint_info.iterations.shape == (2, 4)
    step(field((N,)).requires_grad_()).sum().backward()
    assert step.adjoint_info.iterations.tolist() == [3, 3]


def test_no_steps_return_the_start():
    step = prdp.ImplicitStep(operators.Heat((N,), 1e-2, 0.5), solver=prdp.CG(3))
    u = field((N,))
    assert torch.equal(step.rollout(u, 0), u[:, None]) and step.info.iterations.shape == (2, 0)
    assert torch.equal(fields.rollout(step, u, 2), step.rollout(u, 2))


@modes
def test_a_compiled_step_follows_k(backward):
    torch._dynamo.reset()
    counter = torch._dynamo.testing.CompileCounterWithBackend("aot_eager")
    nu = viscosity()
    step = prdp.ImplicitStep(
        lambda u: operators.Burgers(u, nu, 0.1), lambda u: u + 0.1 * u.sin(), solver=prdp.GMRES(1), backward=backward
    )
    compiled = torch.compile(step, fullgraph=True, backend=counter)
    for k in range(1, 6):
        step.max_iter = k
        gradients = []
        for f in (step, compiled):
            u = field((N,)).requires_grad_()
            gradients.append(torch.autograd.grad((f(u) ** 2).sum(), (u, nu)))
        assert all(torch.equal(*pair) for pair in zip(*gradients, strict=True))
    assert counter.frame_count <= 3  # as in test_rollout_compiled.py


class AllenCahn(prdp.Stepper):
    def operator(self, u):
        return operators.Heat((N,), 1e-2, 0.5)

    def rhs(self, u):
        return u + 0.5 * (u - u**3)


def test_a_subclass_of_stepper_defines_its_operator():
    u = field((N,))
    expected = prdp.ImplicitStep(operators.Heat((N,), 1e-2, 0.5), lambda u: u + 0.5 * (u - u**3), solver=prdp.CG(9))
    assert torch.equal(AllenCahn(prdp.CG(9)).rollout(u, 2), expected.rollout(u, 2))


class Lazy(prdp.Stepper):
    pass


class Forced(prdp.Heat):
    def rhs(self, u):
        return super().rhs(u) + 1.0


HEAT = operators.Heat((N,), 1e-2, 0.5)


@pytest.mark.parametrize(
    "call, error, message",
    [
        (lambda: Lazy(None), TypeError, r"Lazy: a subclass of Stepper must define operator\(u\)"),
        (lambda: AllenCahn(None), TypeError, r"AllenCahn: solver must be a Solver such as Jacobi\(10\), got None"),
        (lambda: Forced((N,), 1e-2, 0.5, prdp.CG(3)), TypeError, r"the steps of Heat do not call rhs\(u\) of a sub"),
        (lambda: prdp.ImplicitStep(HEAT), TypeError, "ImplicitStep: solver must be a Solver such as"),
        (lambda: prdp.ImplicitStep(3, solver=prdp.CG(3)), TypeError, "operator must be a function of u or an operator"),
        (lambda: prdp.ImplicitStep(HEAT, 3.0, prdp.CG(3)), TypeError, "rhs must be a function of u or None, got 3.0"),
        (lambda: run(lambda u: 3.0), TypeError, r"ImplicitStep: operator\(u\) must be an operator of .*, got 3.0"),
        (lambda: run(lambda u: None), TypeError, r"ImplicitStep: operator\(u\) must be an operator of .*, got None"),
        (lambda: run(operators.Heat((8,), 1.0, 1.0)), ValueError, r"Heat: expected \(batch, 1, 8\), got \(2, 1, 9\)"),
        (lambda: run(torch.eye(8)), ValueError, "a matrix of 8 rows needs b of shape"),
        (
            lambda: run(HEAT, lambda u: u[..., :3]),
            ValueError,
            r"rhs must return the shape .*\(2, 1, 9\) in torch.float",
        ),
        (lambda: run(HEAT, lambda u: u.add_(1.0)), ValueError, "operator or rhs changes the state u in place"),
        (
            lambda: run(prdp.Heat((9,), 1.0, 1.0, prdp.CG(3))),
            TypeError,
            "a function of u or an operator, got Heat.*which is a stepper; see operators.Heat",
        ),
        (lambda: run(HEAT, lambda u: u.float()), ValueError, "rhs must return the shape and dtype of the state"),
        (lambda: run(HEAT, lambda u: None), TypeError, r"rhs\(u\) must be a torch tensor, got NoneType"),
        (lambda: run(torch.eye(8), u=torch.ones(8)), ValueError, r"u must have shape \(batch, ...\), got \(8,\)"),
        (lambda: prdp.ImplicitStep(HEAT, solver=prdp.CG(3)).rollout(field((N,)), -1), ValueError, "steps must be >= 0"),
        (lambda: prdp.ImplicitStep(HEAT, solver=prdp.CG(3)).rollout(3, 1), TypeError, "u must be a torch tensor"),
    ],
)
def test_mistakes_are_named_before_any_work(call, error, message):
    with pytest.raises(error, match=message):
        call()


def run(operator, rhs=None, u=None):
    return prdp.ImplicitStep(operator, rhs, prdp.CG(3))(field((N,)) if u is None else u)


def test_a_right_hand_side_may_write_to_another_state_of_a_history():
    history = torch.stack([field((N,)), torch.zeros_like(field((N,)))])
    step = prdp.ImplicitStep(HEAT, lambda u: history[1].copy_(u) * 1.0, prdp.Direct())
    torch.testing.assert_close(step(history[0]), prdp.ImplicitStep(HEAT, None, prdp.Direct())(history[0]))
