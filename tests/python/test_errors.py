"""Bad tensors, methods that do not suit, and builds that cannot be loaded: clear errors, tested by their words."""

from types import SimpleNamespace

import pytest
import torch
from helpers import field
from stand_in_device import StandIn

import prdp_torch as prdp
from prdp_torch import operators


def heat(**options):
    options.setdefault("solver", prdp.Jacobi(3))
    return prdp.Heat((30,), 1e-3, 1.0, **options)


@pytest.mark.parametrize(
    "u, message",
    [
        (torch.zeros(25, 30), r"Heat: expected \(batch, 1, 30\), got \(25, 30\)"),
        (torch.zeros(25, 2, 30), r"Heat: expected \(batch, 1, 30\), got \(25, 2, 30\)"),
        (torch.zeros(25, 1, 31), r"Heat: expected \(batch, 1, 30\), got \(25, 1, 31\)"),
        (torch.zeros(25, 1, 30, 1), r"Heat: expected \(batch, 1, 30\), got \(25, 1, 30, 1\)"),
    ],
)
def test_wrong_shapes(u, message):
    with pytest.raises(ValueError, match=message):
        heat()(u)


@pytest.mark.parametrize("dtype", [torch.int64, torch.float16, torch.complex64])
def test_wrong_dtypes(dtype):
    with pytest.raises(TypeError, match="Heat: expected float32 or float64, got"):
        heat()(torch.zeros(2, 1, 30, dtype=dtype))


def test_matrix_and_right_hand_side_must_fit():
    with pytest.raises(ValueError, match=r"a matrix of 3 rows needs b of shape \(3,\) or \(batch, 3\), got \[2, 4\]"):
        prdp.linear_solve(torch.eye(3), torch.zeros(2, 4), prdp.Jacobi(1))
    with pytest.raises(ValueError, match="A holds 5 matrices, b holds 2 right-hand sides"):
        prdp.linear_solve(torch.eye(3).expand(5, 3, 3), torch.zeros(2, 3), prdp.Jacobi(1))
    with pytest.raises(TypeError, match="A is float64 but b is float32"):
        prdp.linear_solve(torch.eye(3, dtype=torch.float64), torch.zeros(3), prdp.Jacobi(1))
    with pytest.raises(ValueError, match="A is on meta but b is on cpu"):
        prdp.linear_solve(torch.eye(3, device="meta"), torch.zeros(3), prdp.Jacobi(1))


OFFSETS = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]


def five_points(**options):
    c = -torch.ones(1, 5, 5, 6)
    c[:, 0] = 4.0
    return operators.Stencil(c, OFFSETS, "periodic", **options)


def robin(kappa, h):
    return operators.Diffusion(kappa, 1.0, boundary=("zero", (("robin", h), "flux")))


ELSEWHERE = {  # of a tensor that is not where b is: the operator, channels of b, and the message
    "stencil": (lambda t: operators.Stencil(t(1, 5, 5, 6), OFFSETS, "zero"), 1, "Stencil: the coefficients are on"),
    "kappa": (lambda t: operators.Diffusion(t(1, 5, 6)), 1, "Diffusion: its tensors are on"),
    "shift": (lambda t: operators.Diffusion(torch.ones(1, 5, 6), t(1, 5, 6)), 1, "Diffusion: its tensors are on"),
    "h": (lambda t: robin(torch.ones(1, 5, 6), t(1, 5)), 1, "Diffusion: its tensors are on"),
    "burgers": (lambda t: operators.Burgers(t(1, 2, 5, 6), 0.1, 0.1), 2, "Burgers: the winds are on"),
    "navier-stokes": (lambda t: operators.NavierStokes(t(1, 2, 5, 6), 0.1, 0.1), 3, "NavierStokes: the winds are on"),
    "null space": (lambda t: five_points(nullspace=t(1, 5, 6)), 1, "Stencil: its null space is on"),
}  # fmt: skip


@pytest.mark.parametrize("name", ELSEWHERE)
def test_a_tensor_on_another_device_is_named_with_both(name):
    make, channels, message = ELSEWHERE[name]
    a = make(lambda *shape: torch.ones(*shape, device="meta"))
    b = torch.zeros(1, channels, 5, 6)
    for graph in (torch.no_grad, torch.enable_grad):
        with graph(), pytest.raises(ValueError, match=f"{message} meta but the vector is on cpu"):
            prdp.linear_solve(a, b, prdp.GMRES(1))


