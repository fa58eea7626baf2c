"""torch.autocast: solves and their derivatives keep the dtype of their input, and take low precision for float32."""

import pytest
import torch
from helpers import field, random, spd_matrices

import prdp_torch as prdp
from prdp_torch import operators

LOW = [torch.bfloat16, torch.float16]
N = 48  # products in bfloat16 would be off by 1e-3


def autocast():
    return torch.autocast("cpu", dtype=torch.bfloat16)


def product(v, a):
    return v @ a.mT


def transposed(v, a):
    return v @ a


def by_matrix(a):
    return operators.Matrix(a)


def by_function(a):
    return operators.Function(product, transposed, (a,))


@pytest.mark.parametrize("operator", [by_matrix, by_function])
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("solver", [prdp.GMRES(3, restart=5, rtol=0.0), prdp.Direct()], ids=["gmres", "direct"])
def test_solves_and_gradients_are_those_without_autocast(operator, backward, solver):
    a, b = spd_matrices(1, N, dtype=torch.float32)[0], field((N,), dtype=torch.float32)[:, 0]

    def gradients():
        leaves = a.clone().requires_grad_(), b.clone().requires_grad_()
        u = prdp.linear_solve(operator(leaves[0]), leaves[1], solver, backward=backward)[0]
        return u, *torch.autograd.grad((u * b).sum(), leaves)

    expected = gradients()
    with autocast():
        found = gradients()
    for f, e in zip(found, expected, strict=True):
        assert f.dtype == torch.float32 and torch.equal(f, e)


@pytest.mark.parametrize("operator", [by_matrix, by_function])
def test_products_keep_their_dtype(operator):
    a, v = operator(spd_matrices(1, N, dtype=torch.float32)[0]), field((N,), dtype=torch.float32)[:, 0]
    expected = a.apply(v), a.apply_transpose(v)
    with autocast():
        found = a.apply(v), a.apply_transpose(v)
    for f, e in zip(found, expected, strict=True):
        assert f.dtype == torch.float32 and torch.equal(f, e)


STEPS = [
    (prdp.Heat, 1, (16,), prdp.CG(5)),
    (prdp.Burgers, 2, (8, 8), prdp.GMRES(3)),
    (prdp.NavierStokes, 3, (8, 8), prdp.GMRES(5, preconditioner="multigrid")),
]


@pytest.mark.parametrize("low", LOW)
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("way", ["step", "rollout"])
@pytest.mark.parametrize("stepper, channels, shape, solver", STEPS, ids=["heat", "burgers", "navier_stokes"])
def test_low_precision_is_taken_for_float32(stepper, channels, shape, solver, way, backward, low):
    step = stepper(shape, 1e-2, 0.01, solver, backward)
    take = step if way == "step" else lambda u: step.rollout(u, 2)
    u = field(shape, channels=channels).to(low)

    def gradient(u):
        u = u.requires_grad_()
        after = take(u)
        return after, *torch.autograd.grad(after[..., : max(channels - 1, 1), :, :].square().sum(), u)

    expected = gradient(u.float())
    with autocast():
        after, u_bar = gradient(u.clone())
    assert after.dtype == torch.float32 and torch.equal(after, expected[0])
    assert u_bar.dtype == low and torch.equal(u_bar, expected[1].to(low))
    with pytest.raises(TypeError, match="expected float32 or float64"):
        take(u)


def test_a_network_goes_straight_into_a_step():
    torch.manual_seed(0)
    network, heat = torch.nn.Linear(N, N), prdp.Heat((N,), 1e-3, 1.0, prdp.CG(20))
    u = field((N,), dtype=torch.float32)
    with autocast():
        output = network(u)
        loss = heat(output).square().mean()
        loss.backward()
    assert output.dtype == torch.bfloat16 and loss.dtype == torch.float32
    assert network.weight.grad.dtype == torch.float32 and network.weight.grad.any()


@pytest.mark.parametrize("low", LOW)
def test_operators_of_low_precision_are_taken_for_float32(low):
    winds, v = field((8, 8), channels=2).to(low), field((8, 8), channels=2, seed=1).to(low)
    matrix, rhs = spd_matrices(1, N)[0].to(low), field((N,))[:, 0].to(low)
    nu = torch.tensor(1e-2).to(low)
    expected = [
        operators.Burgers(winds.float(), nu.float(), 0.1).apply(v.float()),
        prdp.linear_solve(operators.Burgers(winds.float(), nu.float(), 0.1), v.float(), prdp.GMRES(3))[0],
        prdp.linear_solve(matrix.float(), rhs.float(), prdp.CG(3))[0],
        prdp.Heat((8,), nu.float(), 0.1, prdp.Jacobi(3))(v[:, :1, 0].float()),
    ]
    with autocast():
        found = [
            operators.Burgers(winds, nu, 0.1).apply(v),
            prdp.linear_solve(operators.Burgers(winds, nu, 0.1), v, prdp.GMRES(3))[0],
            prdp.linear_solve(matrix, rhs, prdp.CG(3))[0],
            prdp.Heat((8,), nu, 0.1, prdp.Jacobi(3))(v[:, :1, 0]),
        ]
    for f, e in zip(found, expected, strict=True):
        assert f.dtype == torch.float32 and torch.equal(f, e)


