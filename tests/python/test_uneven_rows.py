"""Solves that are CONVERGED by their large rows while the small ones are not solved: they say so."""

import warnings

import pytest
import torch

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64


def inpainting(weight, n=64, dtype=F64):
    """A Laplacian between pixels that are known: the weight of the data, and b."""
    generator = torch.Generator().manual_seed(0)
    known = (torch.rand(1, n, n, generator=generator) < 0.02).to(dtype)
    image = torch.rand(3, 1, n, n, generator=generator).to(dtype)
    a = operators.Diffusion(torch.ones(1, n, n, dtype=dtype), shift=weight * known, boundary="flux", length=float(n))
    return a, weight * known * image


def penalty(weight, n=40):
    """A matrix of the second difference with the values at its ends held by a penalty."""
    a = 2 * torch.eye(n, dtype=F64) - torch.diag(torch.ones(n - 1), 1) - torch.diag(torch.ones(n - 1), -1)
    a[0, 0] = a[-1, -1] = weight
    b = torch.zeros(1, n, dtype=F64)
    b[0, 0], b[0, -1] = weight, 2 * weight
    return a, b


def warnings_of(call):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = call()
    return found, [str(w.message) for w in caught if "beta state" not in str(w.message)]


@pytest.mark.parametrize("preconditioner", ["diagonal", "multigrid"])
@pytest.mark.parametrize("weight", [1e4, 1e6])
def test_a_weight_of_data_is_said_with_its_error(weight, preconditioner, always):
    a, b = inpainting(weight)
    exact, _ = prdp.linear_solve(a, b, prdp.Direct())
    (u, info), said = warnings_of(lambda: prdp.linear_solve(a, b, prdp.CG(3000, preconditioner=preconditioner)))
    error = ((u - exact).abs().amax() / exact.abs().amax()).item()
    assert (info.status == prdp.SolveStatus.CONVERGED).all()
    assert len(said) == 1 and "CONVERGED to rtol = 1e-05, but u is off by at least about" in said[0]
    claimed = float(said[0].split("least about ")[1].split(" %")[0]) / 100
    assert claimed < 3 * error
    rtol = float(said[0].split("rtol, such as ")[1].split(". ")[0])
    (u, _), said = warnings_of(lambda: prdp.linear_solve(a, b, prdp.CG(9000, rtol, preconditioner=preconditioner)))
    assert not said and ((u - exact).abs().amax() / exact.abs().amax()).item() < 0.1 * error


@pytest.mark.parametrize("sparse", [False, True], ids=["dense", "csr"])
@pytest.mark.parametrize("solver", [prdp.CG(500, preconditioner="diagonal"), prdp.GMRES(50, restart=40)])
def test_a_penalty_in_a_matrix(sparse, solver, always):
    a, b = penalty(1e7)
    exact = torch.linalg.solve(a, b[0])[None]
    (u, _), said = warnings_of(lambda: prdp.linear_solve(a.to_sparse_csr() if sparse else a, b, solver))
    assert len(said) == 1 and "at index (" in said[0] and (u - exact).abs().max() > 1e-3
    (u, _), said = warnings_of(lambda: prdp.linear_solve(a, b, prdp.Direct()))
    assert not said and torch.allclose(u, exact)


def test_an_adjoint_solve_says_so_too(always):
    a, b = inpainting(1e6)
    weights = 1e-2 + b[:1]  # of a loss that sees the data most
    leaf = torch.rand(1, 1, 64, 64, dtype=F64, requires_grad=True)

    def gradient():
        u, _ = prdp.linear_solve(a, leaf, prdp.CG(3000, preconditioner="diagonal"))
        return torch.autograd.grad((weights * u).sum(), leaf)

    _, said = warnings_of(gradient)
    assert any(text.startswith("adjoint solve: sample 0 CONVERGED") for text in said)


def test_a_sample_of_zeros_hides_no_other(always):
    a, b = inpainting(1e5)
    b[1] = 0.0
    _, said = warnings_of(lambda: prdp.linear_solve(a, b, prdp.CG(3000, preconditioner="diagonal")))
    assert len(said) == 1


def test_rows_of_one_size_say_nothing(always):
    """A small part of b may stay in the residual whole: nothing is hidden by other rows."""
    a = operators.Diffusion(torch.full((1, 384, 384), 1e-6, dtype=F64), shift=1.0, boundary="flux")
    b = torch.full((1, 1, 384, 384), 300.0, dtype=F64)
    b[0, 0, 5, 7] += 1.0
    (_, info), said = warnings_of(lambda: prdp.linear_solve(a, b, prdp.CG(100), x0=torch.full_like(b, 300.0)))
    assert not said and info.iterations.item() == 0


