"""Scene files: what they say is read, and what is wrong in them is said with file and line."""

import re

import pytest
import torch
from helpers import assert_refused, written

from prdp_torch import BiCGStab
from prdp_torch.experiments import _C, charts, scenes


def test_the_projects_scenes_hold_the_papers_settings():
    heat = scenes.load("heat_1d")
    assert (heat.method, heat.max_iter, heat.rtol, heat.backward) == ("jacobi", 25, 1e-5, "implicit")
    assert (heat.physics.shape, heat.physics.nu, heat.physics.dt) == ([30], 1e-3, 1.0)
    assert (heat.data.train, heat.data.valid, heat.training.batch, heat.training.intervals) == (200, 5, 25, 100)
    assert (heat.data.valid_steps, heat.physics.channels, heat.physics.periodic) == (2, 1, False)
    assert heat.prdp == {
        "tau_step": 0.98, "tau_stop": 0.9, "delta": 3, "window": 8, "initial": 1, "increment": 1,
        "maximum": None, "growth": 1.0, "adjoint_ratio": None,
    }  # fmt: skip
    square, cube = scenes.load("heat_2d"), scenes.load("heat_3d")
    assert (square.method, square.max_iter, square.backward) == ("jacobi", 43, "unrolled")
    assert (cube.method, cube.max_iter, cube.backward) == ("jacobi", 31, "unrolled")
    assert (square.physics.shape, cube.physics.shape) == ([30, 30], [20, 20, 20])
    assert (square.network.hidden, cube.network.blocks, cube.network.width) == ([3000, 3000, 3000], 6, 32)
    assert (square.learning_rate(100), cube.learning_rate(100)) == (pytest.approx(9e-4), pytest.approx(0.92e-4))
    assert (square.training.intervals, cube.training.intervals) == (70, 100)
    for scene, tau_step in ((square, 0.9), (cube, 0.97)):
        assert (scene.physics.nu, scene.physics.dt, scene.rtol, scene.training.batch) == (1e-3, 1.0, 1e-5, 25)
        assert (scene.data.modes, scene.data.train, scene.data.valid, scene.data.valid_steps) == (5, 200, 5, 2)
        assert scene.prdp == heat.prdp | {"tau_step": tau_step, "window": 6}
    one, three = scenes.load("poisson_1p"), scenes.load("poisson_3p")
    assert (one.max_iter, one.training.intervals, one.learning_rate(100)) == (600, 170, 275.0)
    assert (three.max_iter, three.training.intervals, three.learning_rate(0)) == (450, 750, 3500.0)
    assert (one.prdp["tau_step"], one.prdp["tau_stop"], one.prdp["initial"], one.prdp["increment"]) == (
        0.92,
        0.98,
        25,
        10,
    )
    steepest = scenes.load("poisson_3p_sd")
    assert (steepest.method, steepest.max_iter, steepest.training.intervals) == ("steepest_descent", 240, 800)
    burgers = scenes.load("burgers_1d")
    assert (burgers.method, burgers.restart, burgers.max_iter, burgers.backward) == ("gmres", 2, 23, "implicit")
    assert (burgers.physics.shape, burgers.physics.nu, burgers.physics.dt) == ([256], 1e-3, 0.01)
    assert (burgers.physics.channels, burgers.physics.periodic) == (1, True)
    assert (burgers.network.kind, burgers.network.blocks, burgers.network.width) == ("resnet", 6, 32)
    assert (burgers.data.modes, burgers.data.valid_steps, burgers.learning_rate(100)) == (20, 5, pytest.approx(7e-4))
    assert (burgers.prdp["tau_step"], burgers.prdp["window"], burgers.prdp["initial"]) == (0.9, 15, 4)


