"""Trainings on another device than the CPU: the same data, weights and curves, and files that move between devices. On
the stand-in; test_cuda_trainings.py does it on a GPU."""

import json
import re
import subprocess
from pathlib import Path

import pytest
import torch
from helpers import small_darcy, small_field, tiny, written
from stand_in_device import DEVICE, StandIn
from test_kolmogorov import UNET
from trainings import frequent_checkpoints, without_seconds  # noqa: F401  # the fixture
from typer.testing import CliRunner

import prdp_torch as prdp
from prdp_torch.experiments import _C, checkpoint, cli, compare, records, scenes
from prdp_torch.experiments.checkpoint import Checkpoint
from prdp_torch.experiments.networks import make_network
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

ROOT = Path(__file__).parents[2]
TRAINER = ROOT / "build" / "prdp_train"
KOLMOGOROV = (
    ("shape = [64, 64]", "shape = [8, 8]"),
    ("reference_shape = [256, 256]", "reference_shape = [16, 16]"),
    ("spin_up = 30", "spin_up = 1"),
    ("train = 24", "train = 4"),
    ("valid = 4", "valid = 2"),
    ("valid_steps = 20", "valid_steps = 2"),
    ("trained_steps = 4", "trained_steps = 2"),
    ("batch = 8", "batch = 4"),
    ("rtol = 1e-5", "rtol = 1e-4"),
)
FEWER_STEPS = (
    ("train = 6", "train = 3"),
    ("trained_steps = 8", "trained_steps = 2"),
    ("valid_steps = 3", "valid_steps = 2"),
)
PATHS = {
    "emulator": written,
    "fresh emulator": lambda folder: written(folder, ("valid = 5", "valid = 5\nfresh = true")),
    "parameters": lambda folder: written(folder, scene="poisson_1p"),
    "corrector": tiny,
    "kolmogorov": lambda folder: written(folder, *KOLMOGOROV, scene="kolmogorov"),
    "unet": lambda folder: written(folder, *UNET, *FEWER_STEPS, scene="kolmogorov_unet"),
    "field": small_field,
    "darcy": small_darcy,
}


def scene_of(case, folder, intervals=2):
    scene = scenes.load(PATHS[case](folder))
    scene.training.intervals = intervals
    return scene


def on_device(scene, refinement, **options):
    """The curves of a training there, and the device with its counts."""
    with StandIn() as device:
        return train(scene, refinement, device=DEVICE, **options), device


def expect_same(curves, others, rel=1e-4):
    """To rounding of float32."""
    assert curves.keys() == others.keys()
    for name, values in without_seconds(curves).items():
        assert values == (pytest.approx(others[name], rel=rel) if name != "warning" else others[name]), name


@pytest.mark.parametrize("refine", [lambda scene: Refinement.auto(), Refinement.prdp], ids=["auto", "prdp"])
@pytest.mark.parametrize("case", PATHS)
def test_a_scene_trains_on_a_device_as_on_the_cpu(case, refine, tmp_path):
    scene = scene_of(case, tmp_path, intervals=1 if case in ("corrector", "kolmogorov", "unet") else 2)
    intervals = []
    curves, device = on_device(scene, refine(scene), callbacks=[intervals.append])
    assert device.launched() > 1000  # of torch: the work was there
    # The cycles of multigrid are others there: after one of them the losses differ by 0.4 %.
    expect_same(curves, train(scene, refine(scene)), rel=1e-2 if case == "darcy" else 1e-4)
    assert json.loads(json.dumps(intervals))  # numbers of Python, for callbacks and TensorBoard
    assert scene.device == torch.device("cpu")  # the caller's scene is left as it was


def test_how_often_the_host_waits(tmp_path):
    """In an update for the loss and, in operations of torch, for the two solves; and three times an interval."""
    scene = scenes.load(written(tmp_path, ("rtol = 1e-5", "rtol = 0.0")))

    def copies(intervals):
        scene.training.intervals = intervals
        return on_device(scene, Refinement.constant(3))[1].copies_to_host

    updates = 200 // 25
    assert copies(3) - copies(2) == updates * 8 + 3


def stopped(number):
    return lambda interval: interval.number == number