def test_it_is_said_once_and_not_where_the_status_is_asked_for():
    a, b = inpainting(1e5, n=48)
    solver = prdp.CG(3000, preconditioner="diagonal")
    _, said = warnings_of(lambda: [prdp.linear_solve(a, b, solver, on_failure="return") for _ in range(4)])
    assert not said
    _, said = warnings_of(lambda: [prdp.linear_solve(a, b, solver) for _ in range(4)])
    assert len(said) == 1 and said[0].endswith("This is said once, and again if it gets ten times worse")


@pytest.mark.parametrize("contrast", [1e2, 1e4])
@pytest.mark.parametrize("solver", [prdp.CG(9000, preconditioner="diagonal"), prdp.CG(300, preconditioner="multigrid")])
def test_jumps_of_kappa_say_nothing_where_u_is_right(contrast, solver, always):
    kappa = torch.ones(1, 48, 48, dtype=F64)
    kappa[:, 10:30, 10:30] = contrast
    a, b = operators.Diffusion(kappa), torch.rand(2, 1, 48, 48, dtype=F64)
    exact, _ = prdp.linear_solve(a, b, prdp.Direct())
    (u, _), said = warnings_of(lambda: prdp.linear_solve(a, b, solver))
    assert not said and (u - exact).abs().max() < 1e-2 * exact.abs().max()


def islands(void, n=48, dtype=F64):
    """Three pieces that conduct heat, in a void that hardly does, far from the sources."""
    kappa = torch.ones(1, n, n, dtype=dtype)
    kappa[0, 16:32, 8:40] = void
    kappa[0, 20:24, 14:18] = kappa[0, 26:29, 28:34] = kappa[0, 18:19, 22:26] = 1
    b = torch.zeros(1, 1, n, n, dtype=dtype)
    b[0, 0, 2:6, 20:28] = 1
    return operators.Diffusion(kappa, boundary=["flux", ("zero", "flux")]), b


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("preconditioner", [None, "diagonal", "multigrid"])
@pytest.mark.parametrize("void", [1e-5, 1e-9])
def test_a_piece_that_floats_in_a_void_is_said_with_its_error(void, preconditioner, dtype, always):
    a, b = islands(void, dtype=dtype)
    exact, _ = prdp.linear_solve(*islands(void), prdp.Direct())
    (u, info), said = warnings_of(lambda: prdp.linear_solve(a, b, prdp.CG(9000, preconditioner=preconditioner)))
    error = ((u - exact).abs().amax() / u.abs().amax()).item()
    said = [text for text in said if "CONVERGED to rtol" in text]
    assert len(said) == (info.status.item() == prdp.SolveStatus.CONVERGED and error > 1e-3)
    for text in said:
        claimed = float(text.split("least about ")[1].split(" %")[0]) / 100
        assert 0.5 * error < claimed < 1.1 * error
    if dtype == F64:
        assert (preconditioner, void) == ("multigrid", 1e-5) or len(said) == 1
        rtol = float(said[0].split("rtol, such as ")[1].split(". ")[0]) if said else 1e-8
        solver = prdp.CG(30000, rtol, preconditioner=preconditioner)
        (u, _), said = warnings_of(lambda: prdp.linear_solve(a, b, solver))
        assert ((u - exact).abs().amax() < 1e-3 * exact.abs().amax()) == (not said)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("clay", [1e-9, 1e-7, 1e-5])
def test_two_aquifers_in_a_closed_box_are_said(clay, dtype, always):
    """No side holds u: its mean is zero, and the clay alone holds one aquifer to the other."""
    kappa, b = torch.full((1, 17, 20), 1e-3, dtype=F64), torch.zeros(1, 1, 17, 20, dtype=F64)
    kappa[0, 8] = clay
    b[0, 0, 3, 3], b[0, 0, 5, 16] = -1e-3, 1e-3
    exact, _ = prdp.linear_solve(operators.Diffusion(kappa, boundary="flux"), b, prdp.Direct())
    a = operators.Diffusion(kappa.to(dtype), boundary="flux")
    (u, info), said = warnings_of(lambda: prdp.linear_solve(a, b.to(dtype), prdp.CG(5000, preconditioner="diagonal")))
    error = ((u - exact).abs().max() / u.abs().max()).item()
    assert info.solved.all() and len(said) == (error > 1e-3)
    for text in said:
        claimed = float(text.split("least about ")[1].split(" %")[0]) / 100
        assert 0.5 * error < claimed < 1.1 * error


