"""Kernels as programs use them: compiled graphs, transforms, autocast, threads; and what a report says of them."""

import threading
import warnings

import pytest
import torch
from fibers import BACKWARD, ROOT, SHUFFLED, Fibers
from test_gpu_kernels import agree, noise, solve, sparse

import prdp_torch as prdp
from prdp_torch import operators

F32, F64 = torch.float32, torch.float64
SHAPE = (6, 7)


def heat(**options):
    return prdp.Heat(SHAPE, nu=1e-2, dt=1.0, solver=prdp.CG(max_iter=60, rtol=1e-10), **options)


def test_a_report_says_which_way_its_solve_went():
    step, u = heat(), noise(3, 1, *SHAPE)
    with Fibers():
        states = step.rollout(u, 2)
        assert step.info.way == "kernel" and "kernel" in repr(step.info)
    torch.testing.assert_close(step.rollout(u, 2), states, rtol=1e-9, atol=1e-12)
    assert step.info.way == "loops" and "loops" not in repr(step.info)
    own = operators.Function(lambda v: 2 * v, symmetric=True)
    assert prdp.linear_solve(own, u, prdp.CG(max_iter=5))[1].way == "tensors"


@pytest.mark.parametrize("start", ["zero", "state"])
def test_in_a_compiled_program(start):
    step, u = heat(start=start), noise(3, 1, *SHAPE).requires_grad_()

    def loss(u):
        return step(step(u)).square().sum()

    expected = torch.autograd.grad(loss(u), u)[0]
    with Fibers():
        compiled = torch.compile(loss, backend="aot_eager", fullgraph=True)
        found = torch.autograd.grad(compiled(u), u)[0]
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("on_failure", ["return", "zero_grad"])
def test_in_a_compiled_program_that_does_not_wait_for_a_report(on_failure):
    """The backward pass is traced where a kernel would run, and has no numbers there."""
    step = prdp.Burgers((16,), 1e-2, 1e-2, solver=prdp.GMRES(4, restart=3), on_failure=on_failure)
    u = noise(2, 1, 16).requires_grad_()
    expected = torch.autograd.grad(step(u).square().sum(), u)[0]
    with Fibers():
        compiled = torch.compile(lambda u: step(u).square().sum(), backend="aot_eager", fullgraph=True)
        found = torch.autograd.grad(compiled(u), u)[0]
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("start", ["zero", "state"])
@pytest.mark.parametrize(("method", "rtol"), [(prdp.Jacobi, 0.0), (prdp.Chebyshev, 0.0), (prdp.Jacobi, 3e-2)])
def test_unrolled_sweeps_go_back_in_a_kernel(method, rtol, start):
    """Their derivative for b is as many iterations with A transposed, of each sample as many as it took. Without a
    kernel, this would raise."""
    few = method(max_iter=7 if rtol == 0 else 60, rtol=rtol)
    step = prdp.Heat(SHAPE, nu=1e-2, dt=1.0, solver=few, backward="unrolled", start=start, on_failure="return")
    u = noise(3, 1, *SHAPE)
    u[1] = 1.0
    u.requires_grad_()
    expected = torch.autograd.grad(step.rollout(u, 2).square().sum(), u)[0]
    with Fibers():
        found = torch.autograd.grad(step.rollout(u, 2).square().sum(), u)[0]
        assert step.info.way == "kernel"
        assert (step.info.iterations.unique().numel() == 1) == (rtol == 0)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.filterwarnings("ignore:`torch.jit.script")
