"""The task "field": its physics and data against dense matrices, its gradient, its trainings in both languages."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import assert_refused, small_darcy, small_field

from prdp_torch import operators
from prdp_torch.experiments import _C, compare, field_task, scenes
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

ROOT = Path(__file__).parents[2]
DOUBLE = ('dtype = "float32"', 'dtype = "float64"')
EXACT = ("rtol = 1e-5", "rtol = 1e-13")


def dense_diffusion(kappa, dt):
    """I - Δt ∇·(κ ∇), flux by flux, in numpy."""
    row = np.arange(kappa.size).reshape(kappa.shape)
    a = np.eye(kappa.size)
    for point in np.ndindex(*kappa.shape):
        for axis, n in enumerate(kappa.shape):
            after = list(point)
            after[axis] = (after[axis] + 1) % n
            here, there = row[point], row[tuple(after)]
            flux = dt * n**2 * (kappa[point] + kappa[tuple(after)]) / 2
            a[here, here] += flux
            a[here, there] -= flux
            a[there, there] += flux
            a[there, here] -= flux
    return a


def random_kappa(*shape):
    return torch.rand(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.1


@pytest.mark.parametrize("shape", [(7,), (2,), (1,), (4, 5), (2, 3), (3, 4, 2)])
def test_the_stencil_is_the_sum_of_its_fluxes(shape):
    kappa = random_kappa(*shape)
    a = operators.Stencil(*_C.diffusion_stencil(kappa, 0.03), "periodic")
    np.testing.assert_allclose(
        a.dense().view(kappa.numel(), -1), dense_diffusion(kappa.numpy(), 0.03), rtol=1e-13, atol=1e-13
    )


def test_the_roughness_is_the_mean_square_of_the_gradient(tmp_path):
    theta = random_kappa(4, 6)
    t = theta.numpy()
    slopes = [n * (np.roll(t, -1, axis) - t) for axis, n in enumerate(t.shape)]
    periodic, box = scenes.load(small_field(tmp_path)).physics, scenes.load(small_darcy(tmp_path)).physics
    np.testing.assert_allclose(_C.roughness(theta, periodic), (slopes[0] ** 2 + slopes[1] ** 2).mean(), rtol=1e-14)
    inner = (slopes[0][:-1] ** 2).mean() + (slopes[1][:, :-1] ** 2).mean()
    np.testing.assert_allclose(_C.roughness(theta, box), inner, rtol=1e-14)
    along_x = (slopes[1][:1, :-1] ** 2).mean()  # an axis of one cell has no slope
    np.testing.assert_allclose(_C.roughness(theta[:1], box), along_x, rtol=1e-14)


def test_the_snapshots_are_states_of_the_field_with_noise(tmp_path):
    scene = scenes.load(small_field(tmp_path, DOUBLE, ("noise = 0.005", "noise = 0.0")))
    problem = _C.make_field_problem(scene, 0)
    kappa = problem.reference.numpy()
    assert kappa.shape == (10, 12) and problem.start.shape == (3, 1, 10, 12)
    assert np.abs(np.log(kappa / 0.02)).max() == pytest.approx(1.0)  # the contrast
    np.testing.assert_allclose(problem.theta.exp(), 0.02)
    step = np.linalg.inv(dense_diffusion(kappa, scene.physics.dt))
    states = [problem.start.flatten(1).numpy()]
    for _ in range(6):
        states.append(states[-1] @ step.T)
    expected = np.stack(states[2::2], 1).reshape(3, 3, 1, 10, 12)
    np.testing.assert_allclose(problem.snapshots, expected, atol=1e-7)

    noisy = scenes.load(small_field(tmp_path, DOUBLE, name="noisy"))
    draws = [_C.make_field_problem(noisy, seed) for seed in (0, 1)]
    noise = [(draw.snapshots - problem.snapshots).numpy() for draw in draws]
    assert all(torch.equal(draw.reference, problem.reference) for draw in draws)
    for one in noise:
        assert one.std() == pytest.approx(0.005 * np.sqrt((expected**2).mean()), rel=0.1)
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.2


def test_the_pressures_of_a_darcy_flow_solve_its_equation(tmp_path):
    scene = scenes.load(small_darcy(tmp_path, DOUBLE, ("noise = 0.005", "noise = 0.0")))
    problem = _C.make_field_problem(scene, 0)
    a = operators.Diffusion(problem.reference[None], length=scene.physics.length).dense()
    assert problem.start.shape == (3, 1, 10, 12) and problem.snapshots.shape == (3, 1, 1, 10, 12)
    expected = np.linalg.solve(a.numpy(), problem.start.flatten(1).numpy().T).T
    np.testing.assert_allclose(problem.snapshots.flatten(1), expected, rtol=1e-9, atol=1e-12)
    # The sources are series in the centres of the cells, where whole waves sum to nothing.
    np.testing.assert_allclose(problem.start.sum((-1, -2)), 0.0, atol=1e-12)


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("equation", ["diffusion", "darcy"])
def test_the_gradient_of_the_loss(tmp_path, backward, equation):
    """Against finite differences, through the assembly, the solves and what is observed, of nearly exact solves."""
    changes = [("shape = [10, 12]", "shape = [3, 4]"), ('"implicit"', f'"{backward}"')]
    if equation == "darcy":
        changes.append(('preconditioner = "multigrid"\nmax_iter = 20', "max_iter = 200"))
    make = {"diffusion": small_field, "darcy": small_darcy}[equation]
    scene = scenes.load(make(tmp_path, DOUBLE, EXACT, *changes))
    problem = _C.make_field_problem(scene, 0)
    stepper = scenes.make_stepper(scene)

    def loss(theta):
        return field_task.misfit(scene, stepper, problem, theta) + 1e-3 * _C.roughness(theta, scene.physics)

    theta = (problem.theta + random_kappa(3, 4)).requires_grad_()
    assert torch.autograd.gradcheck(loss, theta, eps=1e-5, atol=1e-8, rtol=1e-6)
    loss(theta).backward()
    assert stepper.converged
    solves = (3, 6) if equation == "diffusion" else (3,)
    assert backward == "unrolled" or stepper.adjoint_info.iterations.shape == solves


def in_cpp(tmp_path, path, *arguments):
    trainer = ROOT / "build" / "prdp_train"
    done = subprocess.run([trainer, path, "--out", tmp_path / "cpp", *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (record,) = (tmp_path / "cpp").glob("*/seed_0.json")
    return json.loads(record.read_text())["curves"]


@pytest.mark.parametrize(
    "arguments, refinement",
    [
        (["--auto"], lambda scene: Refinement.auto()),
        (["--constant", "4"], lambda scene: Refinement.constant(4)),
        (["--direct"], lambda scene: Refinement.exact()),
        (["--prdp"], Refinement.prdp),
    ],
    ids=["auto", "constant", "direct", "prdp"],
)
@pytest.mark.parametrize("make", [small_field, small_darcy])
def test_both_languages_train_alike(tmp_path, arguments, refinement, make):
    path = make(tmp_path)
    scene = scenes.load(path)
    cpp, python = in_cpp(tmp_path, path, *arguments), train(scene, refinement(scene))
    assert set(cpp) == set(python) and all(len(cpp[key]) == len(python[key]) for key in cpp if key != "warning")
    for name in ("update_loss", "metric", "error", "rtol"):
        np.testing.assert_allclose(cpp[name], python[name], rtol=1e-3, err_msg=name)
        np.testing.assert_allclose(cpp[name][:8], python[name][:8], rtol=2e-5, err_msg=name)
    assert cpp["budget"] == python["budget"] and cpp["max_iter"] == python["max_iter"]
    np.testing.assert_allclose(cpp["operator_applications"][:8], python["operator_applications"][:8], rtol=0.05)


def test_the_curves_count_every_step_and_the_tolerance_follows_the_misfit(tmp_path):
    scene = scenes.load(small_field(tmp_path))
    curves = train(scene, Refinement.constant(4))
    assert curves["budget"][0] == 4 * 6 and 4 * 6 <= curves["operator_applications"][0] <= 2 * 5 * 6
    assert len(curves["error"]) == len(curves["metric"]) == 31

    auto = train(scene, Refinement.auto())
    expected = np.maximum(1e-5, 0.1 * np.minimum.accumulate(auto["error"]))
    np.testing.assert_allclose(auto["rtol"], expected[:-1])
    assert auto["error"][0] == 1.0 and auto["error"][-1] < 0.2 * auto["error"][1]
    assert not np.allclose(auto["error"], auto["metric"], rtol=0.1)


def test_the_field_is_found_and_how_well_the_solves_must_go_for_it():
    """The scene of the project with fewer updates: a tolerance of 1e-3 is as good as 1e-5 for two thirds of the
    products, and K = 5 explains the snapshots by a wrong field."""
    scene = scenes.load("diffusion_inverse")
    scene.training.intervals = 60
    converged, looser, lost = (
        train(scene, refinement)
        for refinement in (
            Refinement.constant(scene.max_iter),
            Refinement.tolerance(1e-3, scene.max_iter),
            Refinement.constant(5),
        )
    )
    assert converged["metric"][-1] < 0.1 * converged["metric"][0] and set(looser["rtol"]) == {1e-3}
    assert looser["metric"][-1] < 1.05 * converged["metric"][-1]
    assert sum(looser["operator_applications"]) < 0.7 * sum(converged["operator_applications"])
    assert lost["metric"][-1] > 5 * converged["metric"][-1]


def test_seeds_draw_the_noise(tmp_path):
    scene = scenes.load(small_field(tmp_path))
    scene.training.intervals = 3
    once, again, other = (train(scene, Refinement.auto(), seed=seed)["update_loss"] for seed in (0, 0, 1))
    assert once == again != other


def test_a_comparison_has_rows_of_the_direct_solver_and_a_looser_tolerance(tmp_path):
    path = small_field(tmp_path, ("\nupdates = 30", "\nupdates = 4"))
    rows = compare.rows_of(scenes.load(path))
    labels = ["converged", "direct", "rtol_0.001", "auto", "prdp", "constant_10", "constant_15", "constant_20"]
    assert [row.label for row in rows] == labels
    command = [sys.executable, "-m", "prdp_torch", "compare", path, "--seeds", "2"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "rtol = 0.001" in done.stdout and "rtol = 0.001" in (tmp_path / "runs/small/report.html").read_text()
    summary = json.loads((tmp_path / "runs/small/summary.json").read_text())
    looser = next(row for row in summary["rows"] if row["kind"] == "tolerance")
    assert looser["saved"] is None and 0 < looser["products_saved"] < 1 and 3 < looser["last_k"] < 50
    assert (tmp_path / "runs/small/accuracy_against_cost.png").exists()


@pytest.mark.parametrize(
    "before, after, where, message",
    [
        ('"diffusion"', '"heat"', "equation =", "physics.equation: 'heat' is only for `emulator` and `parameters`"),
        ("dt = 0.05", "dt = 0.05\nnu = 1.0", "nu =", "physics.nu: not for `poisson`, `diffusion` and `darcy`"),
        ('"cg"', '"chebyshev"', "method", "solver.method: 'chebyshev' is only for `heat` and `poisson`"),
        ("[field]", "[fields]", "", "field: missing; the table holds:"),
        ("mean = 0.02", "mean = 0.0", "mean =", "field.mean: must be > 0, got 0"),
        ("contrast = 1.0", "contrast = -1.0", "contrast = -", "field.contrast: must be >= 0, got -1"),
        ("every = 2", "every = 7", "every", "field.every: must be <= steps, for there to be a snapshot"),
        ("states = 3", "states = 0", "states = 0", "field.states: must be >= 1, got 0"),
        ("noise = 0.005", "noise = -0.1", "noise", "field.noise: must be >= 0, got -0.1"),
        ("smoothing = 1e-5", "", "[field]", "field.smoothing: missing; the table holds: contrast, every"),
        ("\nupdates = 30", "\nepochs = 30", "[training]", "training.updates: missing; the table holds:"),
        ("\nupdates = 30", '\nupdates = 30\nloss = "nmse"', "loss =", "training.loss: only for `emulator`"),
        ("rtol = 1e-3", "rtol = 0.0", "rtol = 0.0", "compare.rtol: must be > 0, got 0"),
    ],
)  # fmt: skip
def test_mistakes_are_named_with_file_and_line(tmp_path, before, after, where, message):
    assert_refused(small_field(tmp_path, (before, after)), where, message)


def test_the_example_finds_the_field(tmp_path):
    script = ROOT / "examples/variable_diffusion.py"
    assert len(script.read_text().splitlines()) <= 40
    done = subprocess.run([sys.executable, script, "16", "20"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    misfit, error, tolerance = (float(word) for word in re.findall(r"[\d.]+(?:e-\d+)?", done.stdout))
    assert misfit < 0.05 and error < 0.15 and tolerance < 0.01


def test_a_scene_without_a_network_has_no_validation_samples(tmp_path):
    with pytest.raises(ValueError, match="validation_trajectories: the task trains no network"):
        _C.validation_trajectories(scenes.load(small_field(tmp_path)), 1)
