"""The task "corrector": its data and their cache, its two solves an update, its metric."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import assert_refused, tiny, written

import prdp_torch as prdp
from prdp_torch import fields
from prdp_torch.experiments import _C, charts, network_task, scenes
from prdp_torch.experiments.networks import make_network
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

ROOT = Path(__file__).parents[2]
PRDP = [sys.executable, "-m", "prdp_torch"]
TRAINER = ROOT / "build" / "prdp_train"


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache" / "data"
    monkeypatch.setenv("PRDP_CACHE", str(folder))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # of programs: on so small a grid threads wait for each other
    return folder


def tensors(data):
    return [data.train_start, data.train_between, data.train_end, data.valid_start, data.valid_end]


def no_solve(done, total):
    raise AssertionError("the data were made again")


def test_the_scene_holds_the_papers_settings():
    scene = scenes.load("navier_stokes")
    assert (scene.task, scene.unit, scene.executions) == ("corrector", "epoch", 2)
    assert (scene.physics.shape, scene.physics.nu, scene.physics.dt) == ([48, 48], 1e-4, 0.1)
    assert (scene.physics.channels, scene.physics.periodic, scene.data.reference_shape) == (3, True, [97, 97])
    assert (scene.method, scene.restart, scene.max_iter, scene.data.valid_max_iter) == ("gmres", 8, 44, 120)
    assert (scene.network.kind, scene.network.blocks, scene.network.width) == ("resnet", 3, 64)
    assert (scene.data.train, scene.data.valid, scene.data.valid_steps) == (200, 5, 5)
    assert (scene.training.loss, scene.training.batch, scene.training.intervals) == ("mse", 25, 100)
    assert (scene.prdp["tau_step"], scene.prdp["tau_stop"], scene.prdp["delta"]) == (0.98, 0.9, 3)
    assert (scene.prdp["window"], scene.prdp["initial"], scene.prdp["increment"]) == (6, 1, 1)
    assert scene.learning_rate(800) == pytest.approx(1e-4)


@pytest.mark.parametrize(
    "before, after, where, message",
    [
        ('"navier_stokes"', '"burgers"', "equation =", "'burgers' is only for `emulator` and `parameters`"),
        ("shape = [48, 48]", "shape = [48]", "shape = [48]", "physics.shape: expected 2 extents"),
        ("[97, 97]", "[97, 96]", "reference_shape", "data.reference_shape: expected 2 N + 1 for each N of"),
        ("valid_max_iter = 120", "valid_max_iter = 0", "valid_max_iter", "data.valid_max_iter: must be >= 1, got 0"),
        ("seed = 0", "seed = 0\nmodes = 5", "modes", "data.modes: only for `emulator`, not with `file`"),
        ("cosine_updates = 800", "cosine_updates = 0", "cosine_up", "training.cosine_updates: must be >= 1, got 0"),
        ("cosine_updates = 800", "cosine_updates = 8\ndecay = 0.9", "decay = ", "training.decay: not for `parameters`"),
        ("cosine_updates = 800", "", "[training]", "training.decay, training.decay_steps: missing; the table holds:"),
        ('"implicit"', '"jfb"', "backward", "unknown name 'jfb'; allowed: implicit, unrolled, none"),
        ('"corrector"', '"fixer"', "task =", "task: unknown name 'fixer'; allowed: emulator, corrector, parameters"),
    ],
)  # fmt: skip
def test_mistakes_are_named_with_file_and_line(tmp_path, before, after, where, message):
    assert_refused(written(tmp_path, (before, after), scene="navier_stokes"), where, message)


def test_data_are_made_once_and_read_from_then_on(tmp_path, cache):
    scene = scenes.load(tiny(tmp_path))
    reports = []
    once = _C.make_dataset(scene, lambda *report: reports.append(report))
    assert reports == [(8, 26), (16, 26), (18, 26), (20, 26), (22, 26), (24, 26), (26, 26)]
    (file,) = cache.iterdir()
    before = file.stat().st_mtime_ns
    again = _C.make_dataset(scenes.load(tiny(tmp_path, ("seeds = 1", "seeds = 2"))), no_solve)
    assert file.stat().st_mtime_ns == before
    assert all(torch.equal(a, b) for a, b in zip(tensors(once), tensors(again), strict=True))
    assert once.train_between.shape == (8, 1, 3, 8, 8) and once.valid_end.shape == (2, 3, 8, 8)
    assert once.train_start.dtype == torch.float32


@pytest.mark.parametrize("change", ["seed = 0 1", "nu = 1e-4 2e-4", "valid_steps = 5 4", 'dtype = "float32" "float64"'])
def test_other_settings_have_a_file_of_their_own(tmp_path, cache, change):
    before, value = change.rsplit(" ", 1)
    other = tiny(tmp_path, (before, f"{before.split(' = ')[0]} = {value}"), name="other")
    first, second = (_C.make_dataset(scenes.load(path)) for path in (tiny(tmp_path), other))
    assert len(list(cache.iterdir())) == 2
    pairs = zip(tensors(first), tensors(second), strict=True)
    assert any(a.dtype != b.dtype or not torch.equal(a, b) for a, b in pairs)


def test_a_damaged_or_foreign_file_is_refused_with_the_remedy(tmp_path, cache):
    scene, other = scenes.load(tiny(tmp_path)), scenes.load(tiny(tmp_path, ("seed = 0", "seed = 1"), name="other"))
    _C.make_dataset(scene)
    (file,) = cache.iterdir()
    whole = file.read_bytes()
    for damaged in (whole[: len(whole) // 2], b"", b"nothing of the kind"):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=f"data: '{file}' is damaged or of another version: .*; delete it"):
            _C.make_dataset(scene, no_solve)
    file.unlink()
    _C.make_dataset(other)
    (foreign,) = cache.iterdir()
    foreign.rename(file)
    with pytest.raises(ValueError, match=f"data: '{file}' .* it holds '.*seed 1, .*', not '.*seed 0, .*'; delete it"):
        _C.make_dataset(scene, no_solve)


def test_an_interrupted_making_leaves_nothing(tmp_path, cache):
    def interrupt(done, total):
        if done > 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        _C.make_dataset(scenes.load(tiny(tmp_path)), interrupt)
    assert list(cache.iterdir()) == []


def test_a_cache_that_cannot_be_written_is_said_before_any_work(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("PRDP_CACHE", str(tmp_path / "file" / "below"))
    with pytest.raises(ValueError, match=r"data: cannot write to '.*below'; set PRDP_CACHE to a folder"):
        _C.make_dataset(scenes.load(tiny(tmp_path)), no_solve)


@pytest.mark.parametrize("arguments, refine", [(["--prdp"], Refinement.prdp), (["--constant", "3"], None)])
@pytest.mark.parametrize("backward", ["implicit", "none"])
def test_both_languages_train_alike(tmp_path, arguments, refine, backward):
    path = tiny(tmp_path)
    command = [TRAINER, path, "--out", tmp_path / "cpp", "--backward", backward, *arguments]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert "data: 26 of 26 reference steps" in done.stderr
    cpp = json.loads(next((tmp_path / "cpp").glob("*/seed_0.json")).read_text())["curves"]
    scene = scenes.load(path)
    scene.backward = backward
    python = train(scene, refine(scene) if refine else Refinement.constant(3))
    assert len(python["update_loss"]) == 20 and python["update_loss"][-1] < python["update_loss"][0]
    np.testing.assert_allclose(cpp["update_loss"], python["update_loss"], rtol=1e-5)
    np.testing.assert_allclose(cpp["metric"], python["metric"], rtol=1e-5)
    assert cpp["max_iter"] == python["max_iter"] and cpp["budget"] == python["budget"]
    np.testing.assert_allclose(cpp["operator_applications"], python["operator_applications"], rtol=1e-2)


def test_both_solves_of_an_update_are_counted(tmp_path):
    path = tiny(tmp_path, ("rtol = 1e-5", "rtol = 0.0"))
    scene = scenes.load(path)
    curves = train(scene, Refinement.constant(2))
    assert curves["budget"] == [2 * 4 * 2] * 5 == curves["iterations"]
    scene.backward = "none"
    without = train(scene, Refinement.constant(2))
    assert without["iterations"] == curves["iterations"]
    # An adjoint costs what its primal does; the first solve starts from data and needs none.
    assert curves["operator_applications"] == [1.5 * products for products in without["operator_applications"]]


def objective(scene, network, solver):
    physics = scene.physics
    steppers = [
        prdp.NavierStokes(physics.shape, physics.nu, physics.dt, solver, scene.backward, on_failure="return")
        for _ in range(2)
    ]
    data = _C.make_dataset(scene)
    return data, steppers, network_task._corrector(scene, steppers, network_task._TrainingSamples(scene, data), network)


def test_the_loss_is_that_of_both_times_and_its_gradient_passes_the_second_solve(tmp_path):
    """Against finite differences of the loss as written out here."""
    scene = scenes.load(tiny(tmp_path, ('"float32"', '"float64"')))
    network = make_network(scene, 0)
    data, steppers, loss_of = objective(scene, network, prdp.GMRES(restart=8, max_iter=500, rtol=1e-12))
    batch = torch.tensor([3, 1, 6])
    exact = prdp.NavierStokes([8, 8], 1e-4, 0.1, prdp.Direct())

    def written_out():
        with torch.no_grad():
            u1 = exact(data.train_start[batch])
            u1 = u1 + network(u1)
            u2 = exact(u1)
            u2 = u2 + network(u2)
            return float(
                (u1 - data.train_between[batch, 0]).square().mean() + (u2 - data.train_end[batch]).square().mean()
            )

    loss = loss_of(batch)
    assert float(loss.detach()) == pytest.approx(written_out(), rel=1e-9)
    loss.backward()
    # Not INCONSISTENT, as the network's pressure would have it.
    first, second = steppers
    assert first.adjoint_info is None and bool((second.adjoint_info.status > 0).all())
    assert first.converged and second.converged
    weight = network.lift.weight
    direction = torch.randn(weight.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    step = 1e-7  # short, for the winds and the ReLUs have kinks
    with torch.no_grad():
        weight.add_(direction, alpha=step)
        above = written_out()
        weight.sub_(direction, alpha=2 * step)
        below = written_out()
    assert float((weight.grad * direction).sum()) == pytest.approx((above - below) / (2 * step), rel=1e-5)


def test_the_metric_is_the_x_velocity_after_converged_steps(tmp_path):
    scene = scenes.load(tiny(tmp_path, ('"float32"', '"float64"')))
    data = _C.make_dataset(scene)
    metric = network_task._metric(scene, data, torch.zeros_like)
    exact = prdp.NavierStokes([8, 8], 1e-4, 0.1, prdp.Direct())
    u = fields.rollout(exact, data.valid_start, 5)[:, -1, 0]
    error = (u - data.valid_end[:, 0]).flatten(1).norm(dim=1) / data.valid_end[:, 0].flatten(1).norm(dim=1)
    assert float(metric()) == pytest.approx(float(error.square().mean()), rel=1e-4)
    assert charts._metric_name(scene).startswith("x-velocity error at t = 5")


def test_compare_leaves_the_exact_solver_out(tmp_path):
    command = [*PRDP, "compare", tiny(tmp_path), "--intervals", "2", "--backward", "none"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "runs/tiny/summary.json").read_text())
    assert [row["label"] for row in summary["rows"]] == ["converged", "auto", "prdp", "constant_2"]
    budgets = [row["budget"] for row in summary["rows"] if row["label"] != "auto"]  # to auto, K is a cap
    assert budgets == [44 * 4 * 2 * 2, 1 * 4 * 2 * 2, 2 * 4 * 2 * 2]
    assert (tmp_path / "runs/tiny/report.html").exists()


def test_a_derivative_that_there_is_not_is_refused(tmp_path):
    with pytest.raises(ValueError, match="expected implicit or unrolled or none for this scene, got 'x'"):
        scenes.load("navier_stokes").backward = "x"