@pytest.mark.parametrize("weight", [1e2, 1e3, 1e4])
def test_the_error_beside_a_soft_penalty_is_that_of_its_smooth_part(weight, always):
    """It is many times what the residual of a row tells."""
    a, b = penalty(weight, n=200)
    exact = torch.linalg.solve(a, b[0])[None]
    (u, info), said = warnings_of(lambda: prdp.linear_solve(a, b, prdp.CG(2000, rtol=1e-4)))
    error = ((u - exact).abs().max() / u.abs().max()).item()
    assert info.solved.all() and len(said) == (error > 1e-2)
    for text in said:
        claimed = float(text.split("least about ")[1].split(" %")[0]) / 100
        assert 0.5 * error < claimed < 1.1 * error


def test_contact_that_begins_late_is_said():
    """Solves are looked at seldom, but anew where they take another number of iterations."""
    n = 190
    a = 3 * torch.eye(n, dtype=F64) - torch.diag(torch.ones(n - 1), 1) - torch.diag(torch.ones(n - 1), -1)
    generator = torch.Generator().manual_seed(0)

    def step(contact):
        b = -1 - 0.1 * torch.rand(1, n, dtype=F64, generator=generator)
        stiff = a.clone()
        if contact:
            stiff[7, 7] += 1e8
            b[0, 7] += 1e6
        return prdp.linear_solve(stiff, b, prdp.CG(2000))

    assert not warnings_of(lambda: [step(contact=False) for _ in range(37)])[1]
    _, said = warnings_of(lambda: step(contact=True))
    assert len(said) == 1 and "times as large as others" in said[0]


def test_an_adjoint_solve_speaks_of_the_gradient(always):
    a, b = penalty(1e7)
    leaf = torch.ones_like(b, requires_grad=True)

    def gradient():
        u, _ = prdp.linear_solve(a, leaf, prdp.CG(500), adjoint_rtol=1e-6)
        torch.autograd.grad(u, leaf, b)

    _, said = warnings_of(gradient)
    (text,) = [text for text in said if text.startswith("adjoint solve")]
    assert "its solution, which the gradient is made of, is off by" in text and "smaller adjoint_rtol, such as" in text


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_a_null_vector_that_nobody_named_is_no_error(dtype, always):
    """The stationary density of a chain, along which the rounding of A alone decides."""
    n, generator = 300, torch.Generator().manual_seed(0)
    k = torch.exp(1.5 * torch.randn(n - 1, generator=generator, dtype=F64))
    a = torch.zeros(n, n, dtype=F64)
    i = torch.arange(n - 1)
    a[i, i] += k + 3.0
    a[i, i + 1] -= k
    a[i + 1, i + 1] += k
    a[i + 1, i] -= k + 3.0
    b = (a @ torch.randn(n, 1, generator=generator, dtype=F64)).T
    (_, info), said = warnings_of(
        lambda: prdp.linear_solve(a.to(dtype), b.to(dtype), prdp.GMRES(20, rtol=1e-4, restart=300))
    )
    assert info.solved.all() and not said


@pytest.mark.parametrize("start", [False, True])
@pytest.mark.parametrize("solver", [prdp.CG(500), prdp.CG(50, preconditioner="multigrid")], ids=repr)
def test_a_small_channel_beside_a_large_one_is_said(solver, start, always):
    n, dt = 24, 10.0
    y, x = torch.meshgrid(*[(torch.arange(n, dtype=F64) + 0.5) / n] * 2, indexing="ij")
    salt = 35 + 1e-4 * torch.cos(torch.pi * x)
    gas = 1e-3 * torch.exp(-((x - 0.3) ** 2 + (y - 0.4) ** 2) / 0.01)
    b = torch.stack([salt, gas])[None]
    a = operators.Diffusion(torch.full((1, n, n), 1e-3 * dt, dtype=F64), shift=1.0, boundary="flux")
    (found, info), said = warnings_of(lambda: prdp.linear_solve(a, b, solver, x0=b if start else None))
    assert info.solved.all()
    exact, _ = prdp.linear_solve(a, b, prdp.Direct())
    off = (found - exact)[0, 1].norm() / exact[0, 1].norm()
    assert len(said) == (off > 0.05) and (start or solver.preconditioner or off > 1)
    assert all("in channel 1 alone |b - A u| is" in text and "Make the channels samples" in text for text in said)
    apart = b.flatten(0, 1).unsqueeze(1)
    (as_samples, _), said = warnings_of(lambda: prdp.linear_solve(a, apart, solver, x0=apart if start else None))
    assert not said and (as_samples[1, 0] - exact[0, 1]).norm() < 1e-3 * exact[0, 1].norm()