@pytest.mark.parametrize(
    "before, after, where, message",
    [
        ("rtol = 1e-5", "tol = 1e-5", "[solver]", "solver.rtol: missing; the table holds: backward, max_iter"),
        ("rtol = 1e-5", "rtol = 1e-5\nm = 3", "m = 3", "unknown name 'solver.m'; allowed: backward, max_iter, meth"),
        ('method = "jacobi"', 'method = "x"', "method", "solver.method: unknown name 'x'; allowed: jacobi, cheby"),
        ("nu = 1e-3", "nu = -1.0", "nu =", "physics.nu: must be >= 0, got -1"),
        ("dt = 1.0", "dt = 0", "dt =", "physics.dt: must be > 0, got 0"),
        ("max_iter = 25", "max_iter = 0", "max_iter", "solver.max_iter: must be >= 1, got 0"),
        ("max_iter = 25", "max_iter = 9999999999", "max_iter", "solver.max_iter: must be <= 1000000000, got"),
        ("max_iter = 25", "max_iter = true", "max_iter", "solver.max_iter: expected a whole number, got true"),
        ("rtol = 1e-5", "rtol = false", "rtol", "solver.rtol: expected a number"),
        ("shape = [30]", "shape = [true]", "shape", "physics.shape: expected a list of whole numbers"),
        ("max_iter = 25", "max_iter = 2.5", "max_iter", "solver.max_iter: expected a whole number, got 2.5"),
        ("shape = [30]", "shape = 30", "shape", "physics.shape: expected a list of whole numbers"),
        ("shape = [30]", "shape = [3, 3, 3, 3]", "shape", "physics.shape: expected 1 to 3 extents"),
        ("learning_rate = 1e-3", "learning_rate = nan", "learning_rate", "training.learning_rate: must be finite"),
        ('loss = "nmse"', 'loss = "l1"', "loss =", "training.loss: unknown name 'l1'; allowed: nmse, mse"),
        ("delta = 3", "delta = 1", "delta", "prdp.delta: must be >= 2, got 1"),
        ("delta = 3", "delta = 3\nadjoint_ratio = 1.5", "adjoint_ratio", "prdp.adjoint_ratio: must be <= 1, got 1.5"),
        ('dtype = "float32"', 'dtype = "half"', "dtype", "dtype: unknown name 'half'; allowed: float32, float64"),
        ('"implicit"', '"none"', "backward", "solver.backward: 'none' is only for `corrector`"),
        ("valid_steps = 2", "valid_steps = 0", "valid_steps", "data.valid_steps: must be >= 1, got 0"),
        ("valid_steps = 2", "", "[data]", "data.valid_steps: missing; the table holds: modes, seed, train, valid"),
        ('"heat"', '"wave"', "equation =", "physics.equation: unknown name 'wave'; allowed: poisson, heat, burgers"),
        ('kind = "mlp"', 'kind = "cnn"', "kind", "network.kind: unknown name 'cnn'; allowed: mlp, resnet, unet"),
        ("hidden", "blocks = 6\nhidden", "blocks", "network.blocks: only for `resnet`"),
        ("hidden", "zero_output = 1\nhidden", "zero_output", "network.zero_output: expected true or false"),
        ("rtol = 1e-5", "rtol = 1e-5\nrestart = 2", "restart", "solver.restart: only for `gmres`"),
        ("[network]", "[networks]", "", "network: missing; the table holds:"),
        ("[physics]", "[physics", "[physics", "Error while parsing"),
    ],
)  # fmt: skip
def test_mistakes_are_named_with_file_and_line(tmp_path, before, after, where, message):
    assert_refused(written(tmp_path, (before, after)), where, message)


def test_missing_keys_of_a_table_are_named_at_once(tmp_path):
    scene = written(tmp_path, ("nu = 1e-3", ""), ("shape = [30]", ""), ("dt = 1.0", "dt = -1.0"))
    assert_refused(scene, "[physics]", "physics.shape, physics.nu: missing; the table holds: dt, equation")
    scene = written(tmp_path, ("train = 200", ""), ("valid_steps = 2", ""), name="optional")
    assert_refused(scene, "[data]", "data.train, data.valid_steps: missing; the table holds: modes, seed, valid")
    scene = written(tmp_path, ("width = 32", ""), ("levels = 3", "levels = 100"), scene="kolmogorov_unet", name="unet")
    assert_refused(scene, "[network]", "network.width: missing; the table holds: kind, levels, zero_output")


def test_bicgstab_is_a_method_of_scenes_without_a_restart(tmp_path):
    solver = ('method = "gmres"\nrestart = 2             # Arnoldi steps in a cycle; a cycle is one iteration\n',
              'method = "bicgstab"\n')  # fmt: skip
    scene = scenes.load(written(tmp_path, solver, scene="burgers_1d"))
    assert (scene.method, scene.max_iter) == ("bicgstab", 23)
    assert isinstance(scenes.make_solver(scene, 5), BiCGStab)
    with_restart = written(tmp_path, (solver[0], solver[1] + "restart = 2\n"), scene="burgers_1d", name="restart")
    assert_refused(with_restart, "restart = 2", "solver.restart: only for `gmres`")


def test_chebyshev_is_for_scenes_of_known_spectrum(tmp_path):
    assert scenes.load(written(tmp_path, ('"jacobi"', '"chebyshev"'))).method == "chebyshev"
    refused = written(tmp_path, ('method = "gmres"', 'method = "chebyshev"'), scene="burgers_1d")
    assert_refused(refused, "method", "solver.method: 'chebyshev' is only for `heat` and `poisson`")


@pytest.mark.parametrize(
    "before, after, where, message",
    [
        ("restart = 2", "", "[solver]", "solver.restart: missing; the table holds: backward, max_iter, method, rtol"),
        ("restart = 2", "restart = 0", "restart =", "solver.restart: must be >= 1, got 0"),
        ("restart = 2", "restart = 1.5", "restart =", "solver.restart: expected a whole number"),
        ("blocks = 6", "blocks = 0", "blocks", "network.blocks: must be >= 1, got 0"),
        ("width = 32", "width = 0", "width", "network.width: must be >= 1, got 0"),
        ("width = 32", "", "[network]", "network.width: missing; the table holds: blocks, kind"),
        ("width = 32", "width = 32\nhidden = [3]", "hidden", "network.hidden: only for `mlp`"),
        ("nu = 1e-3", "", "[physics]", "physics.nu: missing; the table holds: dt, equation, shape"),
    ],
)  # fmt: skip
def test_mistakes_of_gmres_and_the_resnet_are_named_too(tmp_path, before, after, where, message):
    assert_refused(written(tmp_path, (before, after), scene="burgers_1d"), where, message)


