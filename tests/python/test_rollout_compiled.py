"""The ops of rollouts: what torch expects of them, and rollouts under torch.compile."""

import pytest
import torch
import torch._dynamo.testing
from helpers import field, modes
from test_rollout import make, start
from torch.library import opcheck

import prdp_torch as prdp
from prdp_torch.solvers import packed_options


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
@modes
def test_the_ops_pass_opcheck(backward):
    options = packed_options("gmres", 3, 1e-5, 3, None, backward, on_failure="return")
    nu = torch.tensor(1e-2, dtype=torch.float64, requires_grad=True)
    said = torch.full((2, 4), 3), torch.full((2, 4), -1), torch.full((2, 4), 0.1, dtype=torch.float64)
    for kind, shape, channels in (("heat", [5], 1), ("burgers", [3, 4], 2), ("navier_stokes", [3, 4], 3)):
        u, states = field(shape, channels=channels), torch.randn(2, 5, channels, *shape, dtype=torch.float64)
        equation = ([nu], kind, shape, [0.1], 2)
        for op, args in (
            (torch.ops.prdp.rollout_solves, (u.requires_grad_(), *equation, 4, *options)),
            (torch.ops.prdp.rollout, (u, *equation, 2, *options)),
            (torch.ops.prdp.rollout_vjp,
             (states, states, *said, [1, 1], [nu.detach()], *equation[1:], *options)),
        ):  # fmt: skip
            assert set(opcheck(op.default, args).values()) == {"SUCCESS"}


def test_the_ops_refuse_no_solves_a_step():
    options = packed_options("gmres", 3, 1e-5, 3, None)
    u, states = field((3, 4), channels=2), torch.randn(2, 5, 2, 3, 4, dtype=torch.float64)
    equation = ([torch.tensor(1e-2, dtype=torch.float64)], "burgers", [3, 4], [0.1], 0)
    for call in (
        lambda: torch.ops.prdp.rollout_solves(u, *equation, 1, *options),
        lambda: torch.ops.prdp.rollout(u, *equation, -1, *options),
        lambda: torch.ops.prdp.rollout_vjp(states, states, None, None, None, [1, 0], *equation, *options),
    ):
        with pytest.raises(ValueError, match="Burgers: picard_steps must be >= 1, got 0"):
            call()


@modes
@pytest.mark.parametrize("name", ["heat", "burgers_1d"])
def test_a_compiled_rollout_follows_k_and_compiles_at_most_twice(name, backward):
    torch._dynamo.reset()
    counter = torch._dynamo.testing.CompileCounterWithBackend("aot_eager")
    eager = make(name, 1e-2, prdp.Jacobi(1), backward=backward)
    compiled = torch.compile(eager.rollout, fullgraph=True, backend=counter)
    for k in range(1, 8):
        eager.max_iter = k
        gradients = []
        for rollout in (eager.rollout, compiled):
            u = start(name).requires_grad_()
            states = rollout(u, 3)
            (states**2).sum().backward()
            gradients.append(u.grad)
            assert eager.info.iterations.tolist() == [[k] * 3] * 2
        assert torch.equal(*gradients)
    # For the first K and for all others; and dynamo repeats the first, when it finds that rtol is a constant.
    assert counter.frame_count <= 3


def test_a_compiled_rollout_follows_the_number_of_steps():
    torch._dynamo.reset()
    counter = torch._dynamo.testing.CompileCounterWithBackend("aot_eager")
    burgers = prdp.Burgers((9,), 1e-2, 0.1, solver=prdp.Jacobi(3), picard_steps=2)
    compiled = torch.compile(burgers.rollout, fullgraph=True, backend=counter)
    frames = []
    for steps in range(2, 9):
        u, v = (field((9,)).requires_grad_() for _ in range(2))
        (compiled(u, steps) ** 2).sum().backward()
        (burgers.rollout(v, steps) ** 2).sum().backward()
        assert torch.equal(u.grad, v.grad)
        frames.append(counter.frame_count)
    assert frames[1:] == frames[1:2] * 6  # the second number makes it symbolic, and no other compiles again