@pytest.mark.parametrize("name", ["stencil", "kappa", "burgers", "navier-stokes"])
def test_so_is_one_on_another_device_of_the_same_kind(name):
    make, channels, message = ELSEWHERE[name]
    with StandIn() as first:
        a = make(lambda *shape: first.send(torch.ones(*shape), torch.device("lazy", 1)))
        b = first.send(torch.zeros(1, channels, 5, 6))
        with pytest.raises(ValueError, match=f"{message} lazy:1 but the vector is on lazy:0"):
            prdp.linear_solve(a, b, prdp.GMRES(1))


def test_a_start_on_another_device_is_named_with_both():
    with pytest.raises(ValueError, match=r"x0 must have .* device of b, .* on cpu, got .* on meta"):
        prdp.linear_solve(five_points(), torch.zeros(1, 1, 5, 6), prdp.CG(1), x0=torch.zeros(1, 1, 5, 6, device="meta"))


@pytest.mark.parametrize(
    "settings",
    [
        {"nu": torch.tensor(0.1, device="meta")},
        {"nu": 0.1, "force": torch.ones(1, 2, 5, 6, device="meta")},
        {"nu": 0.1, "boundary": "wall", "wall_velocity": {(0, "high"): torch.ones(2, device="meta")}},
        {"nu": 0.1, "boundary": ("wall", "open"), "inflow": torch.ones(2, device="meta")},
    ],
    ids=lambda settings: list(settings)[-1],
)
def test_a_tensor_without_values_is_refused_by_a_flow(settings):
    with pytest.raises(ValueError, match="Flow: a tensor of it is on meta, where it has no values: give it some"):
        prdp.Flow((5, 6), dt=0.01, solver=prdp.CG(9), **settings)(torch.zeros(1, 2, 5, 6))


def test_a_tensor_without_values_is_refused_for_a_state_that_has_some():
    nu = torch.nn.Parameter(torch.tensor(1e-3, device="meta"))
    without = torch.ones(5, device="meta")
    function = operators.Function(lambda v, k: k * v, tensors=(without,))
    for call in (
        lambda: prdp.Heat((5,), nu, 1.0, prdp.CG(3))(torch.zeros(1, 1, 5)),
        lambda: prdp.Heat((5,), nu, 1.0, prdp.CG(3)).rollout(torch.zeros(1, 1, 5), 2),
        lambda: prdp.linear_solve(operators.Heat((5,), nu, 1.0), torch.zeros(1, 1, 5), prdp.Jacobi(1)),
        lambda: prdp.linear_solve(function, torch.zeros(1, 5), prdp.CG(1)),
    ):
        for graph in (torch.no_grad, torch.enable_grad):
            with graph(), pytest.raises(ValueError, match="one of its tensors is on meta, the vector on cpu; it has"):
                call()


def test_a_report_without_values_says_so():
    _, info = prdp.linear_solve(torch.empty(4, 4, device="meta"), torch.empty(2, 4, device="meta"), prdp.GMRES(2))
    assert repr(info) == "SolveInfo(2 samples on meta)"


def test_a_report_reads_well():
    step = heat()
    step(torch.ones(4, 1, 30))
    assert repr(step.info).startswith("SolveInfo(4 MAX_ITER; iterations 3 to 3, residual ")


def test_a_missing_or_foreign_build_says_what_to_do(monkeypatch, tmp_path):
    from prdp_torch import _load

    monkeypatch.setattr(_load, "_BUILT_FOR", tmp_path / "built_for_torch.txt")
    with pytest.raises(ImportError, match="the compiled library is missing; build it with"):
        _load.check_torch()
    (tmp_path / "built_for_torch.txt").write_text("2.0.1+cpu\n")
    with pytest.raises(
        ImportError,
        match=r"was built for torch 2.0.1\+cpu, but torch .* is installed; install torch 2.0.1\+cpu, or rebuild",
    ):
        _load.check_torch()


