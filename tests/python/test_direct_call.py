"""Steppers reach the compiled library past torch's dispatcher where nobody watches: the same to the last bit, and
whoever watches still sees the op."""

import copy
import pickle

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.overrides import BaseTorchFunctionMode, TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

import prdp_torch as prdp
from prdp_torch import _C, operators

SHAPE = (6, 5)


def heat(**options):
    nu = torch.nn.Parameter(torch.tensor(1e-2, dtype=torch.float64))
    return prdp.Heat(SHAPE, nu, 0.1, solver=prdp.CG(4), **options)


def flow(**options):
    return prdp.NavierStokes(SHAPE, 1e-2, 0.1, solver=prdp.GMRES(2, restart=3), picard_steps=2, **options)


def poisson(**options):
    return prdp.Poisson(SHAPE, solver=prdp.Jacobi(5), length=2.0, **options)


def own(**options):
    c = torch.nn.Parameter(stencil_coefficients())
    a = operators.Stencil(c, [(0, 0), (0, 1), (1, 0)], "periodic")
    return prdp.ImplicitStep(a, lambda u: u + 0.1 * u.sin(), solver=prdp.GMRES(2, restart=3), **options)


def stencil_coefficients():
    torch.manual_seed(3)
    c = torch.rand(1, 3, *SHAPE, dtype=torch.float64)
    c[:, 0] += 3
    return c


STEPPERS = {"heat": heat, "navier_stokes": flow, "poisson": poisson, "own": own}
every_stepper = pytest.mark.parametrize("make", STEPPERS.values(), ids=STEPPERS)


def state(make, seed=0):
    torch.manual_seed(seed)
    return torch.randn(3, 3 if make is flow else 1, *SHAPE, dtype=torch.float64)


class Seen(TorchDispatchMode):
    def __init__(self):
        super().__init__()
        self.ops = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.ops.append(func.overloadpacket)
        return func(*args, **(kwargs or {}))


class Called(TorchFunctionMode):
    def __init__(self):
        super().__init__()
        self.functions = []

    def __torch_function__(self, func, types, args=(), kwargs=None):
        self.functions.append(func)
        return func(*args, **(kwargs or {}))


def op_of(make):
    return torch.ops.prdp.linear_solve if make is own else torch.ops.prdp.step


@every_stepper
@pytest.mark.parametrize("backward", ["implicit", "unrolled", "none"])
@pytest.mark.parametrize("start", ["zero", "state"])
def test_both_ways_give_the_same_bits(make, backward, start):
    def results(mode):
        step = make(backward=backward, start=start)
        u = state(make).requires_grad_()
        with mode:
            after = step(u)
        found = [after, *step.info[:4]]
        if backward != "none":
            after.square().sum().backward()
            found += [u.grad, *(p.grad for p in step.parameters()), *step.adjoint_info[:4]]
        return found

    straight, through_the_op = results(torch.enable_grad()), results(BaseTorchFunctionMode())
    assert all(torch.equal(a.nan_to_num(-1), b.nan_to_num(-1)) for a, b in zip(straight, through_the_op, strict=True))


@pytest.mark.parametrize("make", [heat, poisson, flow])
@pytest.mark.parametrize("backward", ["implicit", "unrolled", "none"])
def test_a_rollout_gives_the_same_bits_through_the_dispatcher(make, backward):
    def results(mode):
        step = make(backward=backward)
        u = state(make).requires_grad_()
        with mode:
            after = step.rollout(u, 3)
            if backward != "none":
                after.square().sum().backward()
        gradients = [u.grad, *(p.grad for p in step.parameters()), *step.adjoint_info[:4]] if backward != "none" else []
        return [after, *step.info[:4], *gradients]

    seen = Seen()
    straight, through_the_op = results(torch.enable_grad()), results(seen)
    assert torch.ops.prdp.rollout_solves in seen.ops
    assert backward == "none" or torch.ops.prdp.rollout_vjp in seen.ops
    assert all(torch.equal(a.nan_to_num(-1), b.nan_to_num(-1)) for a, b in zip(straight, through_the_op, strict=True))


