"""The scene kolmogorov: its data against flows made here, its loss, its trainings in both languages."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import assert_refused, written
from stand_in_device import DEVICE, StandIn
from test_corrector import cache  # noqa: F401, a fixture of every test here
from test_trajectories import random_flow

import prdp_torch as prdp
from prdp_torch import fields
from prdp_torch.experiments import _C, network_task, scenes, trajectories
from prdp_torch.experiments.networks import make_network
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

TRAINER = Path(__file__).parents[2] / "build" / "prdp_train"
SMALL = (
    ("shape = [64, 64]", "shape = [8, 12]"),
    ("reference_shape = [256, 256]", "reference_shape = [24, 36]"),
    ("spin_up = 30", "spin_up = 3"),
    ("train = 24", "train = 8"),
    ("valid = 4", "valid = 2"),
    ("valid_steps = 20", "valid_steps = 4"),
    ("batch = 8", "batch = 4"),
    ("epochs = 50", "epochs = 3"),
    ("rtol = 1e-5", "rtol = 1e-4"),  # on so small a grid float32 reaches no more
)
UNET = (  # of the scene kolmogorov_unet
    ("shape = [128, 128]", "shape = [8, 12]"),
    ("reference_shape = [512, 512]", "reference_shape = [24, 36]"),
    ("spin_up = 60", "spin_up = 2"),
    ("train = 64", "train = 6"),
    ("valid = 8", "valid = 2"),
    ("valid_steps = 20", "valid_steps = 3"),
    ("levels = 3", "levels = 2"),
    ("width = 32", "width = 4"),
    ("batch = 8", "batch = 3"),
    ("epochs = 100", "epochs = 2"),
    ("rtol = 1e-5", "rtol = 1e-4"),
)
ZERO_GRAD = ("rtol = 1e-4", 'rtol = 1e-4\non_failure = "zero_grad"')
DOUBLE = ('"float32"', '"float64"')


def small(tmp_path, *changes):
    return written(tmp_path, *SMALL, *changes, scene="kolmogorov", name="small")


def force(ny, nx):
    y = (np.arange(ny) + 0.5) / ny
    along_x = np.repeat(10 * np.sin(2 * np.pi * 4 * y)[:, None], nx, axis=1)
    return torch.from_numpy(np.stack([along_x, np.zeros((ny, nx))]))[None]


def coarse_faces(u, factor):
    """Each coarse value as the mean of the fine ones on its face, one by one."""
    samples, _, ny, nx = u.shape
    found = np.empty((samples, 2, ny // factor, nx // factor))
    for j in range(ny // factor):
        for i in range(nx // factor):
            y, x = factor * j, factor * i
            found[:, 0, j, i] = u[:, 0, y : y + factor, x].mean(-1)
            found[:, 1, j, i] = u[:, 1, y, x : x + factor].mean(-1)
    return found


def test_data_are_those_of_the_finer_flow(tmp_path):
    scene = scenes.load(small(tmp_path, DOUBLE))
    fine = prdp.Flow((24, 36), nu=5e-3, dt=2e-3 / 3, force=force(24, 36))
    u = random_flow(24, 36, 10, seed=0)[:, :2]
    states = fine.rollout(u, 3 * 8)[:, ::3]  # three steps of spin-up, then those of the data
    expected = [coarse_faces(states[:, n].numpy(), 3) for n in range(3, 9)]
    data = _C.make_dataset(scene)
    found = [data.train_start, *data.train_between.unbind(1), data.train_end]
    for n in range(5):
        np.testing.assert_allclose(found[n], expected[n][:8], atol=1e-6)
    np.testing.assert_allclose(data.valid_end, expected[4][8:], atol=1e-6)
    np.testing.assert_allclose(_C.validation_trajectories(scene, 5)[:, 5], expected[5][8:], atol=1e-6)
    assert float(fields.divergence(data.valid_end).abs().max()) < 1e-3 * float(fields.curl(data.valid_end).abs().max())


def test_the_stepper_is_a_coarse_flow_with_the_force(tmp_path):
    scene = scenes.load(small(tmp_path, DOUBLE))
    np.testing.assert_allclose(scene.physics.force, force(8, 12), atol=1e-14)
    assert scenes.load("navier_stokes").physics.force is None
    u = random_flow(8, 12, 2, seed=1)[:, :2]
    flow = prdp.Flow((8, 12), nu=5e-3, dt=2e-3, force=force(8, 12), advection="upwind")
    torch.testing.assert_close(scenes.make_stepper(scene)(u), flow(u), rtol=0, atol=1e-4)


def test_the_loss_is_that_of_all_trained_steps(tmp_path):
    scene = scenes.load(small(tmp_path, DOUBLE, ("rtol = 1e-4", "rtol = 1e-10"), ("zero_output = true", "")))
    data, network = _C.make_dataset(scene), make_network(scene, 0)
    steppers = [scenes.make_stepper(scene) for _ in range(scene.executions)]
    assert len(steppers) == 4
    loss_of = network_task._corrector(scene, steppers, network_task._TrainingSamples(scene, data), network)
    batch, expected = torch.tensor([3, 1]), 0.0
    u = data.train_start[batch]
    with torch.no_grad():
        for reference in (*data.train_between.unbind(1), data.train_end):
            u = steppers[0](u)
            u = u + network(u)
            expected += float((u - reference[batch]).square().mean())
    assert float(loss_of(batch).detach()) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    "arguments, refine, changes",
    [
        (["--prdp"], Refinement.prdp, []),
        (["--auto"], lambda _: Refinement.auto(), []),
        (["--constant", "3"], lambda _: Refinement.constant(3), [ZERO_GRAD]),
    ],
)  # fmt: skip
def test_both_languages_train_alike(tmp_path, arguments, refine, changes):
    path = small(tmp_path, *changes)
    command = [TRAINER, path, "--out", tmp_path / "cpp", *arguments]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert "data: 70 of 70 reference steps" in done.stderr
    cpp = json.loads(next((tmp_path / "cpp").glob("*/seed_0.json")).read_text())["curves"]
    scene = scenes.load(path)
    python = train(scene, refine(scene))
    assert len(python["update_loss"]) == 6
    np.testing.assert_allclose(cpp["update_loss"], python["update_loss"], rtol=1e-4)
    np.testing.assert_allclose(cpp["metric"], python["metric"], rtol=1e-4)
    np.testing.assert_allclose(cpp["rtol"], python["rtol"], rtol=1e-3)
    assert cpp["max_iter"] == python["max_iter"] and cpp["budget"] == python["budget"]
    np.testing.assert_allclose(cpp["operator_applications"], python["operator_applications"], rtol=2e-2)


@pytest.mark.parametrize("flag, refine", [("--prdp", Refinement.prdp), ("--auto", lambda _: Refinement.auto())])
def test_both_languages_train_a_unet_through_eight_steps_alike(tmp_path, flag, refine):
    path = written(tmp_path, *UNET, scene="kolmogorov_unet", name="small")
    subprocess.run([TRAINER, path, "--out", tmp_path / "cpp", flag], check=True, capture_output=True)
    cpp = json.loads(next((tmp_path / "cpp").glob("*/seed_0.json")).read_text())["curves"]
    scene = scenes.load(path)
    assert scene.executions == 8 and scene.network.kind == "unet"
    python = train(scene, refine(scene))
    assert len(set(python["update_loss"])) == 4
    for name in ("update_loss", "metric", "rtol"):
        np.testing.assert_allclose(cpp[name], python[name], rtol=1e-4)
    assert cpp["max_iter"] == python["max_iter"] and cpp["budget"] == python["budget"]
    weights = prdp.load_trained(tmp_path / "cpp").network.state_dict()
    assert weights.keys() == make_network(scene, 0).state_dict().keys()


def test_data_are_made_on_the_device_and_kept_beside_those_of_the_cpu(tmp_path):
    scene = scenes.load(small(tmp_path, DOUBLE))
    expected = _C.make_dataset(scene)
    there = scenes.load(small(tmp_path, DOUBLE))
    with StandIn() as device:
        found = _C.make_dataset(scenes.placed(there, DEVICE))
        states = [device.fetch(x) for x in (found.train_start, found.train_between, found.train_end, found.valid_end)]
    assert device.launched() > 100
    for mine, other in zip(
        states, (expected.train_start, expected.train_between, expected.train_end, expected.valid_end), strict=True
    ):
        torch.testing.assert_close(mine, other, rtol=0, atol=1e-5)
        assert not torch.equal(mine, other)  # by FFT there, by CG here
    again = _C.make_dataset(scene)
    assert torch.equal(again.valid_end, expected.valid_end)


def test_pictures_show_the_vorticity(tmp_path):
    scene = scenes.load(small(tmp_path))
    states = _C.validation_trajectories(scene, 1)[0]
    assert torch.equal(trajectories.field(scene, states), fields.curl(states)[:, 0])


@pytest.mark.parametrize(
    "before, after, where, message",
    [
        ("[24, 36]", "[24, 24]", "reference_shape", "expected the same multiple of each N of physics.shape"),
        ("amplitude = 10.0", "amplitude = 0.0", "amplitude =", "physics.amplitude: must be > 0, got 0"),
        ("waves = 4", "waves = 0", "waves =", "physics.waves: must be >= 1, got 0"),
        ("spin_up = 3", "", "[data]", "data.spin_up: missing"),
        ("trained_steps = 4", "trained_steps = 1", "trained_steps", "data.trained_steps: must be >= 2, got 1"),
    ],
)
def test_mistakes_are_named_with_file_and_line(tmp_path, before, after, where, message):
    assert_refused(small(tmp_path, (before, after)), where, message)
