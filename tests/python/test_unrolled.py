"""How the unrolled derivative is made: by a tape of the operations, or by autograd one iteration at a time, with all
iterates kept or some."""

import pytest
import torch
from helpers import field, spd_matrices, statuses
from torch.autograd import gradcheck
from torch.library import opcheck

import prdp_torch as prdp
from prdp_torch import operators
from prdp_torch.solvers import packed_options

pytestmark = pytest.mark.filterwarnings("ignore:linear_solve. the gradient of a sparse CSR tensor")

MATRIX = spd_matrices(3, 5)
# name: (operator out of its tensors, the tensors, shape of one right-hand side)
TAPED = {
    "heat_1d": (lambda nu: operators.Heat((7,), nu, 1.0), (torch.tensor(2e-3),), (1, 7)),
    "heat_3d": (lambda nu: operators.Heat((3, 2, 4), nu, 1.0), (torch.tensor(2e-3),), (1, 3, 2, 4)),
    "poisson_2d": (lambda: operators.Poisson((3, 4)), (), (1, 3, 4)),
    "dense": (operators.Matrix, (MATRIX[0],), (5,)),
    "dense_batched": (operators.Matrix, (MATRIX,), (5,)),
    "csr_batched": (lambda m: operators.Matrix(m.to_sparse_csr()), (MATRIX,), (5,)),
    "burgers_1d": (lambda w, nu: operators.Burgers(w, nu, 0.2), (field((6,), 3, 1), torch.tensor(2e-2)), (1, 6)),
    "burgers_2d_one_wind": (
        lambda w, nu: operators.Burgers(w, nu, 0.2),
        (field((3, 4), 1, 1, channels=2), torch.tensor(2e-2)),
        (2, 3, 4),
    ),
    "stencil": (
        lambda c: operators.Stencil(c, [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]),
        (torch.tensor([3.0, -0.5, -0.4, -0.7, -0.3])[:, None, None] * (1 + 0.1 * torch.rand(3, 5, 4, 3)),),
        (1, 4, 3),
    ),
    "navier_stokes": (
        lambda w, nu: operators.NavierStokes(w, nu, 0.1),
        (field((4, 3), 3, 1, channels=3), torch.tensor(1e-2)),
        (3, 4, 3),
    ),
}
METHODS = {
    "jacobi": lambda k: prdp.Jacobi(k, rtol=0.0),
    "steepest_descent": lambda k: prdp.SteepestDescent(k, rtol=0.0),
    "cg": lambda k: prdp.CG(k, rtol=0.0),
    "cg by diagonal": lambda k: prdp.CG(k, rtol=0.0, preconditioner="diagonal"),
    "bicgstab": lambda k: prdp.BiCGStab(k, rtol=0.0),
    "gmres": lambda k: prdp.GMRES(k, rtol=0.0, restart=3),
    "gmres by diagonal": lambda k: prdp.GMRES(k, rtol=0.0, restart=3, preconditioner="diagonal"),
}


def suits(name, method):
    """CG needs symmetry: elsewhere its iterations blow up, and their derivatives with them. Navier–Stokes has zeros on
    its diagonal."""
    if name == "navier_stokes":
        return method in ("gmres", "bicgstab")
    return not method.startswith("cg") or not name.startswith(("burgers", "stencil"))


CASES = [(name, method) for name in TAPED for method in METHODS if suits(name, method)]
EVERY = (1, 2, 3, 100, "sqrt")


def inputs_of(tensors, shape, dtype=torch.float64):
    tensors = [t.to(dtype if t.dim() else torch.float64).clone().requires_grad_() for t in tensors]
    return [field(shape[1:], 3, 4, dtype, channels=shape[0]) if len(shape) > 1 else
            torch.randn(3, *shape, dtype=dtype, generator=torch.Generator().manual_seed(4)), *tensors]  # fmt: skip


def gradients(make, inputs, solver, create_graph=False, **options):
    options = {"on_failure": "return", **options}  # Navier–Stokes refuses the mean of b's pressure
    inputs = [t.detach().clone().requires_grad_() for t in inputs]
    b, *tensors = inputs
    u, info = prdp.linear_solve(make(*tensors), b, solver, backward="unrolled", **options)
    g = torch.randn(u.shape, dtype=u.dtype, generator=torch.Generator().manual_seed(9))
    return torch.autograd.grad(u, inputs, g, create_graph=create_graph), info


@pytest.mark.parametrize("name, method", CASES)
@pytest.mark.parametrize("k", [1, 2, 4])
def test_the_tape_equals_autograd_through_the_recorded_iterations(name, method, k):
    make, tensors, shape = TAPED[name]
    inputs, solver = inputs_of(tensors, shape), METHODS[method](k)
    taped, _ = gradients(make, inputs, solver)
    recorded, _ = gradients(make, inputs, solver, create_graph=True)
    for one, other in zip(taped, recorded, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-11 * float(other.detach().abs().max()))
    assert all(bool(g.abs().max() > 0) for g in taped[: 2 if k > 1 else 1])


