"""A sample's last bit tells neither its neighbours nor the number of threads, where torch itself would sum."""

import subprocess
import sys

import pytest
import torch
from flows import random_velocity
from helpers import field

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64


def pocketed(seed, shape=(12, 14)):
    """Obstacles at random, with fluid sealed up among them."""
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed)) < 0.35


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("seed", range(6))
def test_a_flow_among_sealed_pockets_alone_and_in_a_batch(seed, dtype):
    step = prdp.Flow((12, 14), nu=0.05, dt=1e-2, boundary="wall", obstacle=pocketed(seed), solver=prdp.CG(30, 0.0),
                     on_failure="return")  # fmt: skip
    leaf = random_velocity((12, 14), 5, seed, dtype).requires_grad_()

    def with_gradient(u):
        end = step.rollout(u, 2)[:, -1]
        return end.detach(), *torch.autograd.grad(end.square().sum(), u)

    together = with_gradient(leaf)
    for s in range(5):
        alone = with_gradient(leaf[s : s + 1].detach().requires_grad_())
        assert all(torch.equal(one[0], all_[s]) for one, all_ in zip(alone, together, strict=True))


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("name", ["stencil", "function"])
def test_a_null_space_of_several_vectors_alone_and_in_a_batch(name, backward, dtype):
    """Two rings of 37 points that do not touch."""
    offsets = [(0, 0), (0, -1), (0, 1)]
    coefficients = torch.tensor([2.0, -1.0, -1.0], dtype=dtype)[None, :, None, None].expand(1, 3, 2, 37).contiguous()
    rings = torch.eye(2, dtype=dtype)[:, :, None].expand(2, 2, 37).contiguous()
    if name == "stencil":
        a = operators.Stencil(coefficients, offsets, "periodic", nullspace=rings)
    else:
        a = operators.Function(
            lambda v: 2 * v - v.roll(1, -1) - v.roll(-1, -1), symmetric=True, nullspace=rings,
            diagonal=lambda: torch.tensor(2.0, dtype=dtype),
        )  # fmt: skip
    b, g = field((2, 37), 7, seed=3).to(dtype), field((2, 37), 7, seed=4).to(dtype)
    b = b - b.mean(-1, keepdim=True)

    def with_gradient(rows):
        leaf = b[rows].clone().requires_grad_()
        u, _ = prdp.linear_solve(a, leaf, prdp.CG(12, 0.0), backward=backward, on_failure="return")
        return u.detach(), *torch.autograd.grad(u, leaf, g[rows])

    together = with_gradient(slice(None))
    for s in range(7):
        alone = with_gradient(slice(s, s + 1))
        assert all(torch.equal(one[0], all_[s]) for one, all_ in zip(alone, together, strict=True))


def test_threads_do_not_change_a_bit_of_one_large_sample():
    """Forward and back: the means that a projection takes off, and the sums over a sample that ν's derivative is."""
    script = """
import torch, prdp_torch as prdp
torch.manual_seed(0)
rest = {"solver": prdp.CG(4, 0.0), "on_failure": "return"}
steps = {
    "flow": (prdp.Flow((192, 192), nu=1e-3, dt=1e-3, diffusion="explicit", **rest), 2, ()),
    "channel": (prdp.Flow((192, 192), nu=0.05, dt=1e-3, boundary=("wall", "periodic"), **rest), 2, ()),
    "heat": (prdp.Heat((193, 193), torch.tensor(1e-3, requires_grad=True), 1.0, **rest), 1, ("nu",)),
    "burgers": (prdp.Burgers((193, 193), torch.tensor(1e-3, requires_grad=True), 1e-3, prdp.BiCGStab(2, 0.0),
                             on_failure="return"), 2, ("nu",)),
}
for name, (step, channels, leaves) in steps.items():
    n = 193 if leaves else 192
    u0, results = torch.randn(1, channels, n, n), []
    for count in (1, 2):
        torch.set_num_threads(count)
        u = u0.clone().requires_grad_()
        end = step(u)
        parameters = [p for p in (getattr(step, leaf, None) for leaf in leaves) if p is not None]
        results.append([end.detach(), *torch.autograd.grad(end.square().sum(), [u, *parameters])])
    assert len(results[0]) == 2 + len(leaves)
    assert all(map(torch.equal, *results)), name
print(len(steps), "steps")
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.stdout == "4 steps\n", done.stderr
