"""Numbers that a sample has for itself and may not have, such as κ <= 0: it fails alone where failures do not raise, in
the CPU loops, in kernels and in tensor operations alike."""

import contextlib

import pytest
import torch
from fibers import Fibers
from stand_in_device import StandIn

import prdp_torch as prdp
from prdp_torch.operators import Diffusion

F64 = torch.float64
SHAPE = (6, 5)
BAD = {"kappa": (-0.5, 0.0, float("nan"), float("inf")), "h": (-0.5, float("nan"))}
CASES = [(name, value) for name, values in BAD.items() for value in values]
SOLVERS = {
    "CG": prdp.CG(200, rtol=1e-11),
    "multigrid": prdp.CG(60, rtol=1e-11, preconditioner="multigrid"),
    "Jacobi": prdp.Jacobi(3000, rtol=1e-11),
    "GMRES": prdp.GMRES(200, rtol=1e-11, preconditioner="diagonal"),
    "Direct": prdp.Direct(),
}


def noise(*shape, seed):
    return torch.randn(shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def numbers(name, value):
    """κ and h of three samples, one number of the second being `value`; and b."""
    kappa, h = 1 + noise(3, *SHAPE, seed=1).square(), 1 + noise(3, SHAPE[0], seed=2).square()
    (kappa if name == "kappa" else h)[1, 2] = value
    return kappa, h, noise(3, 1, *SHAPE, seed=3)


def make(kappa, h):
    return Diffusion(kappa, 1.0, boundary=("zero", (("robin", h), "flux")))


def solve(kappa, h, b, solver, **options):
    """u, its report, and the gradients of the three."""
    leaves = [t.detach().requires_grad_() for t in (kappa, h, b)]
    u, info = prdp.linear_solve(make(*leaves[:2]), leaves[2], solver, **options)
    return u, info, torch.autograd.grad(u.square().sum(), leaves)


def statuses(info):
    return [prdp.SolveStatus(int(s)).name for s in info.status]


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name, value", CASES)
def test_the_sample_fails_alone(name, value, solver, backward):
    kappa, h, b = numbers(name, value)
    options = {"on_failure": "zero_grad", "backward": backward}
    u, info, gradients = solve(kappa, h, b, SOLVERS[solver], **options)
    assert statuses(info) == ["CONVERGED", "NONFINITE_OPERATOR", "CONVERGED"]
    assert not u[1].any() and not any(g[1].any() for g in gradients)
    alone, _, others = solve(kappa[::2], h[::2], b[::2], SOLVERS[solver], **options)
    assert torch.equal(u[::2], alone)
    for g, expected in zip(gradients, others, strict=True):
        torch.testing.assert_close(g[::2], expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("kernels", [False, True])
def test_it_does_so_where_nothing_holds_u_as_well(kernels):
    """Such an A knows its null space, which is looked at before the solve."""
    kappa, _, b = numbers("kappa", -0.5)
    b -= b.mean((-1, -2), keepdim=True)
    with Fibers() if kernels else contextlib.nullcontext():
        _, info = prdp.linear_solve(Diffusion(kappa, boundary="flux"), b, SOLVERS["CG"], on_failure="return")
        with pytest.raises(ValueError, match=r"kappa must be > 0, got -0\.5 in sample 1"):
            prdp.linear_solve(Diffusion(kappa, boundary="flux"), b, SOLVERS["CG"])
    assert statuses(info) == ["CONVERGED", "NONFINITE_OPERATOR", "CONVERGED"]


@pytest.mark.parametrize("name, value", CASES)
def test_kernels_and_tensor_operations_agree(name, value):
    kappa, h, b = numbers(name, value)
    options = {"solver": SOLVERS["CG"], "on_failure": "zero_grad"}
    u, info, gradients = solve(kappa, h, b, **options)
    with Fibers():
        on_gpu = solve(kappa, h, b, **options)
    assert on_gpu[1].way == "kernel"
    device = StandIn()
    with device:
        leaves = [device.send(t).requires_grad_() for t in (kappa, h, b)]
        elsewhere, found = prdp.linear_solve(make(*leaves[:2]), leaves[2], **options)
        bars = torch.autograd.grad(elsewhere.square().sum(), leaves)
    there = device.fetch(elsewhere), found, [device.fetch(g) for g in bars]
    for other, report, grads in (on_gpu, there):
        assert torch.equal(device.fetch(report.status), info.status)
        torch.testing.assert_close(other, u, rtol=1e-8, atol=1e-10)
        for g, expected in zip(grads, gradients, strict=True):
            torch.testing.assert_close(g, expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("fibers", [False, True], ids=["loops", "kernel"])
@pytest.mark.parametrize("name", ["kappa", "h"])
def test_a_warning_names_the_number_and_an_error_is_of_the_whole_batch(name, fibers):
    kappa, h, b = numbers(name, -0.5)
    words = {"kappa": "kappa must be > 0", "h": "h of a Robin side must be >= 0"}[name]
    device = Fibers() if fibers else torch.enable_grad()
    with device:
        with pytest.warns(
            UserWarning, match=rf"1 of 3 .*sample 1 NONFINITE_OPERATOR at index \(2, 0\), .*{words}, got -0.5; what"
        ):
            prdp.linear_solve(make(kappa, h), b, SOLVERS["CG"], on_failure="warn")
        with pytest.raises(ValueError, match="kappa must be > 0, got -0.5" if name == "kappa" else "h of a Robin side"):
            prdp.linear_solve(make(kappa, h), b, SOLVERS["CG"])


def test_a_training_goes_on():
    """A network without exp at its end, as a user writes it first: one sample leaves what is allowed."""
    weight = torch.nn.Parameter(torch.tensor([1.0, -1.0, 2.0], dtype=F64))
    step = prdp.ImplicitStep(
        lambda u: Diffusion(weight[:, None, None].expand(3, *SHAPE), 1.0), None, prdp.CG(50), on_failure="zero_grad"
    )
    states = step.rollout(noise(3, 1, *SHAPE, seed=4), 3)
    assert step.info.failed[1].any() and not step.info.failed[::2].any()
    states[:, -1].square().sum().backward()
    assert weight.grad[1] == 0 and (weight.grad[::2] != 0).all()
