"""`torch.compile` as users call it, without fullgraph: one graph, no warning, whatever K and the tolerances become."""

import logging
import subprocess
import sys

import pytest
import torch
import torch._dynamo.testing
from helpers import field

import prdp_torch as prdp
from prdp_torch import operators


class Own(torch.nn.Module):
    """A(u) of a trained number and a right-hand side, in a module of its own."""

    def __init__(self):
        super().__init__()
        self.nu = torch.nn.Parameter(torch.tensor(1e-3, dtype=torch.float64))

    def forward(self, u):
        return operators.Burgers(u, self.nu, 1e-2)


NETWORK = torch.nn.Conv1d(1, 1, 3, padding=1, dtype=torch.float64)
STEPPERS = {
    "heat": lambda: prdp.Heat((16,), 1e-3, 1.0, solver=prdp.Jacobi(1)),
    "unrolled": lambda: prdp.Heat((16,), 1e-3, 1.0, solver=prdp.CG(1), backward="unrolled"),
    "burgers": lambda: prdp.Burgers((16,), 1e-3, 1e-2, solver=prdp.GMRES(1, restart=2)),
    "constant": lambda: prdp.ImplicitStep(operators.Heat((16,), 1e-3, 1.0), lambda u: u + 0.1 * u**2, prdp.CG(1)),
    "own": lambda: prdp.ImplicitStep(Own(), solver=prdp.GMRES(1, restart=2)),
}
COUNTER = torch._dynamo.testing.CompileCounter()
USES = {
    "step": lambda step, u: step(NETWORK(u)),
    "rollout": lambda step, u: step.rollout(NETWORK(u), 3),
}


class Warnings(logging.Handler):
    def __init__(self):
        super().__init__(logging.WARNING)
        self.said = []

    def emit(self, record):
        self.said.append(record.getMessage())


@pytest.fixture
def no_log():
    """Fails where torch.compile says anything at the level of a warning."""
    torch._dynamo.reset()
    torch._dynamo.variables.TensorVariable._warn_capture_scalar_outputs.cache_clear()  # it says so once a process
    handler, log = Warnings(), logging.getLogger("torch._dynamo")
    log.addHandler(handler)
    yield
    log.removeHandler(handler)
    assert not handler.said


@pytest.mark.parametrize("backend", [COUNTER, "aot_eager"], ids=["counter", "aot_eager"])
@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("name", STEPPERS)
def test_a_step_is_one_graph_without_a_warning_and_follows_k(no_log, name, use, backend):
    step, eager = STEPPERS[name](), STEPPERS[name]()
    assert torch._dynamo.explain(lambda u: USES[use](step, u))(field((16,))).graph_break_count == 0
    torch._dynamo.reset()
    COUNTER.clear()
    compiled = torch.compile(lambda u: USES[use](step, u), backend=backend)
    for k in (1, 2, 5, 9):
        step.max_iter = eager.max_iter = k
        u, v = (field((16,)).requires_grad_() for _ in range(2))
        compiled(u).square().sum().backward()
        USES[use](eager, v).square().sum().backward()
        torch.testing.assert_close(u.grad, v.grad, rtol=1e-12, atol=0)
        assert torch.equal(step.info.iterations, eager.info.iterations)
    if backend is COUNTER:
        assert COUNTER.frame_count == 1  # as with fullgraph=True


@pytest.mark.parametrize("backend", [COUNTER, "aot_eager"], ids=["counter", "aot_eager"])
@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("name", STEPPERS)
def test_a_step_follows_its_tolerances_too(no_log, name, use, backend):
    global of_the_script  # whose numbers torch.compile takes for constants sooner than those of other steps
    step, eager = STEPPERS[name](), STEPPERS[name]()
    of_the_script = step
    step.max_iter = eager.max_iter = 60
    COUNTER.clear()
    compiled = torch.compile(lambda u: USES[use](of_the_script, u), backend=backend)
    for k, (rtol, of_adjoint) in enumerate(((1e-1, None), (1e-2, None), (1e-4, 1e-2), (1e-9, 1e-3), (1e-6, None)), 1):
        for each in (step, eager):
            each.rtol, each.adjoint_rtol, each.adjoint_max_iter = rtol, of_adjoint, 2 * k
        u, v = (field((16,)).requires_grad_() for _ in range(2))
        compiled(u).square().sum().backward()
        USES[use](eager, v).square().sum().backward()
        torch.testing.assert_close(u.grad, v.grad, rtol=1e-12, atol=0)
        assert torch.equal(step.info.iterations, eager.info.iterations)
        if backend != COUNTER:
            assert torch.equal(step.adjoint_info.iterations, eager.adjoint_info.iterations)
    if backend is COUNTER:
        assert COUNTER.frame_count == 1


def test_what_is_set_inside_a_compiled_function_breaks_the_graph_and_holds():
    step = prdp.Heat((16,), 1e-3, 1.0, solver=prdp.CG(50))
    controller = prdp.ToleranceController([step])

    def update(u, error, k):
        step.max_iter = k
        loss = step(u).square().mean()
        controller.step(error)
        step.adjoint_rtol = step.rtol / 2
        return loss

    torch._dynamo.reset()
    compiled = torch.compile(update, backend="eager")
    for k, error in ((5, 0.5), (6, 0.25), (7, 0.125)):
        compiled(field((16,)), error, k)
        assert (step.max_iter, step.rtol) == (controller.max_iter, controller.rtol)
        assert step.adjoint_rtol == step.rtol / 2 and step.rtol == pytest.approx(error / 10)
    torch._dynamo.reset()
    with pytest.raises(torch._dynamo.exc.Unsupported, match="is called between graphs, not traced"):
        torch.compile(update, backend="eager", fullgraph=True)(field((16,)), 0.1, 8)


