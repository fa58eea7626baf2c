"""The key `length` of a scene: the sides of the domain, for steps, data, files and both trainers."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import assert_refused, dense_heat, small_field, tiny, written

from prdp_torch import fields, operators
from prdp_torch.experiments import _C, array_files, datasets, scenes
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

TRAINER = Path(__file__).parents[2] / "build" / "prdp_train"
LENGTH = ("shape = [30]", "shape = [30]\nlength = 2.5")


def test_a_step_has_the_sides_of_its_scene(tmp_path):
    scene = scenes.load(written(tmp_path, LENGTH, ('"float32"', '"float64"'), ("max_iter = 25", "max_iter = 2000")))
    assert scene.physics.length == [2.5] and scenes.load("heat_2d").physics.length == [1.0, 1.0]
    u = torch.randn(3, 1, 30, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    truth = np.linalg.solve(dense_heat((30,), nu=1e-3 / 2.5**2), u[:, 0].numpy().T).T
    step = scenes.make_stepper(scene)
    step.rtol = 1e-13
    np.testing.assert_allclose(step(u)[:, 0].numpy(), truth, rtol=1e-10)


@pytest.mark.parametrize(
    "line, message",
    [
        ("length = 0", "physics.length: must be > 0, got 0 and be finite"),
        ("length = -1.0", "physics.length: must be > 0, got -1"),
        ("length = inf", "physics.length: must be > 0, got inf"),
        ("length = [1.0, 2.0]", "physics.length: expected one number, or one per axis"),
        ('length = "1"', "physics.length: expected a number, or a list of numbers"),
        ("length = true", "physics.length: expected a number, or a list of numbers"),
    ],
)
def test_a_length_that_is_none_is_refused_with_its_line(tmp_path, line, message):
    assert_refused(written(tmp_path, ("shape = [30]", f"shape = [30]\n{line}")), "length", message)


def test_equal_problems_in_other_units_train_alike(tmp_path):
    """nu/length² is the same: so are the matrices, the data and the curves."""
    unit = scenes.load(written(tmp_path, ("epochs = 100", "epochs = 3"), name="unit"))
    large = scenes.load(written(tmp_path, ("epochs = 100", "epochs = 3"), ("nu = 1e-3", "nu = 4e-3"),
                                ("shape = [30]", "shape = [30]\nlength = [2.0]"), name="large"))  # fmt: skip
    curves = [train(scene, Refinement.prdp(scene))["metric"] for scene in (unit, large)]
    np.testing.assert_allclose(*curves, rtol=1e-5)
    longer = scenes.load(written(tmp_path, ("epochs = 100", "epochs = 3"), LENGTH, name="longer"))
    assert abs(train(longer, Refinement.prdp(longer))["metric"][-1] / curves[0][-1] - 1) > 1e-3


@pytest.mark.parametrize(
    "make, shape, length",
    [(written, "[30]", [2.5]), (tiny, "[8, 8]", [1.5, 0.75]), (small_field, "[10, 12]", [1.5, 0.75])],
    ids=["emulator", "corrector", "field"],
)
def test_both_trainers_agree(tmp_path, monkeypatch, make, shape, length):
    monkeypatch.setenv("PRDP_CACHE", str(tmp_path / "cache"))
    path = Path(make(tmp_path))
    path.write_text(path.read_text().replace(f"\nshape = {shape}", f"\nshape = {shape}\nlength = {length}"))
    scene = scenes.load(path)
    scene.training.intervals = 3
    assert scene.physics.length == length
    python = train(scene, Refinement.prdp(scene))
    command = [TRAINER, path, "--out", tmp_path / "cpp", "--intervals", "3", "--prdp"]
    assert subprocess.run(command, capture_output=True).returncode == 0
    cpp = json.loads((tmp_path / "cpp/prdp/seed_0.json").read_text())["curves"]
    np.testing.assert_allclose(cpp["metric"], python["metric"], rtol=1e-4)


def test_the_flows_of_a_corrector_have_no_divergence_on_their_domain(tmp_path):
    scene = Path(tiny(tmp_path))
    scene.write_text(scene.read_text().replace("shape = [8, 8]", "shape = [8, 8]\nlength = [2.0, 0.5]", 1))
    states = _C.validation_trajectories(scenes.load(scene), 0)[:, 0].double()
    assert states.shape[1:] == (3, 8, 8)
    fine = torch.randn(2, 3, 9, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    sides = (2.0, 0.5)
    projected = fields.project(fine, sides)
    scale = fields.divergence(fine, sides).abs().max()
    assert fields.divergence(projected, sides).abs().max() < 1e-13 * scale
    np.testing.assert_allclose(fields.project(projected, sides), projected, rtol=0, atol=1e-12)


def test_the_diffusion_of_a_field_has_the_sides_of_its_domain(tmp_path):
    kappa = torch.rand(4, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) + 0.5
    sides = (2.0, 0.5)
    a = operators.Stencil(*_C.diffusion_stencil(kappa, 0.03, sides), "periodic").dense()
    truth = torch.eye(24, dtype=torch.float64)
    cell = torch.arange(24).reshape(4, 6)
    for axis, side in enumerate(sides):
        per_length = kappa.shape[axis] / side
        for here, there, k in zip(cell.flatten(), cell.roll(-1, axis).flatten(),
                                  ((kappa + kappa.roll(-1, axis)) / 2).flatten(), strict=True):  # fmt: skip
            for one, other in ((here, there), (there, here)):
                truth[one, one] += 0.03 * k * per_length**2
                truth[one, other] -= 0.03 * k * per_length**2
    torch.testing.assert_close(a, truth, rtol=1e-13, atol=1e-13)
    slopes = [(kappa.roll(-1, d) - kappa) * kappa.shape[d] / sides[d] for d in (0, 1)]
    changes = ("shape = [10, 12]", "shape = [4, 6]\nlength = [2.0, 0.5]")
    physics = scenes.load(small_field(tmp_path, changes)).physics
    assert float(_C.roughness(kappa, physics)) == pytest.approx(
        float((slopes[0] ** 2 + slopes[1] ** 2).mean()), rel=1e-14
    )


@pytest.mark.parametrize("name", ["x.h5", "x.npz"])
def test_files_have_the_points_of_the_domain(tmp_path, name):
    scene = scenes.load(written(tmp_path, LENGTH, ("train = 200", "train = 5")))
    datasets.export(scene, tmp_path / name)
    with array_files.opened(tmp_path / name) as file:
        np.testing.assert_allclose(file.array("x-coordinate").read(), 2.5 * np.arange(1, 31) / 31, rtol=1e-15)
    from_file = (("modes = 5 ", f'file = "{name}" # '), ("seed = 0\n", ""), ("train = 200", "train = 5"))
    read = scenes.load(written(tmp_path, LENGTH, *from_file, name="read"))
    assert torch.equal(datasets.of_scene(read).train_end, _C.make_dataset(scene).train_end)
    other = scenes.load(written(tmp_path, *from_file, name="other"))
    with pytest.raises(ValueError, match=r"the spacing of x-coordinate is 0\.0806452, but dx of the grid of 30"):
        datasets.of_scene(other)