@pytest.mark.parametrize(
    "before, after, where, message",
    [
        ("levels = 3", "", "[network]", "network.levels: missing; the table holds: kind, width, zero_output"),
        ("levels = 3", "levels = 11", "levels", "network.levels: expected at most 10 levels"),
        ("levels = 3", "levels = 8", "levels", "network.levels: expected 2^levels to divide each N of physics.shape"),
        ("width = 32", "width = 200000", "width", "network.width: expected at most 1000000 channels in a block"),
        ("levels = 3", "levels = 3\nblocks = 2", "blocks = 2", "network.blocks: only for `resnet`"),
        ('"unet"', '"resnet"\nblocks = 2', "levels", "network.levels: only for `unet`"),
    ],
)  # fmt: skip
def test_mistakes_of_the_unet_are_named_too(tmp_path, before, after, where, message):
    assert_refused(written(tmp_path, (before, after), scene="kolmogorov_unet"), where, message)


@pytest.mark.parametrize(
    "before, after, message",
    [
        ("rtol = 1e-5", "rtol = 1.5", "[solver]: Jacobi: rtol must be < 1, got 1.5; u = 0 would meet it"),
        ("[compare]\n", "[compare]\nrtol = 2.0\n", "compare.rtol: must be < 1, got 2"),
    ],
)
def test_what_the_solver_refuses_is_named_with_the_file(tmp_path, before, after, message):
    path = written(tmp_path, (before, after))
    with pytest.raises(ValueError, match=re.escape(f"{path}: {message}")):
        scenes.load(path)


@pytest.mark.parametrize(
    "scene, change, message",
    [
        ("burgers_1d", ("shape = [256]", "shape = [1]"), "Burgers: every extent of shape must be >= 2, got [1]"),
        ("kolmogorov", ("[solver]", '[solver]\nstart = "state"'), "Flow: start must be 'zero'"),
    ],
)
def test_what_the_step_refuses_is_named_with_the_file_before_any_work(tmp_path, scene, change, message):
    path = written(tmp_path, change, scene=scene)
    with pytest.raises(ValueError, match=re.escape(f"{path}: {message}")):
        scenes.load(path)


def test_missing_files_and_unknown_scenes():
    with pytest.raises(ValueError, match=r"scene: cannot read 'nowhere.toml'"):
        scenes.load("nowhere.toml")
    with pytest.raises(
        ValueError,
        match="no scene 'heat1d'; available: burgers_1d, burgers_2d, darcy_emulator, darcy_inverse, diffusion_inverse, "
        "heat_1d, heat_2d, heat_3d",
    ):
        scenes.load("heat1d")


def test_data_is_the_same_at_every_call_and_in_every_precision(tmp_path):
    scene = scenes.load("heat_1d")
    once, again = _C.make_dataset(scene), _C.make_dataset(scene)
    assert torch.equal(once.train_start, again.train_start) and torch.equal(once.valid_end, again.valid_end)
    double = _C.make_dataset(_C.read_scene(written(tmp_path, ('"float32"', '"float64"'))))
    assert torch.equal(double.train_start.float(), once.train_start)
    other = _C.make_dataset(_C.read_scene(written(tmp_path, ("seed = 0", "seed = 1"))))
    assert not torch.equal(other.train_start, once.train_start)


def test_validation_follows_as_many_steps_as_the_scene_says(tmp_path):
    two, five = (
        _C.read_scene(written(tmp_path, ("valid_steps = 2", f"valid_steps = {n}"), ('"float32"', '"float64"')))
        for n in (2, 5)
    )
    data, longer = _C.make_dataset(two), _C.make_dataset(five)
    exact = scenes.make_stepper(two, direct=True)
    expected = data.valid_end
    for _ in range(3):
        expected = exact(expected)
    torch.testing.assert_close(longer.valid_end, expected, rtol=1e-12, atol=1e-12)
    assert torch.equal(data.train_end, longer.train_end) and torch.equal(data.valid_start, longer.valid_start)
    assert "after 2 steps" in charts._metric_name(two) and "after 5 steps" in charts._metric_name(five)


def test_the_making_of_data_is_reported(tmp_path):
    reports = []
    scene = _C.read_scene(written(tmp_path))
    _C.make_dataset(scene, lambda *report: reports.append(report))
    assert reports == [(100, 410), (200, 410), (300, 410), (400, 410), (405, 410), (410, 410)]