# Every entry of the library, from tensors: what it hands out, a tensor or several.
SHAPE = (6, 8)
BOX = {"boundary": ("wall", "open")}
FIVE = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)]


def report(u_and_info):
    return u_and_info[0]


def stencil(c):
    signs, centre = torch.tensor([1, -1, -1, -1, -1]), torch.tensor([5, 0, 0, 0, 0])
    return operators.Stencil(c.abs().clamp(max=1) * signs.view(5, 1, 1) + centre.view(5, 1, 1), FIVE)


def csr(values):
    crow, col = torch.arange(N + 1), torch.arange(N)
    return operators.Matrix.csr(crow, col, 1 + values.abs(), N)


def diffusion(kappa, h):
    side = ("robin", h.abs())
    return operators.Diffusion(0.5 + kappa.abs(), 1.0, boundary=[(side, "zero"), "flux"])


def learned(b, u):
    """b is the output of a network, of low precision."""
    return prdp.ImplicitStep(operators.Heat(SHAPE, 1e-2, 0.1), lambda v: b, prdp.CG(9))(u)


def failed():
    b = field(SHAPE)
    b[1] = torch.nan
    return prdp.linear_solve(operators.Heat(SHAPE, 1e-2, 0.1), b, prdp.CG(3), on_failure="return")[1]


VELOCITY, SCALAR, VECTOR = (2, 2, *SHAPE), (2, 1, *SHAPE), (2, N)


def with_lid(speed):
    return prdp.Flow(SHAPE, 1.0, 1e-3, boundary="wall", wall_velocity={(0, "high"): speed})