@pytest.mark.parametrize("case", ["emulator", "darcy", "parameters"])
def test_a_training_resumes_bit_for_bit_there_and_to_rounding_elsewhere(case, tmp_path):
    scene = scene_of(case, tmp_path, intervals=4)
    alone, _ = on_device(scene, Refinement.prdp(scene))

    def interrupted(run, number):
        path = Checkpoint(tmp_path / f"{case}_{number}")
        run(scene, Refinement.prdp(scene), callbacks=[stopped(2)], checkpoint=path)
        return path

    there = lambda *args, **options: on_device(*args, **options)[0]  # noqa: E731
    again = there(scene, Refinement.prdp(scene), checkpoint=interrupted(there, 0))
    assert without_seconds(again) == without_seconds(alone)
    rel = 1e-2 if case == "darcy" else 1e-4
    expect_same(train(scene, Refinement.prdp(scene), checkpoint=interrupted(there, 1)), alone, rel)
    expect_same(there(scene, Refinement.prdp(scene), checkpoint=interrupted(train, 2)), alone, rel)


def test_ctrl_c_on_a_device_leaves_a_checkpoint_that_the_cpu_continues(tmp_path):
    scene = scene_of("emulator", tmp_path, intervals=4)

    def press(interval):
        if interval.number == 3:
            raise KeyboardInterrupt

    kept = Checkpoint(tmp_path / "kept")
    with pytest.raises(KeyboardInterrupt):
        on_device(scene, Refinement.auto(), callbacks=[press], checkpoint=kept)
    resumed = []
    curves = train(scene, Refinement.auto(), callbacks=[resumed.append], checkpoint=kept)
    assert [interval.resumed for interval in resumed] == [True, True, True, False]
    expect_same(curves, train(scene, Refinement.auto()), 1e-4)


def test_the_random_numbers_of_a_gpu_are_passed_over_on_the_cpu(tmp_path, monkeypatch):
    """The state of its generator is 16 bytes, which a training on the CPU does not need."""
    scene = scene_of("emulator", tmp_path)
    state = {checkpoint.RANDOM_CUDA: torch.arange(16, dtype=torch.uint8)}
    with monkeypatch.context() as patch:
        patch.setattr("prdp_torch.experiments.training.random_states", lambda device: state | before(device))
        before = checkpoint.random_states
        kept = Checkpoint(tmp_path / "kept")
        train(scene, Refinement.auto(), callbacks=[stopped(1)], checkpoint=kept)
    resumed = train(scene, Refinement.auto(), checkpoint=kept)
    assert without_seconds(resumed) == without_seconds(train(scene, Refinement.auto()))


class LowPrecision(torch.nn.Module):
    """Convolutions in bfloat16 around float32 solves."""

    def __init__(self):
        super().__init__()
        self.conv = torch.nn.Conv1d(1, 1, 3, padding=1)

    def forward(self, u):
        weight, bias = (parameter.bfloat16() for parameter in (self.conv.weight, self.conv.bias))
        return torch.nn.functional.conv1d(u.bfloat16(), weight, bias, padding=1).float()


def test_an_own_network_in_bfloat16_is_moved_and_trains_on_own_data(tmp_path):
    scene = scene_of("emulator", tmp_path)
    u0 = torch.randn(205, 1, 30, generator=torch.Generator().manual_seed(1))
    data = scenes.make_stepper(scene, direct=True).rollout(u0, 2)

    def network():
        torch.manual_seed(0)
        return LowPrecision()

    mine, other = network(), network()
    curves, _ = on_device(scene, Refinement.auto(), network=mine, data=data)
    assert mine.conv.weight.device == DEVICE
    expect_same(curves, train(scene, Refinement.auto(), network=other, data=data), 1e-2)  # a bit of bfloat16 is 4e-3


def recorded(scene, folder):
    return compare.run_one(scene, "prdp", Refinement.prdp(scene), 0, folder, records.environment(scene.device))