@every_stepper
def test_the_dispatcher_is_left_out(make, monkeypatch):
    def refused(*arguments):
        raise AssertionError("called the op")

    step, u = make(), state(make).requires_grad_()
    monkeypatch.setattr(torch.ops.prdp, "step", refused)
    monkeypatch.setattr(torch.ops.prdp, "linear_solve", refused)
    step(u).square().sum().backward()
    with torch.no_grad():
        step(u)


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_linear_solve_gives_the_same_bits_both_ways(backward):
    b = state(heat)
    systems = [
        (operators.Stencil(stencil_coefficients(), [(0, 0), (0, 1), (1, 0)], "periodic"), b, torch.ones_like(b)),
        (torch.eye(30, dtype=torch.float64) * 3 + 0.1, b[0].flatten(), None),
        (torch.eye(30, dtype=torch.float64) * 3 + 0.1, b.flatten(1), b.flatten(1)),
    ]
    for a, rhs, x0 in systems:
        found = []
        for mode in (torch.enable_grad(), BaseTorchFunctionMode()):
            leaf = rhs.clone().requires_grad_()
            with mode:
                u, info = prdp.linear_solve(a, leaf, prdp.GMRES(2, restart=2), backward, x0=x0)
            u.square().sum().backward()
            found.append((u, *info[:4], leaf.grad, *info.adjoint[:4]))
        assert all(torch.equal(one.nan_to_num(-1), other.nan_to_num(-1)) for one, other in zip(*found, strict=True))


@every_stepper
def test_modes_see_the_op(make):
    step, u = make(), state(make).requires_grad_()
    expected = step(u)
    with Seen() as seen:
        assert torch.equal(step(u), expected)
    assert torch.ops.prdp.linear_solve in seen.ops
    with Called() as called:
        assert torch.equal(step(u), expected)
    assert op_of(make) in called.functions


@every_stepper
def test_fake_tensors_stay_fake(make):
    fake = FakeTensorMode(allow_non_fake_inputs=True).from_tensor(state(make))
    assert type(make()(fake)) is type(fake)


def test_a_mode_of_fake_tensors_makes_them():
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        u, info = prdp.linear_solve(operators.Poisson(SHAPE), state(heat), prdp.CG(3))
    assert u.fake_mode is mode and info.status.fake_mode is mode


def test_a_number_is_of_the_kind_that_a_mode_makes_and_does_not_outlive_it():
    u = torch.randn(2, 1, 6)
    before = prdp.Heat((6,), 1e-2, 1.0, prdp.CG(3))
    with FakeTensorMode() as mode:
        within = prdp.Heat((6,), 1e-2, 1.0, prdp.CG(3))
        for step in (before, within):
            assert step(torch.randn(2, 1, 6)).fake_mode is mode
            assert step.rollout(torch.randn(2, 1, 6), 2).shape == (2, 3, 1, 6)
    assert torch.equal(within(u), before(u)) and type(within(u)) is torch.Tensor


@every_stepper
def test_the_profiler_sees_the_op(make):
    step, u = make(), state(make)
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        step(u)
    assert any(event.key == f"prdp::{'linear_solve' if make is own else 'step'}" for event in profile.key_averages())


