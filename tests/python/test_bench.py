"""The benchmarks: what they call the truth, the products they count, and that all of it runs."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import dense_burgers, dense_navier_stokes

import prdp_torch as prdp
from benchmarks import measure, ours, problems, updates
from benchmarks.peers import stencils, torch_eager

ROOT = Path(__file__).parents[2]

SMALL = {
    "heat_1d": lambda: problems.heat((7,), 5, batch=2),
    "heat_3d": lambda: problems.heat((3, 4, 5), 5, batch=2),
    "burgers_1d": lambda: problems.burgers((9,), 4, batch=2),
    "navier_stokes": lambda: problems.navier_stokes((6, 4), 3, batch=2),
    "diffusion_6": lambda: problems.diffusion((6, 7), 5, batch=2, mean=0.1),
}
small = pytest.mark.parametrize("name", SMALL)


def dense(problem, sample):
    if problem.kappa is not None:
        return dense_diffusion(problem.kappa.double().numpy(), problem.dt)
    winds = None if problem.winds is None else problem.winds[sample].double().numpy()
    if problem.name.startswith("heat"):
        return prdp.operators.Heat(problem.shape, problem.nu, problem.dt).dense().numpy()
    return (dense_burgers if problem.name == "burgers_1d" else dense_navier_stokes)(winds, problem.nu, problem.dt)


def dense_diffusion(kappa, dt):
    """I - dt ∇·(κ ∇), periodic, neighbour by neighbour."""
    index = np.arange(kappa.size).reshape(kappa.shape)
    matrix = np.eye(kappa.size)
    for axis, n in enumerate(kappa.shape):
        for at, after in zip(np.ndindex(kappa.shape), np.roll(index, -1, axis).ravel(), strict=True):
            here, weight = index[at], dt * n**2 * (kappa[at] + kappa.ravel()[after]) / 2
            matrix[[here, after], [here, after]] += weight
            matrix[[here, after], [after, here]] -= weight
    return matrix


@small
def test_the_exact_answers_solve_the_dense_systems(name):
    problem = SMALL[name]()
    u, gradient = problem.exact
    for i in range(2):
        a = dense(problem, i)
        np.testing.assert_allclose(a @ u[i].flatten().numpy(), problem.b[i].flatten().double().numpy(), atol=1e-6)
        of_b = gradient[i] if problem.kappa is None else gradient[0][i]
        np.testing.assert_allclose(a.T @ of_b.flatten().numpy(), problem.g[i].flatten().numpy(), atol=1e-6)
    further = 1.01 * gradient if problem.kappa is None else (gradient[0], 1.01 * gradient[1])
    residual, error = problem.errors(u.float(), further)
    assert residual < 1e-5 and error == pytest.approx(0.01, rel=1e-6)


@small
def test_the_stencils_of_the_peers_are_the_operators(name):
    problem = SMALL[name]()
    stencil = stencils.make(problem, stencils.TorchBackend, torch.from_numpy)
    v = torch.randn_like(problem.b)
    for applied, matrix in ((stencil.apply(v), dense), (stencil.transpose(v), lambda *of: dense(*of).T)):
        for i in range(2):
            expected = matrix(problem, i) @ v[i].flatten().double().numpy()
            np.testing.assert_allclose(applied[i].flatten(), expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


@small
def test_torch_eager_runs_the_same_iteration(name):
    problem = SMALL[name]()
    entry = next(torch_eager.entries(problem))
    solver, _ = ours.methods(problem)[entry.same_as]
    forward, both = entry.prepare(problem.k)
    u, gradient = both()
    expected_u, expected_gradient = ours.calls(problem, solver(problem.k), "implicit")[1]()
    torch.testing.assert_close((u, gradient), (expected_u, expected_gradient), rtol=1e-3, atol=1e-3)
    assert torch.equal(forward(), u)


def test_the_gradient_for_a_field_is_that_of_differences():
    problem = SMALL["diffusion_6"]()
    of_kappa = problem.exact[1][1]
    kappa, direction, h = problem.kappa.double(), torch.randn(6, 7, dtype=torch.float64), 1e-6
    losses = []
    for sign in (1, -1):
        a = torch.from_numpy(dense_diffusion((kappa + sign * h * direction).numpy(), problem.dt))
        solved = torch.linalg.solve(a, problem.b.double().flatten(1).mT).mT
        losses.append((problem.g.double().flatten(1) * solved).sum())
    torch.testing.assert_close((of_kappa * direction).sum(), (losses[0] - losses[1]) / (2 * h), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", ["heat_1d", "burgers_1d"])
def test_jax_with_k_as_an_argument_runs_the_same_iterations_and_compiles_once(name):
    pytest.importorskip("jax")
    from benchmarks.change_of_k import first_calls
    from benchmarks.peers import jax_loops

    problem = SMALL[name]()
    constant = next(entry for entry in jax_loops.entries(problem) if entry.same_as)
    traced = jax_loops.entry_for_any(problem)
    for k in (3, 4):
        (u, gradient), (same_u, same_gradient) = (entry.prepare(k)[1]() for entry in (constant, traced))
        assert np.allclose(u, same_u, rtol=1e-5) and np.allclose(gradient, same_gradient, rtol=1e-5)
    first, *later = first_calls(problem, jax_loops.entry_for_any(problem))
    assert min(row["first_seconds"] for row in later) < first["first_seconds"] / 5


def test_readings_are_taken_in_turn():
    order = []
    seconds = measure.interleaved({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 3, 0.0)
    assert order == ["a", "a", "b", "b", *"ababab"]
    assert all(0 <= reading["min"] <= reading["median"] for reading in seconds.values())


@pytest.mark.alone  # what it measures is compared with what the processor can do
def test_all_suites_run_and_leave_a_page(tmp_path):
    suites = ("roofline", "training", "memory", "large")
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", *suites, "--quick", "--out", tmp_path],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "page.html").read_text()
    assert "limits of this machine" in page and page.count("<figure>") == 4
    found = json.loads((tmp_path / "roofline.json").read_text())
    assert found["machine"]["threads"] == 1
    for point in found["roofline"]["points"]:
        assert 0 < point["residual"] < 1 and 0 < point["gflops"] < found["roofline"]["limits"]["gflops"]
    peaks = {(p["case"], p["mode"]): p["bytes"] for p in json.loads((tmp_path / "memory.json").read_text())["memory"]}
    for case in ("heat_3d", "heat_3d_chebyshev", "navier_stokes"):
        assert 0 < 2 * peaks[case, "unrolled"] < peaks[case, "unrolled, recorded by autograd"]


def test_an_update_of_a_scene_is_timed_with_its_solves_and_without():
    for name in ("heat_1d", "kolmogorov"):  # an emulator, a corrector
        (record,) = updates.run(torch.device("cpu"), [name], rounds=1)
        assert record["scene"] == name and record["ratio"] == record["seconds"] / record["network"]
        assert record["seconds"] > 0 and record["network"] > 0 and 0 < record["residual"] < 1


def test_an_unknown_suite_is_refused():
    done = subprocess.run([sys.executable, "-m", "benchmarks", "speed"], cwd=ROOT, capture_output=True,
                          text=True)  # fmt: skip
    assert done.returncode == 2 and "unknown suite 'speed'; allowed: accuracy, " in done.stderr


def test_a_device_is_timed_beside_the_errors(tmp_path):
    command = [sys.executable, "-m", "benchmarks.devices", "--quick", "--out", tmp_path, "--device"]
    done = subprocess.run([*command, "cpu"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "devices.json").read_text())
    assert record["machine"]["device"] == "cpu" and record["versions"]["torch"] == torch.__version__
    rows = record["devices"]
    assert [json.loads(line) for line in done.stdout.splitlines()[1:]] == rows
    solves = [row for row in rows if "residual" in row]
    flows = [row for row in rows if row["problem"].startswith("Flow")]
    assert (tmp_path / "devices.png").stat().st_size > 10_000
    assert len(solves) > 10 and len(flows) >= 2 and len(solves) + len(flows) == len(rows)
    assert all(row["seconds"] > 0 for row in rows) and all(row["residual"] < 1 for row in solves)
    assert all(row["error"] < 1e-3 and row["gradient_error"] < 1e-3 for row in flows)
    wrong = subprocess.run([*command, "moon"], cwd=ROOT, capture_output=True, text=True)
    assert wrong.returncode == 2 and "device: unknown name 'moon'; allowed: cpu, cuda, cuda:N" in wrong.stderr


CORES_OF_TWO_THREADS = """
import os, torch
from benchmarks import measure
torch.set_num_threads(1)
def cores():  # none on a system that does not pin processes
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
allowed = cores()
one = {max(allowed)} if allowed else set()
measure.keep_to_one_core()
assert cores() == one
with measure.threads(2):
    assert cores() == allowed and torch.get_num_threads() == 2
assert cores() == one and torch.get_num_threads() == 1
"""


def test_two_threads_may_use_two_cores():
    subprocess.run([sys.executable, "-c", CORES_OF_TWO_THREADS], cwd=ROOT, check=True)