def test_in_transforms():
    """A batch of batches is one launch; a derivative along a direction is a solve of its own."""
    a, solver = operators.Heat(SHAPE, 1e-2, 1.0), prdp.CG(max_iter=60, rtol=1e-11)

    def u(b):
        return prdp.linear_solve(a, b, solver)[0]

    b, direction = noise(2, 3, 1, *SHAPE), noise(3, 1, *SHAPE, seed=1)
    expected = torch.stack([u(of) for of in b])
    tangent = u(direction)
    with Fibers():
        torch.testing.assert_close(torch.func.vmap(u)(b), expected, rtol=1e-8, atol=1e-10)
        found, along = torch.func.jvp(u, (b[0],), (direction,))
    torch.testing.assert_close(found, expected[0], rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(along, tangent, rtol=1e-8, atol=1e-10)


def test_under_autocast_and_from_another_thread():
    network, step = torch.nn.Conv2d(1, 1, 3, padding=1), prdp.Heat(SHAPE, nu=1e-2, dt=1.0, solver=prdp.CG(max_iter=9))
    u = noise(3, 1, *SHAPE, dtype=F32)
    gradients = []

    def train():
        network.zero_grad()
        with torch.autocast("cpu", dtype=torch.bfloat16):
            loss = step(network(u)).square().sum()
        loss.backward()
        gradients.append(network.weight.grad.clone())

    train()
    with Fibers():
        thread = threading.Thread(target=train)
        thread.start()
        thread.join()
    assert gradients[1].dtype == F32
    torch.testing.assert_close(*gradients, rtol=1e-2, atol=1e-3)


def test_long_bases():
    """A basis that no kernel holds is left to operations of torch."""
    a, b = operators.Heat(SHAPE, 1e-2, 1.0), noise(3, 1, *SHAPE)
    with Fibers():
        with pytest.raises(RuntimeError, match="PRDP_GPU=required: GMRES has no kernel"):
            prdp.linear_solve(a, b, prdp.GMRES(max_iter=2, restart=51))
        u, info = prdp.linear_solve(a, b, prdp.GMRES(max_iter=2, restart=50, rtol=1e-10))
    assert info.solved.all() and info.way == "kernel"
    torch.testing.assert_close(a.apply(u), b, rtol=1e-8, atol=1e-8)


PATTERN = sparse(1, F64)[0].to_sparse_csr()
OPERATORS_OF_A_STEP = {  # with numbers that are new in each step, and the shape of b
    "heat": (lambda seed: operators.Heat(SHAPE, 1e-2 + 1e-3 * seed, 1.0), (3, 1, *SHAPE)),
    "diffusion": (lambda seed: operators.Diffusion(1 + noise(3, *SHAPE, seed=seed).square(), 1.0), (3, 1, *SHAPE)),
    "burgers": (lambda seed: operators.Burgers(noise(3, 2, *SHAPE, seed=seed), 1e-2, 0.1), (3, 2, *SHAPE)),
    "sparse": (lambda seed: csr(PATTERN.values() * (1 + 0.01 * seed)), (3, 9)),
    "sparse matrices": (lambda seed: csr(PATTERN.values() * noise(3, 1, seed=seed).exp()), (3, 9)),
}
MEMORY = {"empty", "zero_", "unsqueeze", "expand", "as_strided"}


def csr(values, crow=None, col=None):
    crow, col = PATTERN.crow_indices() if crow is None else crow, PATTERN.col_indices() if col is None else col
    return operators.Matrix.csr(crow, col, values, 9)


@pytest.mark.parametrize(("name", "device"), [(name, {}) for name in OPERATORS_OF_A_STEP] + [("heat", {"cells": 16})])
@pytest.mark.parametrize("on_failure", ["return", "raise"])
def test_a_solve_is_one_launch_and_at_most_five_operations_of_torch(name, device, on_failure):
    """Views and memory alone, so that the host looks at nothing, forward and back; or at the statuses, once, where
    failures raise. A transposed sparse matrix is sorted."""
    make, shape = OPERATORS_OF_A_STEP[name]
    b, w, solver = noise(*shape).requires_grad_(), torch.ones(shape, dtype=F64), prdp.BiCGStab(max_iter=50, rtol=1e-8)

    def counted(run):
        before = fibers.launches()
        with torch.autograd.profiler.profile() as profiler:
            found = run()
        names = [e.name.removeprefix("aten::") for e in profiler.function_events if e.name.startswith("aten::")]
        assert fibers.launches() == before + 1
        return found, names

    with Fibers(poison=False, **device) as fibers:
        for seed in (0, 1):  # the first results of a kernel are compared
            a = make(seed)
            solved, forward = counted(lambda a=a: prdp.linear_solve(a, b, solver, on_failure=on_failure))
            _, back = counted(lambda u=solved[0]: torch.autograd.grad(u, b, w))
    for names in (forward, *([] if "sparse" in name else [back])):
        others = [n for n in names if n != "to"]
        assert len(names) - len(others) == (on_failure == "raise"), names
        assert len(others) <= (6 if name == "sparse matrices" else 5) and set(others) <= MEMORY, names


@pytest.mark.parametrize("captures", [False, True])
def test_a_first_result_is_looked_at_unless_a_graph_is_captured(captures):
    """A look would wait for the device, which nobody may do meanwhile; it is taken later."""
    a, b = operators.Heat((5, 3 + captures), 1e-2, 1.0), noise(3, 1, 5, 3 + captures)  # kernels that nobody has tried

    def looks(**device):
        with Fibers(poison=False, **device), torch.autograd.profiler.profile() as profiler:
            prdp.linear_solve(a, b, prdp.CG(max_iter=9, rtol=1e-8), on_failure="return")
        return "aten::_local_scalar_dense" in {event.name for event in profiler.function_events}

    assert looks(captures=captures) == (not captures)
    assert looks() == captures and not looks()


def test_the_parts_of_a_report_share_memory_but_for_an_op_of_torch():
    """Which may not return tensors that do: compiled graphs say so."""
    a, b, solver = operators.Heat(SHAPE, 1e-2, 1.0), noise(3, 1, *SHAPE), prdp.BiCGStab(max_iter=50, rtol=1e-8)
    options = prdp.solvers.packed_options(
        solver.method, 50, 1e-8, solver.restart, solver.preconditioner, "implicit", None, None, "return", None,
        adjoint_log=0,
    )  # fmt: skip
    with Fibers():
        info = prdp.linear_solve(a, b, solver, on_failure="return")[1]
        of_op = torch.ops.prdp.linear_solve(b, a.tensors, a.kind, a.shape, a.parameters, False, None, *options)[1:]
    parts = info.iterations, info.residual, info.status, info.operator_applications, info.floor
    assert len({part.untyped_storage().data_ptr() for part in parts}) == 1
    assert len({part.untyped_storage().data_ptr() for part in of_op}) == 5
    for part, other in zip(parts, of_op, strict=True):
        assert torch.equal(part, other) and part.dtype == other.dtype and part.is_contiguous()


PLACES = {  # what is wrong with a pattern of 23 values
    "a column": (None, 5, 9),
    "a negative column": (None, 22, -1),
    "the first row": (0, None, 1),
    "the last row": (9, None, 22),
    "rows that fall": (4, None, 2),
    "beyond the values": (4, None, 2**40),
}


@pytest.mark.parametrize("name", PLACES)
def test_a_kernel_refuses_a_pattern_that_is_none(name):
    """Without a look of the host: nothing is read where there is nothing; in the words of the CPU."""
    row, entry, wrong = PLACES[name]
    crow, col = (t.expand(3, -1).clone() for t in (PATTERN.crow_indices(), PATTERN.col_indices()))
    (crow[1] if entry is None else col[1])[row if entry is None else entry] = wrong
    values, b = PATTERN.values().expand(3, -1).clone(), noise(3, 9)
    leaf, solver = values.clone().requires_grad_(), prdp.BiCGStab(max_iter=100, rtol=1e-12)
    with pytest.raises(ValueError, match="of a CSR matrix") as expected:
        csr(values, crow, col)
    with Fibers():
        u, info = prdp.linear_solve(csr(leaf, crow, col), b, solver, on_failure="return")
        gradient = torch.autograd.grad(u.square().sum(), leaf)[0]
        for a in (csr(values, crow, col), csr(values[1], crow[1], col[1])):
            with pytest.raises(ValueError) as found:
                prdp.linear_solve(a, b, solver)
            assert str(found.value) == str(expected.value)
    assert [prdp.SolveStatus(int(s)).name for s in info.status] == ["CONVERGED", "NONFINITE_OPERATOR", "CONVERGED"]
    right = values.clone().requires_grad_()
    exact = prdp.linear_solve(csr(right), b, solver)[0]
    torch.testing.assert_close(u[::2], exact[::2], rtol=1e-9, atol=1e-11)
    of_right = torch.autograd.grad(exact.square().sum(), right)[0]
    torch.testing.assert_close(gradient[::2], of_right[::2], rtol=1e-8, atol=1e-10)
    assert not u[1].any() and not gradient[1].any()


@pytest.mark.parametrize("name", ["kappa", "h of a Robin side"])
def test_a_kernel_refuses_numbers_that_are_not_allowed(name):
    """Without a look of the host: the sample alone, and in the words of the CPU where failures raise."""
    kappa, h = 1 + noise(3, *SHAPE).square(), 1 + noise(3, SHAPE[0], seed=1).square()
    (kappa if name == "kappa" else h)[1, 2] = -0.5
    b, solver = noise(3, 1, *SHAPE), prdp.CG(max_iter=100, rtol=1e-10)

    def make(kappa, h):
        return operators.Diffusion(kappa, 1.0, boundary=("zero", (("robin", h), "flux")))

    with pytest.raises(ValueError, match=name) as expected:
        prdp.linear_solve(make(kappa, h), b, solver)
    with Fibers():
        a = make(kappa, h)
        with pytest.raises(ValueError) as found:
            prdp.linear_solve(a, b, solver)
        u, info = prdp.linear_solve(a, b, solver, on_failure="return")
    assert str(found.value) == str(expected.value)
    assert [prdp.SolveStatus(int(s)).name for s in info.status] == ["CONVERGED", "NONFINITE_OPERATOR", "CONVERGED"]
    assert not u[1].any()
    exact = prdp.linear_solve(make(kappa[::2], h[::2]), b[::2], solver)[0]
    torch.testing.assert_close(u[::2], exact, rtol=1e-8, atol=1e-10)


FAULTS = {  # a barrier that is left out: its header and function
    "numbers": ("team.h", "void reduce(", "__syncthreads()"),
    "NaN": ("block_space.h", "void product(", "meet()"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_kernel_with_a_wrong_first_result_is_not_used(fault, monkeypatch):
    """As of a fault of a compiler or a driver: threads take what is not there yet, which is other numbers, or NaN; then
    the kernel says OVERFLOW."""
    header, function, call = FAULTS[fault]
    shape = {"numbers": (9, 8), "NaN": (8, 9)}[fault]  # a kernel of its own
    a, b = operators.Heat(shape, 1e-2, 1.0), noise(2, 1, *shape)
    solver = prdp.CG(max_iter=11, rtol=1e-10)
    expected = prdp.linear_solve(a, b, solver)[0]
    text = (ROOT / "csrc/prdp/gpu/device" / header).read_text().splitlines()
    start = next(i for i, line in enumerate(text) if function in line)
    line = next(i for i in range(start, len(text)) if call in text[i]) + 1
    barrier = line if call == "__syncthreads()" else 10000 + line
    with Fibers(order=SHUFFLED, left_out=barrier, poison=fault == "NaN"):
        with pytest.raises(RuntimeError, match=r"PRDP_GPU=required: .* is not that of tensor operations"):
            prdp.linear_solve(a, b, solver, on_failure="return")
        monkeypatch.setenv("PRDP_GPU", "auto")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # said once
            u, info = prdp.linear_solve(a, b, solver)
    torch.testing.assert_close(u, expected, rtol=1e-9, atol=1e-12)
    assert info.way != "kernel"


def test_results_that_nobody_can_judge_are_looked_at_a_few_times():
    """Each look waits for the device. A zero b tells nothing of a kernel."""
    a, b = operators.Heat((5, 11), 1e-2, 1.0), torch.zeros(2, 1, 5, 11)
    looks = []
    with Fibers():
        for _ in range(5):
            with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as seen:
                prdp.linear_solve(a, b, prdp.CG(max_iter=7, rtol=1e-3), on_failure="return")
            looks.append(sum(event.name == "aten::nonzero" for event in seen.events()))
    assert looks == [1, 1, 1, 0, 0]


def test_a_sum_over_more_blocks_than_a_warp_has_threads():
    a, b = operators.Heat(SHAPE, 0.03, 1.0), noise(1, 1, *SHAPE)
    device = {"cells": 1}  # 42 blocks
    mine, other = (solve(a, b, prdp.CG(max_iter=60, rtol=1e-10), of) for of in (device, None))
    agree(mine, other, F64, slack=1e6)
    backward = solve(a, b, prdp.CG(max_iter=60, rtol=1e-10), {**device, "order": BACKWARD})
    assert torch.equal(backward[0], mine[0])