def function_operator(k):
    return operators.Function(lambda v, k: k * v + 0.3 * v.roll(1, 1), lambda v, k: k * v + 0.3 * v.roll(-1, 1), (k,))


# What autograd replays: no loops for the operator, or for the method.
REPLAYED = {
    "function_sd": (function_operator, (torch.rand(5) + 2,), (5,), prdp.SteepestDescent(5, rtol=0.0)),
    "function_gmres": (function_operator, (torch.rand(5) + 2,), (5,), prdp.GMRES(3, rtol=0.0, restart=2)),
    "function_cg_rtol": (function_operator, (torch.rand(5) + 2,), (5,), prdp.CG(4)),
    "chebyshev": (lambda nu: operators.Heat((7,), nu, 1.0), (torch.tensor(2e-3),), (1, 7), prdp.Chebyshev(7, rtol=0.0)),
    "direct": (operators.Matrix, (MATRIX,), (5,), prdp.Direct(3, rtol=0.0)),
}


@pytest.mark.parametrize("name", REPLAYED)
def test_replays_equal_autograd_through_all_iterations_at_once(name):
    make, tensors, shape, solver = REPLAYED[name]
    inputs = inputs_of(tensors, shape)
    replayed, _ = gradients(make, inputs, solver)
    recorded, _ = gradients(make, inputs, solver, create_graph=True)
    for one, other in zip(replayed, recorded, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-11 * float(other.detach().abs().max()))
        assert one.abs().max() > 0


