"""Every tensor of every operator and stepper is trained, moved, saved and copied with the step that keeps it."""

import copy
import pickle

import numpy as np
import pytest
import torch

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64
FIVE = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)]
SHAPE = (4, 5)


def rand(*shape):
    generator = torch.Generator().manual_seed(sum(shape))
    return 0.5 + torch.rand(shape, dtype=F64, generator=generator)


def coefficients(batch):
    return torch.cat([6 + rand(batch, 1, *SHAPE), -rand(batch, 4, *SHAPE)], 1)


def tridiagonal(batch=()):
    """crow, col and values of a matrix of 20 rows."""
    matrix = (torch.eye(20) + torch.eye(20).roll(1, 0)).to_sparse_csr()
    values = torch.where(matrix.values() > 0, 1.0, 0.0) * rand(*batch, 40)
    return matrix.crow_indices(), matrix.col_indices(), values + 0.2


def times(v, k, s):
    return k * v + s * v.sum(-1, keepdim=True)


def with_sides(kappa, shift, **h):
    axes = [tuple(("robin", h.get(f"robin_{axis}_{end}", 0.5)) for end in ("low", "high")) for axis in range(2)]
    return operators.Diffusion(kappa, shift, boundary=axes)


# How to make each from the tensors that it takes, by the names of its arguments, and vectors for it.
GRID, FIELD = (2, 1, *SHAPE), (1, *SHAPE)
MADE = {
    "Poisson": (lambda: operators.Poisson(SHAPE), {}, GRID),
    "Heat": (lambda nu: operators.Heat(SHAPE, nu, 0.1), {"nu": rand()}, GRID),
    "Burgers": (lambda winds, nu: operators.Burgers(winds, nu, 0.1), {"winds": rand(1, 2, *SHAPE), "nu": rand()},
                (2, 2, *SHAPE)),
    "NavierStokes": (lambda velocity, nu: operators.NavierStokes(velocity, nu, 0.1),
                     {"velocity": rand(1, 2, *SHAPE), "nu": rand()}, (2, 3, *SHAPE)),
    "Diffusion": (operators.Diffusion, {"kappa": rand(*FIELD), "shift": rand(*FIELD)}, GRID),
    "Diffusion, numbers": (operators.Diffusion, {"kappa": rand(2, *SHAPE), "shift": rand()}, GRID),
    "Diffusion, robin": (with_sides, {"kappa": rand(*FIELD), "shift": rand(), "robin_0_low": rand(1, 5),
                                      "robin_0_high": rand(), "robin_1_low": rand(2, 4), "robin_1_high": rand(1, 4)},
                         GRID),
    "Stencil": (lambda coefficients: operators.Stencil(coefficients, FIVE), {"coefficients": coefficients(1)}, GRID),
    "Matrix": (operators.Matrix, {"matrix": torch.eye(20, dtype=F64) * 20 + rand(20, 20)}, (2, 20)),
    "Matrix.csr": (lambda values: operators.Matrix.csr(*tridiagonal()[:2], values, 20), {"values": tridiagonal()[2]},
                   (2, 20)),
    "Matrix.csr, batch": (lambda values: operators.Matrix.csr(*tridiagonal()[:2], values, 20),
                          {"values": tridiagonal((2,))[2]}, (2, 20)),
    "Function": (lambda tensors_0, tensors_1: operators.Function(times, tensors=(tensors_0, tensors_1)),
                 {"tensors_0": 9 + rand(20), "tensors_1": rand()}, (2, 20)),
}  # fmt: skip
of_all = pytest.mark.parametrize("name", MADE)


def made(name, wrap=torch.nn.Parameter, factor=1.0):
    make, tensors, _ = MADE[name]
    return make(**{argument: wrap(factor * t) for argument, t in tensors.items()})


def step_of(name, wrap=torch.nn.Parameter, factor=1.0):
    return prdp.ImplicitStep(made(name, wrap, factor), solver=prdp.GMRES(4, restart=8), on_failure="return")