def test_a_channel_of_rounding_says_nothing(always):
    a = operators.Diffusion(torch.ones(1, 16, 16, dtype=F64), shift=1.0)
    b = torch.ones(2, 2, 16, 16, dtype=F64)
    b[:, 1] *= 1e-16
    b[1, 1] = 0
    assert not warnings_of(lambda: prdp.linear_solve(a, b, prdp.CG(200)))[1]


@pytest.mark.parametrize("dtype", [torch.float32, F64], ids=["float32", "float64"])
def test_small_rows_beside_those_of_the_identity(dtype, always):
    """Of an island whose values are given; GMRES ends by a breakdown in float32."""
    n, c = 32, 1e-9
    water = torch.ones(1, n, n, dtype=F64)
    water[0, 10:15, 5:15] = 0
    rows = torch.stack([torch.where(water > 0, 4 * c, 1.0), *[-c * water] * 4], 1).to(dtype)
    a = operators.Stencil(rows, [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)])
    b = (1e4 * (1 - water) + 1e-5 * water)[:, None].to(dtype)
    exact, _ = prdp.linear_solve(a, b, prdp.Direct())
    (u, info), said = warnings_of(lambda: prdp.linear_solve(a, b, prdp.GMRES(100, restart=30)))
    assert info.solved.all() and len(said) == 1 and "u is off by at least about" in said[0]
    assert ((u - exact) * water[:, None]).abs().max() > 0.5 * (exact * water[:, None]).abs().max()


@pytest.mark.parametrize("rtol", [0.03, 0.1, 0.2])
def test_channels_of_equal_size_are_not_called_small(rtol, always):
    a = operators.Diffusion(torch.ones(1, 16, 16, dtype=F64), shift=10.0)
    for seed in range(20):
        b = torch.randn(1, 2, 16, 16, dtype=F64, generator=torch.Generator().manual_seed(seed))
        _, said = warnings_of(lambda b=b: prdp.linear_solve(a, b, prdp.CG(500, rtol=rtol)))
        assert not said, (seed, said)


def test_in_float32_the_rtol_that_is_named_ends_in_the_rounding_of_each_row(always):
    """Confidences of pixels over eight decades: the residual is rounding, and u is right nonetheless."""
    n, generator = 96, torch.Generator().manual_seed(0)
    confidence = (3 * torch.randn(1, n, n, generator=generator, dtype=F64)).exp()
    confidence *= torch.rand(1, n, n, generator=generator) < 0.05
    image = torch.rand(1, 1, n, n, generator=generator, dtype=F64)
    a = operators.Diffusion(torch.ones(1, n, n), shift=confidence.float(), boundary="flux", length=float(n))
    b = (confidence * image).float()
    exact, _ = prdp.linear_solve(
        operators.Diffusion(torch.ones(1, n, n, dtype=F64), shift=confidence, boundary="flux", length=float(n)),
        confidence * image,
        prdp.Direct(),
    )
    solver = prdp.CG(2000, preconditioner="diagonal")
    (u, _), (text,) = warnings_of(lambda: prdp.linear_solve(a, b, solver))
    assert (u - exact).abs().max() > 1e-3 * exact.abs().max()
    rtol, end = text.split("rtol, such as ")[1].split("; ")
    assert end.startswith("in float32 that ends STAGNATED, at the rounding of each row")
    (u, info), said = warnings_of(
        lambda: prdp.linear_solve(a, b, prdp.CG(2000, float(rtol), preconditioner="diagonal"))
    )
    assert info.status.item() == prdp.SolveStatus.STAGNATED and not said
    assert (u - exact).abs().max() < 1e-4 * exact.abs().max()


def test_the_worst_of_the_samples_is_named_and_the_others_are_counted(always):
    """u that is far too large is measured by what it should be."""
    pair = torch.tensor([[1.0, -1.0], [-1.0, 1.0]], dtype=F64)
    weak = torch.tensor([1e1, 1e-8, 1e-6], dtype=F64).view(3, 1, 1) * torch.eye(2, dtype=F64)
    a = torch.zeros(3, 3, 3, dtype=F64)
    a[:, :2, :2], a[:, 2, 2] = pair + weak, 1e4
    b = torch.tensor([[1.0, -1.0 + 1e-3, 1e4]], dtype=F64).expand(3, 3)
    exact = torch.linalg.solve(a, b)
    (u, info), said = warnings_of(lambda: prdp.linear_solve(a, b, prdp.CG(100, rtol=1e-4)))
    off = (u - exact).abs().amax(1) / exact.abs().amax(1)
    assert info.solved.all() and off.argmax() == 1 and (off > 1e-2).sum() == 2
    (text,) = said
    assert "sample 1 CONVERGED" in text and "(and those of 1 other sample" in text