ENTRIES = {
    "Flow": (lambda u, nu: prdp.Flow(SHAPE, nu.abs(), 1e-3)(u), [VELOCITY, ()]),
    "Flow, unrolled": (lambda u: prdp.Flow(SHAPE, 1.0, 1e-3, backward="unrolled")(u), [VELOCITY]),
    "Flow, force": (lambda u, f: prdp.Flow(SHAPE, 1.0, 1e-3, force=f)(u), [VELOCITY, VELOCITY]),
    "Flow, inflow": (lambda u, f: prdp.Flow(SHAPE, 1.0, 1e-3, inflow=f, **BOX)(u), [VELOCITY, (2,)]),
    "Flow.wall_velocity": (lambda u, w: with_lid(w)(u), [VELOCITY, ()]),
    "Flow.rollout": (lambda u: prdp.Flow(SHAPE, 1.0, 1e-3).rollout(u, 2), [VELOCITY]),
    "Flow.step_and_pressure": (lambda u: prdp.Flow(SHAPE, 1.0, 1e-3).step_and_pressure(u), [VELOCITY]),
    "Flow.project": (lambda u: prdp.Flow(SHAPE, 1.0, 1e-3).project(u), [VELOCITY]),
    "Flow.pressure": (lambda u: prdp.Flow(SHAPE, 1.0, 1e-3).pressure(u), [VELOCITY]),
    "Flow.divergence": (lambda u: prdp.Flow(SHAPE, 1.0, 1e-3).divergence(u), [VELOCITY]),
    "Poisson": (lambda u: prdp.Poisson(SHAPE, prdp.CG(9))(u), [SCALAR]),
    "Heat": (lambda u, nu: prdp.Heat(SHAPE, nu.abs(), 0.1, prdp.CG(9))(u), [SCALAR, ()]),
    "Heat.rhs": (lambda u: prdp.Heat(SHAPE, 0.1, 0.1, prdp.CG(9)).rhs(u), [SCALAR]),
    "Burgers.rollout": (lambda u: prdp.Burgers(SHAPE, 0.1, 0.1, prdp.GMRES(9)).rollout(u, 2), [VELOCITY]),
    "Burgers.operator": (lambda u: prdp.Burgers(SHAPE, 0.1, 0.1, prdp.GMRES(9)).operator(u).dense(torch.float32),
                         [VELOCITY]),
    "NavierStokes": (lambda u: prdp.NavierStokes(SHAPE, 0.1, 0.1, prdp.GMRES(9))(u)[:, :2], [(2, 3, *SHAPE)]),
    "ImplicitStep": (lambda u: prdp.ImplicitStep(operators.Heat(SHAPE, 1e-2, 0.1), solver=prdp.CG(9)).rollout(u, 2),
                     [SCALAR]),
    "ImplicitStep, rhs": (learned, [SCALAR, SCALAR]),
    "ImplicitStep, start": (lambda c, u: prdp.ImplicitStep(stencil(c), solver=prdp.CG(9), start="state")(u),
                            [(1, 5, *SHAPE), SCALAR]),
    "linear_solve": (lambda k, b: report(prdp.linear_solve(operators.Matrix(N * torch.eye(N) + k @ k.mT), b,
                                                           prdp.CG(9))), [(N, 2), VECTOR]),
    "linear_solve, x0": (lambda b, x: report(prdp.linear_solve(operators.Heat(SHAPE, 1e-2, 0.1), b, prdp.CG(3), x0=x)),
                         [SCALAR, SCALAR]),
    "linear_solve, a lone vector": (lambda v, b: report(prdp.linear_solve(csr(v), b, prdp.Direct())), [(N,), (N,)]),
    "preconditioner": (lambda v, b: report(prdp.linear_solve(csr(v), b, prdp.CG(3, preconditioner=csr(1 / v)))),
                       [(N,), VECTOR]),
    "multigrid": (lambda c, b: report(prdp.linear_solve(stencil(c), b, prdp.CG(9, preconditioner="multigrid"))),
                  [(2, 5, *SHAPE), SCALAR]),
    "Matrix.csr": (lambda v, b: csr(v).apply(b), [(2, N), VECTOR]),
    "Matrix, sparse": (lambda b: operators.Matrix(torch.eye(N).to_sparse_csr().to(b.dtype)).apply(b), [VECTOR]),
    "Stencil": (lambda c, b: stencil(c).apply_transpose(b), [(2, 5, *SHAPE), SCALAR]),
    "Stencil.diagonal": (lambda c: stencil(c).diagonal(), [(2, 5, *SHAPE)]),
    "Stencil, nullspace": (lambda b, q: report(prdp.linear_solve(
        operators.Stencil(torch.tensor([2.0, -1, -1]).to(b.dtype).view(1, 3, 1).expand(1, 3, 4), [(0,), (1,), (-1,)],
                          "periodic", nullspace=torch.ones_like(q)), b - b.flip(-1), prdp.CG(4))),
        [(2, 1, 4), (1, 4)]),
    "Diffusion": (lambda k, h, b: report(prdp.linear_solve(diffusion(k, h), b, prdp.CG(9))),
                  [(1, *SHAPE), (1, 8), SCALAR]),
    "Diffusion.boundary_rhs": (lambda k, h, v: diffusion(k, h).boundary_rhs(values=[(v, 0.0), (0.0, 0.0)]),
                               [(1, *SHAPE), (1, 8), ()]),
    "Function": (lambda k, b: report(prdp.linear_solve(operators.Function(lambda v, k: v + v @ (k @ k.mT), tensors=k,
                                                                          symmetric=True), b, prdp.CG(9))),
                 [(N, 2), VECTOR]),
    "detach_failed": (lambda u: prdp.detach_failed(u, failed()), [SCALAR]),
    "fields.divergence": (prdp.fields.divergence, [VELOCITY]),
    "fields.curl": (prdp.fields.curl, [VELOCITY]),
    "fields.project": (prdp.fields.project, [VELOCITY]),
    "fields.downsample": (prdp.fields.downsample, [(2, 2, 5, 7)]),
    "fields.rollout": (lambda u: prdp.fields.rollout(prdp.Heat(SHAPE, 0.1, 0.1, prdp.CG(9)), u, 2), [SCALAR]),
}  # fmt: skip
WITHOUT_TENSORS = {"Advice", "LinearSchedule", "PRDPController", "SolveInfo", "SolveStatus", "Solver", "Stepper",
                   "ToleranceController", "experiments", "load_trained"}  # fmt: skip
WITHOUT_TENSORS |= {"fields", "operators", "warm_up"}
CHECKED_BELOW = {"advise", "check_operator"}