def vector(name, dtype=F64):
    v = torch.randn(MADE[name][2], dtype=F64, generator=torch.Generator().manual_seed(7))
    v = v - v.mean((-2, -1), keepdim=True) if v.dim() > 2 else v
    return v.to(dtype)


def update(step, name, dtype=F64):
    optimiser = torch.optim.Adam(step.parameters(), lr=1e-2)
    optimiser.zero_grad()
    step(vector(name, dtype)).square().sum().backward()
    optimiser.step()


def test_no_operator_is_left_out():
    assert {name.split(",")[0].split(".")[0] for name in MADE} == set(operators.__all__) - {"Operator"}


@of_all
def test_parameters_are_trained_under_the_names_of_their_arguments(name):
    if not MADE[name][1]:
        return
    step = step_of(name)
    names = {f"operator_at.{argument}" for argument in MADE[name][1]}
    assert dict(step.named_parameters()).keys() == names
    before, outcome = {n: p.clone() for n, p in step.named_parameters()}, step(vector(name))
    update(step, name)
    for n, p in step.named_parameters():
        assert (p != before[n]).any() and p.shape == before[n].shape, n
    after = step(vector(name))
    assert not torch.equal(after, outcome)
    now = {n.removeprefix("operator_at."): p.detach() for n, p in step.named_parameters()}
    assert torch.equal(after, prdp.linear_solve(MADE[name][0](**now), vector(name), prdp.GMRES(4, restart=8),
                                                on_failure="return")[0])  # fmt: skip


@of_all
@pytest.mark.parametrize("wrap", [torch.nn.Parameter, torch.clone], ids=["parameters", "buffers"])
@pytest.mark.parametrize("assign", [False, True])
def test_they_are_saved_and_loaded(name, wrap, assign):
    step, other = step_of(name, wrap), step_of(name, wrap, factor=1.5)
    state = step.state_dict()
    indices = {"operator_at.crow", "operator_at.col"} if "csr" in name else set()
    assert state.keys() == {f"operator_at.{argument}" for argument in MADE[name][1]} | indices
    expected = step(vector(name))
    assert not MADE[name][1] or not torch.equal(other(vector(name)), expected)
    other.load_state_dict(state, assign=assign)
    assert torch.equal(other(vector(name)), expected)
    if wrap is torch.nn.Parameter and MADE[name][1]:
        update(other, name)
        assert not torch.equal(other(vector(name)), expected)


@of_all
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda step: pickle.loads(pickle.dumps(step))])
def test_copies_are_trained_alone(name, copied):
    if name == "Function" and copied is not copy.deepcopy:
        return  # its functions of this module are pickled by test_implicit_step.py
    step = step_of(name)
    expected = step(vector(name))
    other = copied(step)
    assert torch.equal(other(vector(name)), expected)
    if MADE[name][1]:
        update(other, name)
        assert not torch.equal(other(vector(name)), expected)
    assert torch.equal(step(vector(name)), expected)


@of_all
@pytest.mark.parametrize("wrap", [torch.nn.Parameter, torch.clone], ids=["parameters", "buffers"])
def test_they_move_and_are_trained_there(name, wrap):
    step = step_of(name, wrap).to(torch.float32)
    low = step(vector(name, torch.float32))
    assert low.dtype == torch.float32 and all(t.dtype != F64 for t in step.state_dict().values())
    torch.testing.assert_close(low.double(), step_of(name)(vector(name)), rtol=1e-2, atol=1e-4)
    if wrap is torch.nn.Parameter and MADE[name][1]:
        update(step, name, torch.float32)
        assert not torch.equal(step(vector(name, torch.float32)), low)
    assert step.to("meta")(vector(name, torch.float32).to("meta")).is_meta


