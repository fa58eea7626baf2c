"""The torch op behind the solves: what torch itself expects of it."""

import copy
import pickle

import pytest
import torch
from helpers import SOLVERS, field
from torch.library import opcheck
from torch.utils.checkpoint import checkpoint

import prdp_torch as prdp
from prdp_torch import _C, operators
from prdp_torch.solvers import packed_options


def arguments(backward="implicit", solver="jacobi", requires_grad=True, on_failure="raise"):
    b = field((5,)).requires_grad_(requires_grad)
    nu = torch.tensor(1e-3, dtype=torch.float64, requires_grad=requires_grad)
    return b, nu, packed_options(solver, 4, 1e-5, 3, None, backward, on_failure=on_failure)


@pytest.mark.parametrize("backward", ["implicit", "unrolled", "none"])
@pytest.mark.parametrize("solver", ["jacobi", "steepest_descent", "cg", "gmres", "direct"])
def test_linear_solve_passes_opcheck(backward, solver):
    b, nu, options = arguments(backward, solver)
    result = opcheck(torch.ops.prdp.linear_solve.default, (b, [nu], "heat", [5], [1.0], False, None, *options))
    assert set(result.values()) == {"SUCCESS"}


# opcheck looks at the .grad of results in between, which the ops made of others have.
of_several_ops = pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")


@of_several_ops
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_solves_and_steps_of_flows_pass_opcheck(backward):
    # A random pressure has a mean and is inconsistent.
    _, nu, options = arguments(backward, "direct", on_failure="return")
    for kind, channels, shape in (("burgers", 1, [5]), ("burgers", 2, [3, 4]), ("navier_stokes", 3, [3, 4])):
        u, b = field(shape, channels=channels).requires_grad_(), field(shape, seed=1, channels=channels)
        for op, args in (
            (torch.ops.prdp.linear_solve, (b, [u, nu], kind, shape, [0.1], False, None, *options)),
            (torch.ops.prdp.step, (u, [nu], kind, shape, [0.1], 2, *options)),
            (torch.ops.prdp.apply, (b, [u, nu], kind, shape, [0.1], True)),
            (torch.ops.prdp.rhs, (u, kind, shape, [0.1])),
        ):
            assert set(opcheck(op.default, args).values()) == {"SUCCESS"}


@of_several_ops
def test_matrices_and_the_other_ops_pass_opcheck():
    b, nu, options = arguments()
    m = torch.eye(5, dtype=torch.float64, requires_grad=True)
    rhs = torch.ones(2, 5, dtype=torch.float64, requires_grad=True)
    calls = [
        (torch.ops.prdp.linear_solve, (rhs, [m], "dense", [], [], False, None, *options)),
        (torch.ops.prdp.step, (b, [nu], "heat", [5], [1.0], 1, *options)),
        (torch.ops.prdp.step, (b, [], "poisson", [5], [], 1, *options)),
        (torch.ops.prdp.apply, (b, [nu], "heat", [5], [1.0], False)),
        (torch.ops.prdp.rhs, (b, "poisson", [5], [])),
        (
            torch.ops.prdp.unrolled_vjp,
            (b.detach(), b.detach(), torch.tensor([4, 4]), torch.tensor([-1, -1]),
             torch.full((2,), 0.1, dtype=torch.float64), [1, 1], [nu.detach()], "heat", [5], [1.0], False, None,
             *packed_options("cg", 4, 1e-5, 3, None, "unrolled")),
        ),
    ]  # fmt: skip
    for op, args in calls:
        assert set(opcheck(op.default, args).values()) == {"SUCCESS"}


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_a_compiled_step_follows_k_and_compiles_at_most_twice(backward):
    torch._dynamo.reset()
    counter = torch._dynamo.testing.CompileCounter()
    heat = prdp.Heat((30,), 1e-3, 1.0, solver=prdp.Jacobi(1), backward=backward)
    eager = prdp.Heat((30,), 1e-3, 1.0, solver=prdp.Jacobi(1), backward=backward)
    schedule = prdp.LinearSchedule([heat, eager], initial=1, increment=1, maximum=20)
    step = torch.compile(heat, fullgraph=True, backend=counter)
    for _ in range(12):
        u, v = (field((30,)).requires_grad_() for _ in range(2))
        (step(u) ** 2).sum().backward()
        (eager(v) ** 2).sum().backward()
        assert torch.equal(u.grad, v.grad)
        assert heat.info.iterations.tolist() == eager.info.iterations.tolist() == [heat.max_iter] * 2
        schedule.step()
    assert heat.max_iter == 13
    assert counter.frame_count <= 2