def test_a_build_for_cuda_is_that_for_the_cpu(monkeypatch, tmp_path):
    from prdp_torch import _load

    monkeypatch.setattr(_load, "_BUILT_FOR", tmp_path / "built_for_torch.txt")
    release = torch.__version__.partition("+")[0]
    for built_for in (release, f"{release}+cpu", f"{release}+cu130"):
        (tmp_path / "built_for_torch.txt").write_text(f"{built_for}\n")
        _load.check_torch()
    (tmp_path / "built_for_torch.txt").write_text(f"{release}.1\n")
    with pytest.raises(ImportError, match="rebuild prdp_torch for this one with 'pip install --force-reinstall --no-d"):
        _load.check_torch()


def test_a_library_that_cannot_be_loaded_says_what_to_do(monkeypatch):
    from prdp_torch import _load

    def refuse(name):
        raise ImportError(f"{name}: undefined symbol: _ZN3c10")

    monkeypatch.setattr(_load, "importlib", SimpleNamespace(import_module=refuse))
    with pytest.raises(ImportError, match=r"for another build of torch .*: undefined symbol: .*; rebuild it with 'pip"):
        _load.load_library()


def unsuited():
    """Methods that an operator does not support, and the words for it."""
    burgers = operators.Burgers(field((8,)), 1e-3, 1e-2)
    function = operators.Function(lambda v: v, lambda v: v)
    chebyshev = "Chebyshev: the spectrum is known of Heat and Poisson operators alone"
    multigrid = (
        'preconditioner "multigrid" is for Heat, Poisson, Burgers, Diffusion, NavierStokes, and Stencil .* not for this'
    )
    cycles = "the method Multigrid is for Heat, Poisson, Burgers, Diffusion, and Stencil"
    return [
        (burgers, prdp.Chebyshev(1), chebyshev),
        (function, prdp.Chebyshev(5), chebyshev),
        (function, prdp.Multigrid(3), cycles),
        (function, prdp.GMRES(3, preconditioner="multigrid"), multigrid),
        (function, prdp.Jacobi(1), "Function: its diagonal, which Jacobi and preconditioner"),
    ]


@pytest.mark.parametrize("max_iter", [0, 1, 5])
@pytest.mark.parametrize("scale", [0.0, 1.0])
@pytest.mark.parametrize("case", range(5))
def test_a_method_that_does_not_suit_the_operator_is_refused_whatever_b_is(case, scale, max_iter):
    a, solver, message = unsuited()[case]
    solver.max_iter = max_iter
    with pytest.raises(ValueError, match=message):
        prdp.linear_solve(a, scale * field((8,)), solver)


def test_jacobi_is_refused_by_a_zero_on_the_diagonal_whatever_b_is():
    matrix = torch.tensor([[0.0, 1.0], [1.0, 0.0]])
    for a in (matrix, matrix.to_sparse_csr()):
        with pytest.raises(torch.linalg.LinAlgError, match=r"ZERO_DIAGONAL in row \(0,\)"):
            prdp.linear_solve(a, torch.zeros(2), prdp.Jacobi(3))
    flow = operators.NavierStokes(field((4, 4), channels=3), 1e-3, 1e-2)
    with pytest.raises(torch.linalg.LinAlgError, match="ZERO_DIAGONAL"):
        prdp.linear_solve(flow, torch.zeros(2, 3, 4, 4, dtype=torch.float64), prdp.Jacobi(3))


def test_vectors_without_unknowns_are_refused():
    function = operators.Function(lambda v: v, lambda v: v)
    for solver in (prdp.CG(3), prdp.Direct()):
        with pytest.raises(ValueError, match=r"Function: every extent of a vector must be >= 1, got \[2, 0\]"):
            prdp.linear_solve(function, torch.zeros(2, 0), solver)
    stencil = operators.Stencil(torch.ones(1, 2, 4), [(0,), (1,)])
    for solver in (prdp.CG(3), prdp.Direct(), prdp.Jacobi(3), prdp.GMRES(3)):
        with pytest.raises(ValueError, match=r"Stencil: a vector must have at least one channel, got \[2, 0, 4\]"):
            prdp.linear_solve(stencil, torch.zeros(2, 0, 4), solver)