@of_all
def test_functional_call_takes_other_tensors(name):
    if not MADE[name][1]:
        return
    step = step_of(name)
    before = step(vector(name))
    others = {n: (1.5 * p).detach().requires_grad_() for n, p in step.named_parameters()}
    u = torch.func.functional_call(step, others, vector(name))
    assert torch.equal(u, step_of(name, factor=1.5)(vector(name)))
    gradients = torch.autograd.grad(u.square().sum(), list(others.values()))
    assert all(g.any() for g in gradients)
    assert torch.equal(step(vector(name)), before)
    copy.deepcopy(step)


WRITES = {
    "data": lambda t, new: setattr(t, "data", new),
    "in data": lambda t, new: t.data.copy_(new),
    "numpy": lambda t, new: np.copyto(t.detach().numpy(), new.numpy()),
    "copy_": lambda t, new: t.detach().copy_(new),
}


@of_all
@pytest.mark.parametrize("written", WRITES)
@pytest.mark.parametrize("wrap", [torch.nn.Parameter, torch.clone], ids=["parameters", "buffers"])
def test_what_is_written_past_autograd_is_seen(name, wrap, written):
    make, tensors, _ = MADE[name]
    given = {argument: wrap(t.clone()) for argument, t in tensors.items()}
    a = make(**given)
    step = prdp.ImplicitStep(a, solver=prdp.Direct(), on_failure="return")
    for solve in (step, lambda b: prdp.linear_solve(a, b, prdp.Direct(), on_failure="return")[0]):
        solve(vector(name))
    for argument, t in given.items():
        WRITES[written](t, 1.5 * tensors[argument])
    expected = prdp.linear_solve(made(name, factor=1.5), vector(name), prdp.Direct(), on_failure="return")[0]
    assert torch.equal(step(vector(name)), expected)
    assert torch.equal(prdp.linear_solve(a, vector(name), prdp.Direct(), on_failure="return")[0], expected)


def test_null_spaces_are_saved_and_moved_as_they_were_given():
    basis = torch.ones(1, 20, dtype=F64)
    graph = torch.eye(20, dtype=F64) * 20 - 1
    for nullspace, names in (("constant", set()), (basis, {"operator_at.nullspace"})):
        a = operators.Matrix(torch.nn.Parameter(graph), nullspace=nullspace)
        step = prdp.ImplicitStep(a, solver=prdp.CG(9))
        assert step.state_dict().keys() == {"operator_at.matrix"} | names
        v = vector("Matrix") - vector("Matrix").mean(-1, keepdim=True)
        for moved in (step, copy.deepcopy(step).float()):
            dtype = moved.operator_at.matrix.dtype
            torch.testing.assert_close(moved(v.to(dtype)), v.to(dtype) / 20)


@pytest.mark.filterwarnings("ignore:linear_solve. the gradient of a sparse CSR tensor")
def test_a_sparse_parameter_is_refused_for_its_values():
    """torch can neither copy it nor train it by Adam."""
    sparse = torch.nn.Parameter(torch.eye(4).to_sparse_csr())
    for given in (sparse, operators.Matrix(sparse)):
        with pytest.raises(ValueError, match=r"ImplicitStep: .* give operators.Matrix.csr\(crow, col, values, size\)"):
            prdp.ImplicitStep(given, solver=prdp.CG(3))


def test_a_preconditioner_moves_with_its_step():
    inverse = operators.Matrix(torch.eye(20) / 20)
    step = prdp.ImplicitStep(torch.eye(20) * 20, solver=prdp.CG(9, preconditioner=inverse)).double()
    u = step(vector("Matrix"))
    torch.testing.assert_close(u, vector("Matrix") / 20)
    assert inverse.tensors[0].dtype == torch.float32 and step.to(F64).preconditioner is step.preconditioner


STEPPERS = {
    "Heat": lambda nu: prdp.Heat((6,), nu, 0.1, prdp.CG(9)),
    "Burgers": lambda nu: prdp.Burgers((6,), nu, 0.1, prdp.GMRES(9)),
    "NavierStokes": lambda nu: prdp.NavierStokes(SHAPE, nu, 0.1, prdp.GMRES(9), on_failure="return"),
    "Flow": lambda nu, force, inflow: prdp.Flow(SHAPE, nu, 1e-3, ("wall", "open"), force=force, inflow=inflow),
}
STATES = {"Heat": (2, 1, 6), "Burgers": (2, 1, 6), "NavierStokes": (2, 3, *SHAPE), "Flow": (2, 2, *SHAPE)}