def test_a_compiled_linear_solve_takes_k_as_an_argument():
    torch._dynamo.reset()
    counter = torch._dynamo.testing.CompileCounter()
    a = operators.Heat((12,), 1e-3, 1.0)

    @torch.compile(fullgraph=True, backend=counter)
    def solve(b, k):
        return prdp.linear_solve(a, b, prdp.Jacobi(max_iter=k))[0]

    for k in range(1, 12):
        b = field((12,)).requires_grad_()
        torch.testing.assert_close(solve(b, k), prdp.linear_solve(a, b, prdp.Jacobi(k))[0])
    assert counter.frame_count <= 2


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_ahead_of_time_autograd_gives_the_eager_gradients(solver, backward):
    torch._dynamo.reset()
    nu = torch.tensor(1e-3, dtype=torch.float64, requires_grad=True)
    heat = prdp.Heat((9,), nu, 1.0, solver=solver(4), backward=backward)
    gradients = []
    for step in (heat, torch.compile(heat, fullgraph=True, backend="aot_eager")):
        b = field((9,)).requires_grad_()
        nu.grad = None
        (step(b) ** 2).sum().backward()
        gradients.append((b.grad, nu.grad))
    assert torch.equal(gradients[0][0], gradients[1][0]) and gradients[0][1] != 0
    torch.testing.assert_close(gradients[0][1], gradients[1][1])


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("stepper, channels, solver", [
    (prdp.Burgers, 2, prdp.Jacobi), (prdp.Burgers, 2, prdp.Direct), (prdp.NavierStokes, 3, prdp.Direct),
])  # fmt: skip
def test_a_compiled_flow_differentiates_through_its_winds_at_any_batch(stepper, channels, solver, backward):
    torch._dynamo.reset()
    nu = torch.tensor(1e-2, dtype=torch.float64, requires_grad=True)
    eager = stepper((3, 4), nu, 0.1, solver=solver(4), backward=backward)
    compiled = torch.compile(eager, fullgraph=True, backend="aot_eager")
    for batch in (2, 3, 5):
        gradients = []
        for step in (eager, compiled):
            u = field((3, 4), batch, channels=channels).requires_grad_()
            gradients.append(torch.autograd.grad((step(step(u)) ** 2).sum(), (u, nu)))
        torch.testing.assert_close(gradients[1], gradients[0])


def test_checkpointing_recomputes_the_solve():
    heat = prdp.Heat((20,), 1e-3, 1.0, solver=prdp.Jacobi(5))
    u, v = (field((20,)).requires_grad_() for _ in range(2))
    checkpoint(lambda w: heat(heat(w)), u, use_reentrant=False).sum().backward()
    heat(heat(v)).sum().backward()
    assert torch.equal(u.grad, v.grad)


@pytest.mark.parametrize("use_reentrant", [False, True])
def test_checkpointing_leaves_the_report_to_controllers(use_reentrant):
    """torch ends what it runs again by an exception of its own."""
    heat = prdp.Heat((20,), 1e-2, 1.0, solver=prdp.CG(30))
    checkpoint(heat, field((20,)).requires_grad_(), use_reentrant=use_reentrant).sum().backward()
    assert heat.converged and heat.info.solved.all() and heat.adjoint_info.solved.all()
    with pytest.raises(ValueError):
        heat(field((19,)))
    assert heat.info is None