def test_no_entry_is_left_out():
    solvers = {name for name in prdp.__all__ if isinstance(getattr(prdp, name), type)
               and issubclass(getattr(prdp, name), prdp.Solver)}  # fmt: skip
    named = {name.split(",")[0].split(".")[0] for name in ENTRIES}
    assert set(prdp.__all__) - solvers - WITHOUT_TENSORS - CHECKED_BELOW <= named
    of_fields = {name for name, f in vars(prdp.fields).items() if getattr(f, "__module__", "") == "prdp_torch.fields"}
    assert {f"fields.{name}" for name in of_fields if not name.startswith("_")} <= set(ENTRIES)
    assert set(operators.__all__) - {"Operator", "Burgers", "Heat", "NavierStokes", "Poisson"} <= named
    of_flow = {name for name in vars(prdp.Flow) if not name.startswith("_")}
    of_flow -= {"start", "extra_repr", "forward", "fill_pockets"}  # the last takes a mask
    assert {f"Flow.{name}" for name in of_flow} <= set(ENTRIES)


@pytest.mark.filterwarnings("ignore:Sparse CSR tensor support")
@pytest.mark.parametrize("low", LOW)
@pytest.mark.parametrize("name", ENTRIES)
def test_every_entry_takes_the_output_of_a_network(name, low):
    entry, shapes = ENTRIES[name]
    given = [random(*shape, seed=i).to(low) for i, shape in enumerate(shapes)]

    def run(given):
        leaves = [t.clone().requires_grad_() for t in given]
        out = entry(*leaves)
        out = out if isinstance(out, tuple) else (out,)
        loss = sum(t.float().square().sum() for t in out)
        gradients = torch.autograd.grad(loss, leaves, allow_unused=True) if loss.requires_grad else []
        return [t.detach() for t in out], gradients

    expected, slopes = run([t.float() for t in given])
    with autocast():
        found, gradients = run(given)
    for f, e in zip(found, expected, strict=True):
        assert f.dtype == (low if name == "detach_failed" else torch.float32)  # which only hands u on
        torch.testing.assert_close(f.float(), e, rtol=0.05, atol=0.02)  # torch's own operations on low precision
    for g, e in zip(gradients, slopes, strict=True):
        assert (g is None) == (e is None) and (g is None or g.dtype == low)
        if g is not None:
            torch.testing.assert_close(g.float(), e, rtol=0.1, atol=0.02 * e.abs().max().item() + 1e-3)


@pytest.mark.parametrize("low", LOW)
def test_a_parameter_of_low_precision_is_trained(low):
    values = torch.nn.Parameter(torch.ones(N, dtype=low))
    crow, col = torch.arange(N + 1), torch.arange(N)
    with autocast():
        step = prdp.ImplicitStep(operators.Matrix.csr(crow, col, values, N), solver=prdp.CG(3))
        u = step(random(*VECTOR).to(low))
        u.square().sum().backward()
    assert list(step.parameters()) == [values] and values.grad.dtype == low and values.grad.all()
    assert u.dtype == torch.float32


def test_checks_and_advice_take_low_precision():
    kappa, v = 0.5 + random(1, *SHAPE).abs().bfloat16(), random(*SCALAR).bfloat16()
    step = prdp.Heat((8,), 1e-2, 0.1, prdp.CG(3))
    with autocast():
        assert prdp.check_operator(operators.Diffusion(torch.nn.Parameter(kappa)), v)
        assert prdp.check_operator(spd_matrices(1, N)[0].bfloat16(), random(*VECTOR).bfloat16())
        assert prdp.advise(step, field((8,)).bfloat16(), seconds=0.01)


def test_double_precision_stays():
    heat, u = prdp.Heat((8,), 1e-2, 0.1, prdp.Jacobi(3)), field((8,))
    with autocast():
        found = heat(u)
    assert found.dtype == torch.float64 and torch.equal(found, heat(u))


def test_a_compiled_step_takes_low_precision_too():
    torch._dynamo.reset()
    heat, u = prdp.Heat((8,), 1e-2, 0.1, prdp.Jacobi(3)), field((8,)).bfloat16()
    step = torch.compile(heat, fullgraph=True, backend="aot_eager")
    with autocast():
        assert torch.equal(step(u), heat(u))


@pytest.mark.filterwarnings("default:adjoint solve. the cotangent of")
@pytest.mark.parametrize("on_failure", ["return", "zero_grad"])
def test_an_infinite_cotangent_is_not_dropped_in_silence(on_failure):
    said = torch.is_warn_always_enabled()
    torch.set_warn_always(True)  # else once
    try:
        u = field((8,)).requires_grad_()
        v = prdp.Heat((8,), 1e-2, 0.1, prdp.CG(9), on_failure=on_failure)(u)
        with pytest.warns(UserWarning, match="cotangent of 2 of 2 samples contains NaN or Inf.* A GradScaler cannot"):
            v.backward(torch.full_like(v, torch.inf))
    finally:
        torch.set_warn_always(said)
    assert not u.grad.any()