@pytest.mark.parametrize("name", STEPPERS)
def test_built_in_steppers_do_the_same(name):
    tensors = {"nu": rand(), "force": rand(2), "inflow": rand(2)}
    tensors = tensors if name == "Flow" else {"nu": rand()}
    u = torch.randn(STATES[name], dtype=F64, generator=torch.Generator().manual_seed(3))

    def make(factor=1.0):
        return STEPPERS[name](**{n: torch.nn.Parameter(factor * t) for n, t in tensors.items()})

    step, other = make(), make(1.5)
    assert dict(step.named_parameters()).keys() == tensors.keys()
    before = step(u)
    other.load_state_dict(step.state_dict())
    assert torch.equal(other(u), before) and torch.equal(copy.deepcopy(step)(u), before)
    optimiser = torch.optim.Adam(step.parameters(), lr=1e-2)
    step(u).square().sum().backward()
    optimiser.step()
    assert all((p != other.get_parameter(n)).any() for n, p in step.named_parameters())
    assert not torch.equal(step(u), before)
    assert step.float()(u.float()).dtype == torch.float32


def test_nu_set_later_is_kept_as_what_it_is():
    heat, u = prdp.Heat((6,), 1e-2, 0.1, prdp.CG(9)), torch.ones(2, 1, 6, dtype=F64)
    number, buffer, parameter = 2e-2, rand(), torch.nn.Parameter(rand())
    for before in (number, buffer, parameter):
        for nu in (number, buffer, parameter, 2 * parameter):
            heat.nu = before
            state, parameters = list(heat.state_dict()), list(heat.parameters())
            heat.nu = nu
            if isinstance(nu, torch.Tensor) and nu is not parameter:  # for the next steps alone
                assert (list(heat.state_dict()), list(heat.parameters())) == (state, parameters)
                copied = copy.deepcopy(heat).nu
                assert copied is not nu and torch.is_tensor(copied) == bool(state)
            else:
                assert list(heat.parameters()) == ([nu] if nu is parameter else [])
                assert list(heat.state_dict()) == ([] if nu is number else ["nu"])
            assert heat.nu is nu and torch.equal(heat(u), prdp.Heat((6,), nu, 0.1, prdp.CG(9))(u))
    with pytest.raises(TypeError, match="Heat: nu must be a real number, got 'large'"):
        heat.nu = "large"
    assert heat.nu is nu


RESULTS = {
    "exp": lambda t: operators.Diffusion(t.exp(), shift=1.0),
    "through what keeps nothing": lambda t: operators.Diffusion(t.exp().reshape(1, 6) + 1, shift=1.0),
    "Function": lambda t: operators.Function(lambda v, k: k * v, tensors=t.exp()[:, None]),
}


@pytest.mark.parametrize("of_step", [True, False])
@pytest.mark.parametrize("name", RESULTS)
def test_a_second_backward_pass_through_results_of_operations_says_what_to_do(name, of_step):
    theta, u = torch.nn.Parameter(torch.zeros(1, 6)), torch.ones(2, 1, 6)

    def solves():
        a = RESULTS[name](theta)
        step = prdp.ImplicitStep(a, solver=prdp.CG(9)) if of_step else None
        return step or (lambda b: prdp.linear_solve(a, b, prdp.CG(9))[0])

    again, kept = solves(), solves()
    again(u).sum().backward()
    for _ in range(2):  # and in each that follows
        with pytest.raises(
            RuntimeError, match=r"(Diffusion: kappa|Function: tensors_0) is a result of .* anew for each"
        ):
            again(u).sum().backward()
    for _ in range(3):  # which is allowed
        kept(u).sum().backward(retain_graph=True)