def test_fake_tensors_know_the_shapes():
    with torch._subclasses.FakeTensorMode():
        b = torch.empty(7, 1, 4, 5)
        u, info = prdp.linear_solve(operators.Poisson((4, 5)), b, prdp.CG(3))
    assert u.shape == b.shape and info.status.shape == (7,) and info.status.dtype == torch.int64


def test_steppers_are_modules_without_weights_that_copy_and_pickle():
    heat = prdp.Heat((8,), 1e-3, 1.0, solver=prdp.Jacobi(3))
    assert list(heat.parameters()) == [] and heat.state_dict() == {}
    assert "Heat(shape=(8,), solver=jacobi, max_iter=3" in repr(heat)
    for other in (copy.deepcopy(heat), pickle.loads(pickle.dumps(heat))):
        assert torch.equal(other(field((8,))), heat(field((8,))))
        other.max_iter = 7
        assert heat.max_iter == 3
        b = field((8,)).requires_grad_()
        other(b).sum().backward()
        assert other.adjoint_info is not None and heat.adjoint_info is None


def test_reports_of_two_solves_stay_apart():
    a = operators.Heat((8,), 1e-3, 1.0)
    b = field((8,)).requires_grad_()
    u, first = prdp.linear_solve(a, b, prdp.Jacobi(3))
    v, second = prdp.linear_solve(a, b, prdp.Jacobi(5))
    assert first.adjoint is None and second.adjoint is None
    v.sum().backward()
    assert first.adjoint is None and second.adjoint.iterations.tolist() == [5, 5]
    u.sum().backward()
    assert first.adjoint.iterations.tolist() == [3, 3]


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda names, *rest: (names[:4], *rest), "5 names, 9 counts and 3 numbers"),
        (lambda names, counts, *rest: (names, counts[:6], *rest), "got 5, 6 and 3"),
        (lambda names, counts, numbers, m: (names, counts, numbers[:1], m), "got 5, 9 and 1"),
        (lambda names, *rest: ([*names[:3], "now", names[4]], *rest), "start: unknown name 'now'"),
    ],
)  # fmt: skip
def test_options_that_are_not_packed_as_they_should_be_are_refused(change, message):
    b, nu, options = arguments()
    with pytest.raises((ValueError, RuntimeError), match=message):
        torch.ops.prdp.linear_solve(b, [nu], "heat", [5], [1.0], False, None, *change(*options))


def test_every_option_arrives_where_it_is_packed():
    """What a setting out of range is refused for tells which setting it was taken for."""
    settings = {"max_iter": 4, "rtol": 1e-5, "restart": 3, "preconditioner": None, "backward": "unrolled"}
    for name, value in (
        ("max_iter", -1), ("rtol", -2.0), ("restart", -3), ("adjoint_max_iter", -4), ("adjoint_rtol", -5.0),
        ("checkpoint_every", -6),
    ):  # fmt: skip
        packed = packed_options("gmres", **{**settings, name: value})
        with pytest.raises(ValueError, match=rf"{name} must be .*got {value:g}"):
            _C.SolveOptions(*packed).check("op")
    for name, value in (("backward", "b"), ("on_failure", "f"), ("start", "s")):
        with pytest.raises(ValueError, match=f"{name}: unknown name '{value}'"):
            _C.SolveOptions(*packed_options("gmres", **{**settings, name: value}))


def test_a_nu_that_is_negated_by_a_bit_is_read_right():
    nu = torch.tensor(1 - 1e-2j, dtype=torch.complex128).conj().imag
    assert nu.is_neg() and nu == 1e-2
    for make in (operators.Heat, lambda shape, nu, dt: operators.Burgers(field(shape, seed=1), nu, dt)):
        found, expected = (prdp.linear_solve(make((5,), n, 0.1), field((5,)), prdp.Direct())[0] for n in (nu, 1e-2))
        assert torch.equal(found, expected)