@pytest.mark.parametrize("solver", [prdp.GMRES(6, rtol=0.0), prdp.Jacobi(300, rtol=1e-15), prdp.Direct()])
def test_a_function_solved_to_rounding_keeps_the_gradients_of_its_tensors(solver):
    found = []
    for backward in ("implicit", "unrolled"):
        k = (torch.arange(5.0, dtype=torch.float64) + 2).requires_grad_()
        a = operators.Function(lambda v, k: k * v + 0.1 * v.roll(1, 1), tensors=(k,), diagonal=lambda k: k)
        u, _ = prdp.linear_solve(a, field((5,))[:, 0], solver, backward=backward, on_failure="return")
        found += torch.autograd.grad(u.square().sum(), k)
    assert found[0].abs().min() > 0
    torch.testing.assert_close(found[1], found[0], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name, method", [*CASES, *((name, None) for name in REPLAYED)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_checkpoints_do_not_change_a_bit(name, method, dtype):
    make, tensors, shape, *solver = (TAPED if method else REPLAYED)[name]
    (solver,) = solver or (METHODS[method](7),)
    inputs = inputs_of(tensors, shape, dtype)
    plain, info = gradients(make, inputs, solver)
    for every in EVERY:
        found, other = gradients(make, inputs, solver, on_failure="return", checkpoint_every=every)
        assert all(torch.equal(one, two) for one, two in zip(plain, found, strict=True)), every
        once_more = info.adjoint.operator_applications + 2 * info.operator_applications
        assert (other.adjoint.operator_applications <= once_more).all()


@pytest.mark.parametrize("name, method", [case for case in CASES if case[0] in ("heat_1d", "burgers_1d", "dense")])
def test_checkpointed_derivatives_pass_gradcheck(name, method):
    make, tensors, shape = TAPED[name]

    def solve(b, *tensors):
        solver = METHODS[method](3)
        return prdp.linear_solve(make(*tensors), b, solver, backward="unrolled", checkpoint_every=2)[0]

    b, *tensors = inputs_of(tensors, shape)
    assert gradcheck(solve, (b.requires_grad_(), *tensors))


@pytest.mark.parametrize("method", METHODS)
def test_samples_keep_to_themselves(method):
    """Each its own count of iterations; one of zeros, one that is refused."""
    solver = METHODS[method](40)
    solver.rtol = 1e-4
    nu = torch.tensor(2e-3, dtype=torch.float64)
    b = field((12,), 5)
    b[1] = 0.0
    b[2] = torch.sin(torch.pi * torch.arange(1, 13) / 13)  # an eigenvector
    b[3, 0, 3] = float("nan")
    make = lambda nu: operators.Heat((12,), nu, 1.0)  # noqa: E731
    (together, _), info = gradients(make, [b, nu], solver, on_failure="return")
    assert len(set(info.iterations.tolist())) > 1 and statuses(info)[3] == "NONFINITE_INPUT"
    assert torch.equal(together[3], torch.zeros_like(together[3])) and together[1].abs().max() > 0
    g = torch.randn(b.shape, dtype=b.dtype, generator=torch.Generator().manual_seed(9))
    for i in (0, 1, 2, 4):
        x, own = b[i : i + 1].clone().requires_grad_(), nu.clone().requires_grad_()
        u, _ = prdp.linear_solve(make(own), x, solver, backward="unrolled")
        assert torch.equal(torch.autograd.grad(u, (x, own), g[i : i + 1])[0], together[i : i + 1])


@pytest.mark.parametrize("method", METHODS)
def test_a_nonfinite_cotangent_of_a_rollout_is_named_with_its_step(method):
    u, g = field((12,), 3), field((12,), 3, 7, channels=3).unsqueeze(2)
    g[0, 1] = 0.0
    results = []
    for bad in (False, True):
        step = prdp.Heat((12,), 2e-3, 1.0, METHODS[method](4), "unrolled", on_failure="return" if bad else "raise")
        x = u.clone().requires_grad_()
        cotangent = g.clone()
        cotangent[0, 2, 0, 5] = float("nan") if bad else 1.0
        states = step.rollout(x, 2)
        results.append(torch.autograd.grad(states, x, cotangent)[0])
    assert torch.equal(results[0][1:], results[1][1:])
    assert torch.equal(results[1][0], cotangent[0, 0])  # of the start itself: nothing comes back from step 2
    assert [prdp.SolveStatus(int(s)).name for s in step.adjoint_info.status[0]][1] == "NONFINITE_INPUT"
    step.on_failure = "raise"
    with pytest.raises(torch.linalg.LinAlgError, match=r"step 2 of 2: adjoint solve: 1 of 3 .* NONFINITE_INPUT"):
        torch.autograd.grad(step.rollout(x, 2), x, cotangent)


def test_powers_of_two_pass_through_exactly():
    nu = torch.tensor(2e-3, dtype=torch.float64)
    make = lambda nu: operators.Heat((12,), nu, 1.0)  # noqa: E731
    b = field((12,), 3)
    for method in METHODS.values():
        (b_bar, nu_bar), _ = gradients(make, [b, nu], method(5))
        (small, nu_small), _ = gradients(make, [b * 2.0**-900, nu], method(5))
        assert torch.equal(small, b_bar) and torch.equal(nu_small, nu_bar * 2.0**-900)


# Jacobi with respect to b alone: sweeps with Aᵀ, the first one free, and the residual. Else the iterations
# to be kept, all again one by one, and Aᵀ; BiCGStab has two products each. GMRES(3) has a residual after each
# cycle, run again also before it but in the first, and Aᵀ for that.
PRODUCTS = {"jacobi": 3, "bicgstab": 2 * (2 + 3 + 3), "gmres": 2 * 4 + (3 * 4 + 2) + (3 * 3 + 2)}
PRODUCTS |= {"steepest_descent": 2 + 3 + 3, "cg": 2 + 3 + 3}
PRODUCTS |= {"cg by diagonal": PRODUCTS["cg"], "gmres by diagonal": PRODUCTS["gmres"]}


@pytest.mark.parametrize("method", METHODS)
def test_the_report_counts_the_products_of_the_way_back(method):
    heat = prdp.Heat((12,), 1e-3, 1.0, solver=METHODS[method](3), backward="unrolled")
    b = field((12,)).requires_grad_()
    heat(b).sum().backward()
    info = heat.adjoint_info
    assert info.iterations.tolist() == [3, 3] and info.status.tolist() == heat.info.status.tolist()
    assert info.residual.isnan().all()
    assert info.operator_applications.tolist() == [PRODUCTS[method]] * 2


def test_a_compiled_step_with_checkpoints_gives_the_eager_gradients():
    torch._dynamo.reset()
    heat = prdp.Heat((9,), 1e-3, 1.0, solver=prdp.CG(5, rtol=0.0), backward="unrolled", checkpoint_every="sqrt")
    results = []
    for step in (heat, torch.compile(heat, fullgraph=True, backend="aot_eager")):
        u = field((9,)).requires_grad_()
        (step(u) ** 2).sum().backward()
        results.append(u.grad)
    assert torch.equal(*results)


def test_the_op_behind_it_passes_opcheck():
    b, nu = field((5,)), torch.tensor(1e-3, dtype=torch.float64)
    # One to be taken back, one that is solved: its derivative is a solve.
    said = torch.tensor([4, 3]), torch.tensor([-1, 1]), torch.tensor([0.1, 0.0], dtype=torch.float64)
    for make in METHODS.values():
        solver = make(4).method, 4, 1e-5, 3, make(4).preconditioner
        options = packed_options(*solver, "unrolled", checkpoint_every=2)
        args = (b, b, *said, [1, 1], [nu], "heat", [5], [1.0], False, None, *options)
        assert set(opcheck(torch.ops.prdp.unrolled_vjp.default, args).values()) == {"SUCCESS"}


@pytest.mark.parametrize(
    "options, error, message",
    [
        ({"checkpoint_every": 0}, ValueError, "Heat: checkpoint_every must be >= 1, 'sqrt' or None, got 0"),
        ({"checkpoint_every": "all"}, TypeError,
         "Heat: checkpoint_every must be a whole number, 'sqrt' or None, got 'all'"),
        ({"checkpoint_every": 2, "backward": "implicit"}, ValueError,
         "Heat: checkpoint_every is for backward = unrolled alone, got implicit"),
    ],
)  # fmt: skip
def test_bad_intervals_are_refused_in_words(options, error, message):
    with pytest.raises(error, match=message):
        prdp.Heat((5,), 1e-3, 1.0, prdp.CG(3), **{"backward": "unrolled", **options})