@pytest.mark.parametrize("case, shape", [("emulator", (2, 1, 30)), ("corrector", (2, 3, 8, 8))])
def test_a_network_trained_there_is_loaded_anywhere(case, shape, tmp_path):
    scene = scene_of(case, tmp_path, intervals=1)
    with StandIn() as device:
        recorded(scenes.placed(scene, DEVICE), tmp_path / "there")
    recorded(scene, tmp_path / "here")
    record = json.loads((tmp_path / "there/prdp/seed_0.json").read_text())
    assert record["machine"]["device"] == "lazy:0"
    weights = torch.load(tmp_path / "there/prdp/seed_0.pt", weights_only=True)
    assert {value.device.type for value in weights.values()} == {"cpu"}
    u = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        moved, expected = (prdp.load_trained(tmp_path / name)(u) for name in ("there", "here"))
        with StandIn() as device:
            found = prdp.load_trained(tmp_path / "there", device=DEVICE)
            states = found.rollout(device.send(u), 1)
    torch.testing.assert_close(moved, expected, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(device.fetch(states)[:, 1], moved, rtol=1e-4, atol=1e-4)
    # The record is of this training wherever it is done again.
    done = compare.run_one(scene, "prdp", Refinement.prdp(scene), 0, tmp_path / "there", {"versions": {}}, resume=True)
    assert done == records.read_training(tmp_path / "there/prdp/seed_0.json")["curves"]


def test_a_scene_that_names_a_gpu_is_read_and_loaded_without_one(tmp_path):
    scene = scenes.load(written(tmp_path, ('dtype = "float32"', 'dtype = "float32"\ndevice = "cuda:1"')))
    assert scene.device == torch.device("cuda", 1)
    scene.training.intervals = 1
    recorded(scenes.placed(scene, "cpu"), tmp_path)
    assert prdp.load_trained(tmp_path).scene.device == torch.device("cpu")


def test_compare_and_advise_work_on_a_device(tmp_path):
    scene = written(tmp_path, ("constant = [1, 2, 3, 5, 7, 10, 15, 25]", "constant = [2]"))
    with StandIn():
        options = ["--device", "lazy:0", "--seeds", "1", "--intervals", "1", "--out", str(tmp_path)]
        done = CliRunner().invoke(cli.app, ["compare", scene, *options])
        advised = CliRunner().invoke(cli.app, ["advise", scene, "--device", "lazy:0", "--seconds", "0.02"])
    assert done.exit_code == 0 and "report:" in done.output, done.output
    for record in ("summary.json", "auto/seed_0.json"):
        assert json.loads((tmp_path / record).read_text())["machine"]["device"] == "lazy:0"
    assert advised.exit_code == 0 and "is the fastest to" in advised.output, advised.output


WRONG = {
    "gpu": r"unknown name 'gpu'; allowed: cpu, cuda, cuda:N",
    "cpu:1": r"unknown name 'cpu:1'; allowed: cpu, cuda, cuda:N",
    "cuda:300": r"unknown name 'cuda:300'; allowed: cpu, cuda, cuda:N",
    "cuda:99": r"there is no 'cuda:99', as torch finds (no|\d+) GPUs?; .*",
    "meta": r"'meta' does not work: .*",
}


@pytest.mark.parametrize("name", WRONG)
def test_a_device_that_is_not_there_is_one_sentence_before_any_work(name, tmp_path):
    words = rf"device: {WRONG[name]}"
    for command in (["train", "heat_1d"], ["compare", "heat_1d"], ["advise", "heat_1d"]):
        out = [] if command[0] == "advise" else ["--out", str(tmp_path / "out")]
        done = CliRunner().invoke(cli.app, [*command, "--device", name, *out])
        assert done.exit_code == 2 and re.fullmatch(f"prdp: {words}\n", done.stderr), done.stderr
    heat = scenes.available()["heat_1d"]
    done = subprocess.run(
        [TRAINER, heat, "--device", name, "--out", "out"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 2 and re.fullmatch(f"prdp_train: {words}\n", done.stderr), done.stderr
    assert not list(tmp_path.iterdir())
    scene = scenes.load("heat_1d")
    with pytest.raises(ValueError, match=words):
        train(scene, Refinement.auto(), network=make_network(scene, 0), device=name)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_the_device_of_a_scene_is_looked_for_by_all_that_compute(tmp_path):
    path = written(tmp_path, ('dtype = "float32"', 'dtype = "float32"\ndevice = "cuda"'))
    scene = scenes.load(path)
    words = "device: there is no 'cuda', as torch finds no GPU"
    for call in (lambda: train(scene, Refinement.auto()), lambda: scenes.placed(scene), lambda: _C.find_device("cuda")):
        with pytest.raises(ValueError, match=words):
            call()
    done = subprocess.run([TRAINER, path, "--out", tmp_path / "out"], capture_output=True, text=True)
    assert done.returncode == 2 and words in done.stderr and not (tmp_path / "out").exists()
    assert (
        subprocess.run([TRAINER, path, "--device", "cpu", "--intervals", "1", "--out", tmp_path / "out"]).returncode
        == 0
    )