def test_operators_of_numbers_are_made_inside_a_graph():
    def solve(b):
        return prdp.linear_solve(operators.Heat((8,), 0.3, 0.1), b, prdp.CG(20))[0]

    b = field((8,), batch=2)
    compiled = torch.compile(solve, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(b), solve(b), rtol=0.0, atol=0.0)


@pytest.mark.filterwarnings("ignore:`torch.jit.trace", "ignore::torch.jit.TracerWarning")
def test_torch_export_records_a_step_and_torch_jit_trace_says_that_it_cannot():
    step, u = prdp.Heat((8,), 0.3, 0.1, prdp.CG(20)), field((8,))
    exported = torch.export.export(torch.nn.Sequential(step), (u,)).module()
    torch.testing.assert_close(exported(u), step(u), rtol=0.0, atol=0.0)
    torch.testing.assert_close(torch.export.export(step, (u,)).module()(u), step(u), rtol=0.0, atol=0.0)
    heat = operators.Heat((8,), 0.3, 0.1)
    for run in (step, lambda b: prdp.linear_solve(heat, b, prdp.CG(20))[0]):
        with pytest.raises(TypeError, match="trace cannot record a solve of prdp_torch"):
            torch.jit.trace(run, u)
    flow = prdp.Flow((8, 8), 0.01, 0.01)
    with torch.no_grad(), pytest.raises(TypeError, match="trace cannot record it"):
        torch.jit.trace(flow, torch.zeros(1, 2, 8, 8, dtype=torch.float64))


def test_a_graph_takes_another_preconditioner_of_ones_own():
    a, b = operators.Heat((6,), 0.1, 1.0), field((6,), batch=2)
    compiled = torch.compile(
        lambda b, m: prdp.linear_solve(a, b, prdp.CG(50, preconditioner=m))[0], backend="eager", fullgraph=True
    )
    expected = prdp.linear_solve(a, b, prdp.Direct())[0]
    for scale in (1.0, 2.0, 3.0):
        m = operators.Function(lambda r, scale=scale: scale * r, symmetric=True)
        torch.testing.assert_close(compiled(b, m), expected, rtol=1e-4, atol=1e-4)


def test_a_graph_reads_which_samples_failed():
    step = prdp.Heat((8,), 0.3, 0.1, prdp.CG(20), on_failure="zero_grad")
    u = field((8,), batch=2)
    u[1] = float("nan")

    @torch.compile(fullgraph=True, backend="eager")
    def run(u):
        return step(u), step.info.failed, step.info.solved

    _, failed, solved = run(u)
    assert failed.tolist() == [False, True] and solved.tolist() == [True, False]


def test_no_process_has_the_number_of_another_ones_function():
    """Graphs that torch keeps on disk name a product by its number, and have the product of then in them."""
    program = "from prdp_torch import operators; print(operators.Function(lambda v: v).shape[0])"
    numbers = {subprocess.run([sys.executable, "-c", program], capture_output=True, check=True).stdout for _ in "ab"}
    assert len(numbers) == 2


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("name", ["heat", "burgers"])
def test_steppers_that_are_alike_share_a_graph(no_log, name, use):
    """More than eight, where torch.compile gives up."""
    steps = [STEPPERS[name]() for _ in range(10)]
    COUNTER.clear()
    compiled = torch.compile(lambda step, u: USES[use](step, u), backend=COUNTER)
    for step in steps:
        eager = STEPPERS[name]()
        u, v = (field((16,)).requires_grad_() for _ in range(2))
        compiled(step, u).square().sum().backward()
        USES[use](eager, v).square().sum().backward()
        torch.testing.assert_close(u.grad, v.grad, rtol=1e-12, atol=0)
        assert torch.equal(step.adjoint_info.iterations, eager.adjoint_info.iterations)
    assert COUNTER.frame_count == 1


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")  # torch hides it from users
@pytest.mark.parametrize("backend", ["eager", "aot_eager"])
@pytest.mark.parametrize("use", ["step", "rollout"])
def test_a_compiled_step_follows_what_nu_is_set_to(use, backend):
    """A tensor that is set for the next steps hides a Parameter, which stays."""
    torch._dynamo.reset()
    w = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
    make = {
        "number": lambda: 0.02,
        "Parameter": lambda: torch.nn.Parameter(torch.tensor(0.03, dtype=torch.float64)),
        "output": lambda: 2 * w,
        "buffer": lambda: torch.nn.Buffer(torch.tensor(0.04, dtype=torch.float64)),
    }
    step = prdp.Heat((8,), make["Parameter"](), 0.3, prdp.CG(500, rtol=1e-10))
    compiled = torch.compile(lambda u: USES[use](step, u), backend=backend)
    u = field((8,)).detach()
    compiled(u)
    for kind in ("output", "Parameter", "number", "output", "buffer", "output", "number", "Parameter"):
        found = []
        for call in (compiled, lambda u: USES[use](step, u)):
            step.nu = make[kind]()
            y = call(u)
            inputs = [w] if kind == "output" else [step.nu] if kind == "Parameter" else [NETWORK.weight]
            found.append([y, *torch.autograd.grad(y.square().sum(), inputs)])
        for compiled_one, eager_one in zip(*found, strict=True):
            torch.testing.assert_close(compiled_one, eager_one, rtol=1e-10, atol=0)
