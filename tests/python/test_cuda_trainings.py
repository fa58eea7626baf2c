"""Trainings on a GPU, as `make cuda` runs them. Without one the CPU takes its place: then these tests are tried
themselves, and CUDA is not."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers import written
from test_cuda import CUDA, DEVICE
from test_training_devices import LowPrecision, expect_same, scene_of, stopped
from trainings import frequent_checkpoints, without_seconds  # noqa: F401  # the fixture

import prdp_torch as prdp
from prdp_torch.experiments import compare, records, scenes
from prdp_torch.experiments.checkpoint import Checkpoint
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

pytestmark = pytest.mark.cuda
ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def full_precision():
    """Convolutions in float32, not TF32: the curves are compared with those of the CPU."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    yield
    torch.backends.cudnn.allow_tf32 = before


@pytest.mark.parametrize("case", ["emulator", "fresh emulator", "parameters", "corrector", "field", "darcy"])
def test_a_scene_trains_on_a_gpu_as_on_the_cpu(case, tmp_path):
    scene = scene_of(case, tmp_path)
    intervals = []
    curves = train(scene, Refinement.prdp(scene), device=DEVICE, callbacks=[intervals.append])
    expect_same(curves, train(scene, Refinement.prdp(scene)), rel=1e-2 if case == "darcy" else 1e-3)
    assert json.loads(json.dumps(intervals))


class Dropout(torch.nn.Module):
    """It draws random numbers on its device."""

    def __init__(self):
        super().__init__()
        self.layers = torch.nn.Sequential(torch.nn.Linear(30, 30), torch.nn.Dropout(0.2))

    def forward(self, u):
        return self.layers(u)


@pytest.mark.parametrize("case", ["emulator", "dropout", "corrector", "field", "darcy"])
def test_a_training_resumes_bit_for_bit(case, tmp_path):
    scene = scene_of("emulator" if case == "dropout" else case, tmp_path, intervals=4)

    def curves(**options):
        torch.manual_seed(0)
        network = Dropout() if case == "dropout" else None
        return train(scene, Refinement.auto(), network=network, device=DEVICE, **options)

    kept = Checkpoint(tmp_path / "kept")
    curves(callbacks=[stopped(2)], checkpoint=kept)
    assert without_seconds(curves(checkpoint=kept)) == without_seconds(curves())


@pytest.mark.parametrize("devices", [(DEVICE, "cpu"), ("cpu", DEVICE)], ids=["to the CPU", "from the CPU"])
@pytest.mark.parametrize("case", ["emulator", "corrector", "field"])
def test_a_training_resumes_on_another_device(case, devices, tmp_path):
    scene = scene_of(case, tmp_path, intervals=4)
    kept = Checkpoint(tmp_path / "kept")
    train(scene, Refinement.prdp(scene), device=devices[0], callbacks=[stopped(2)], checkpoint=kept)
    resumed = train(scene, Refinement.prdp(scene), device=devices[1], checkpoint=kept)
    expect_same(resumed, train(scene, Refinement.prdp(scene)), rel=1e-3)


def test_a_network_trained_there_is_loaded_anywhere(tmp_path):
    scene = scenes.placed(scene_of("corrector", tmp_path), DEVICE)
    compare.run_one(scene, "prdp", Refinement.prdp(scene), 0, tmp_path, records.environment(scene.device))
    machine = json.loads((tmp_path / "prdp/seed_0.json").read_text())["machine"]
    assert machine["device"] == str(DEVICE) and ("gpu" in machine) == CUDA
    u = torch.randn(2, 3, 8, 8, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        here, there = prdp.load_trained(tmp_path)(u), prdp.load_trained(tmp_path, device=DEVICE)(u.to(DEVICE))
    assert there.device.type == DEVICE.type
    torch.testing.assert_close(there.cpu(), here, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("case", ["emulator", "corrector", "field", "darcy", "parameters"])
def test_both_languages_train_alike(case, tmp_path):
    """With the trainer that `make cuda` builds where it finds the headers."""
    trainer = ROOT / ("build-cuda" if CUDA else "build") / "prdp_train"
    if not trainer.exists():
        pytest.skip("prdp_train was not built")
    scene = scene_of(case, tmp_path, intervals=4)
    options = ["--prdp", "--intervals", "4", "--device", str(DEVICE), "--out", tmp_path / "cpp"]
    subprocess.run([trainer, scene.path, *options], check=True, capture_output=True)
    cpp = records.read_training(tmp_path / "cpp/prdp/seed_0.json")["curves"]
    python = train(scene, Refinement.prdp(scene), device=DEVICE)
    for name in ("update_loss", "metric"):
        assert cpp[name] == pytest.approx(python[name], rel=1e-3)
    assert cpp["max_iter"] == python["max_iter"] and cpp["budget"] == python["budget"]


def test_a_network_in_bfloat16_around_float32_solves(tmp_path):
    scene = scene_of("emulator", tmp_path)
    torch.manual_seed(0)
    network = LowPrecision()
    curves = train(scene, Refinement.auto(), network=network, device=DEVICE)
    assert network.conv.weight.device.type == DEVICE.type
    assert network.conv.weight.dtype == torch.float32 and curves["failed"] == [0, 0]


def test_converged_and_refined_trainings_end_within_the_spread_of_the_cpu(tmp_path):
    """heat_1d as it is: a training of the same seed, whose rounding differs, is no worse than another seed's."""
    scene = scenes.load("heat_1d")
    scene.training.intervals = 40
    of_seeds = torch.tensor([train(scene, Refinement.auto(), seed=seed)["metric"][-1] for seed in range(3)])
    there = train(scene, Refinement.auto(), device=DEVICE)["metric"][-1]
    assert abs(there - of_seeds.mean()) <= 3 * of_seeds.std()


@pytest.mark.skipif(not CUDA, reason="test_processes.py does this on CPUs")
@pytest.mark.parametrize("device", ["cuda", "cuda:0"])
def test_two_processes_train_as_one_does(device, tmp_path):
    """By NCCL where there are two GPUs; with one, or all on one, by gloo, which they are told."""
    path = written(tmp_path, ('dtype = "float32"', 'dtype = "float64"'))
    command = ["-m", "prdp_torch", "train", path, "--prdp", "--intervals", "5", "--device", device, "--out"]
    subprocess.run([sys.executable, *command, tmp_path / "one"], check=True)
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run([*launcher, *command, tmp_path / "two"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    share = device == "cuda:0" or torch.cuda.device_count() == 1
    assert ("2 processes share 1 GPU: gloo sums their gradients" in done.stderr) == share
    one, two = (records.read_training(tmp_path / name / "prdp/seed_0.json")["curves"] for name in ("one", "two"))
    assert two["metric"] == pytest.approx(one["metric"], rel=1e-8) and two["max_iter"] == one["max_iter"]