@pytest.mark.filterwarnings("ignore:`torch.jit")  # of torch's own forward mode
@every_stepper
def test_transforms_see_the_op(make):
    step, u = make(backward="implicit"), state(make)

    def loss(v):
        return step(v).square().sum()

    leaf = u.clone().requires_grad_()
    (expected,) = torch.autograd.grad(loss(leaf), leaf)
    torch.testing.assert_close(torch.func.grad(loss)(u), expected)
    mapped = torch.func.vmap(step)(torch.stack([u, 2 * u]))
    torch.testing.assert_close(mapped[0], step(u))
    _, tangent = torch.func.jvp(loss, (u,), (u,))
    torch.testing.assert_close(tangent, (expected * u).sum(), rtol=0.1, atol=0.0)  # both solves are truncated
    graph = torch.fx.experimental.proxy_tensor.make_fx(step)(u)
    assert torch.ops.prdp.linear_solve.default in [node.target for node in graph.graph.nodes]


@pytest.mark.filterwarnings("ignore:`torch.jit")  # of torch's own forward mode
@every_stepper
def test_dual_tensors_and_second_derivatives(make):
    step, u, tangent = make(), state(make), state(make, seed=1)
    with torch.autograd.forward_ad.dual_level():
        straight = step(torch.autograd.forward_ad.make_dual(u, tangent))
        with BaseTorchFunctionMode():
            through_the_op = step(torch.autograd.forward_ad.make_dual(u, tangent))
        found = [torch.autograd.forward_ad.unpack_dual(v).tangent for v in (straight, through_the_op)]
    assert torch.equal(*found) and found[0].abs().max() > 0
    leaf = u.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(step(leaf)[:, :2].pow(3).sum(), leaf, create_graph=True)  # not of a pressure
    (second,) = torch.autograd.grad(gradient[:, :2].square().sum(), leaf)
    assert second.isfinite().all() and second.abs().max() > 0


class Subclass(torch.Tensor):
    called = ()

    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        Subclass.called += (func,)
        return super().__torch_function__(func, types, args, kwargs or {})


@every_stepper
def test_a_subclass_sees_the_op(make):
    Subclass.called = ()
    u = state(make).as_subclass(Subclass)
    assert isinstance(make()(u), Subclass) and op_of(make) in Subclass.called


@every_stepper
def test_inference_mode_and_autocast(make):
    step, u = make(), state(make)
    expected = step(u)
    with torch.inference_mode():
        after = step(u)
    assert after.is_inference() and torch.equal(after, expected)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(step(u), expected)


def test_changed_attributes_count_at_once():
    step, u = heat(), state(heat)
    first = step(u)
    step.max_iter = 1
    assert not torch.equal(step(u), first) and (step.info.iterations == 1).all()
    step.max_iter, step.rtol = 50, 1e-12
    assert (step.info.iterations == 1).all() and (step(u) - first).abs().max() > 0 and step.converged
    step.nu.data.fill_(0.0)
    torch.testing.assert_close(step(u), u)
    step.backward = "none"
    assert not step(u.clone().requires_grad_()).requires_grad
    step.method = "nonsense"
    with pytest.raises(ValueError, match="nonsense"):
        step(u)


def test_failures_are_those_of_the_op():
    step, u = heat(on_failure="raise"), state(heat)
    u[1, 0, 2, 3] = torch.nan
    messages = []
    for mode in (torch.enable_grad(), BaseTorchFunctionMode()):
        with mode, pytest.raises(torch.linalg.LinAlgError, match="sample 1") as caught:
            step(u)
        messages.append(str(caught.value))
    assert messages[0] == messages[1]
    step.on_failure = "warn"
    with pytest.warns(UserWarning, match="sample 1"):
        step(u)
    with pytest.raises(ValueError, match=r"expected \(batch, "):
        step(u[..., 1:])
    with pytest.raises(TypeError, match="tensor"):
        step(u.to_sparse())


@every_stepper
def test_copies_begin_anew(make):
    step, u = make(), state(make)
    expected = step(u)
    assert torch.equal(copy.deepcopy(step)(u), expected)
    if make is not own:  # its rhs is a lambda
        assert torch.equal(pickle.loads(pickle.dumps(step))(u), expected)
    options = step._options_kept()
    assert isinstance(options, _C.SolveOptions) and step._options_kept() is options
