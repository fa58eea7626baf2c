"""`network = "module:Class"` in a scene file: trained, resumed, loaded again; what is wrong is said in words."""

import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch
from helpers import assert_refused, written

import prdp_torch as prdp
from prdp_torch.experiments import _C, compare, records, scenes
from prdp_torch.experiments.networks import make_network
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

TRAINER = Path(__file__).parents[2] / "build" / "prdp_train"
SOURCE = """
import torch
{more}

class Net(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.norm = torch.nn.BatchNorm1d(1)
        self.layer = torch.nn.Linear(30, 30)
        self.register_buffer("mask", torch.full((30,), float("inf")))

    def forward(self, u):
        return self.layer(self.norm(u)).minimum(self.mask)


class Fourier(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.exp(1j * torch.rand(1, 1, 16)))

    def forward(self, u):
        return torch.fft.irfft(torch.einsum("bci,oci->boi", torch.fft.rfft(u), self.weight), n=u.shape[-1])


class Lazy(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.LazyLinear(30)


class InPlace(Net):
    def forward(self, u):
        return super().forward(u.mul_(0.5))


class Wide(torch.nn.Module):
    def __init__(self, width):
        super().__init__()


Broken = 3
"""


@pytest.fixture
def module(tmp_path, request):
    """The name of a module beside the scene that no other test has imported."""
    name = f"nets_{abs(hash(request.node.nodeid))}"
    (tmp_path / f"{name}.py").write_text(SOURCE.format(more=""))
    yield name
    sys.modules.pop(name, None)


def scene_with(tmp_path, network, name="own"):
    """The path of a copy of heat_1d with this network."""
    path = Path(written(tmp_path, ('[network]\nkind = "mlp"\nhidden = [64, 64, 64]\n', ""), name=name))
    path.write_text(path.read_text().replace("task =", f'network = "{network}"\ntask =', 1))
    return str(path)


def trained(scene, folder, intervals=3, resume=False):
    scene.training.intervals = intervals
    return compare.run_one(scene, "prdp", Refinement.prdp(scene), 0, folder, records.environment(), resume)


def test_an_own_network_is_trained_and_found_again(tmp_path, module):
    scene = scenes.load(scene_with(tmp_path, f"{module}:Net"))
    curves = trained(scene, tmp_path / "run")
    assert curves["metric"][-1] < curves["metric"][0]
    del sys.modules[module]
    emulator = prdp.load_trained(tmp_path / "run")
    assert type(emulator.network).__name__ == "Net" and not emulator.network.training
    data = _C.make_dataset(scene)
    with torch.no_grad():
        states = emulator.rollout(data.valid_start, 2)
    assert float(_C.normalised_mse(states[:, -1], data.valid_end)) == pytest.approx(curves["metric"][-1], rel=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_complex_weights_stay_complex_and_go_on_bit_for_bit(tmp_path, module, dtype):
    path = Path(scene_with(tmp_path, f"{module}:Fourier"))
    path.write_text(path.read_text().replace("float32", str(dtype).removeprefix("torch.")))
    scene = scenes.load(path)
    curves = trained(scene, tmp_path / "run")

    def stop(event):
        if event.number == 1:
            raise KeyboardInterrupt

    scene.training.intervals = 3
    prdp_controller, environment = Refinement.prdp(scene), records.environment()
    with pytest.raises(KeyboardInterrupt):
        compare.run_one(scene, "prdp", prdp_controller, 0, tmp_path / "stopped", environment, callbacks=[stop])
    assert trained(scene, tmp_path / "stopped", resume=True)["metric"] == curves["metric"]
    weights = [prdp.load_trained(tmp_path / name).network.weight for name in ("run", "stopped")]
    assert weights[0].dtype == dtype.to_complex() and torch.equal(*weights) and weights[0].imag.any()


def test_the_seed_sets_its_weights(tmp_path, module):
    scene = scenes.load(scene_with(tmp_path, f"{module}:Net"))
    one, same, other = (make_network(scene, seed).layer.weight for seed in (0, 0, 1))
    assert torch.equal(one, same) and not torch.equal(one, other)


def test_the_command_trains_it_wherever_it_is_called(tmp_path, module):
    scene = scene_with(tmp_path, f"{module}:Net")
    command = [sys.executable, "-m", "prdp_torch", "train", scene, "--out", tmp_path / "run", "--intervals", "1"]
    done = subprocess.run(command, cwd="/", capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert prdp.load_trained(tmp_path / "run").network.mask.isinf().all()


def test_an_error_inside_a_network_names_its_line(tmp_path, module):
    source = (
        SOURCE.format(more="")
        + """

class Late(Net):
    def forward(self, u):
        if len(u) > 5:
            raise ValueError("a mistake of mine")
        return super().forward(u)
"""
    )
    (tmp_path / f"{module}.py").write_text(source)
    scene = scene_with(tmp_path, f"{module}:Late")
    command = [sys.executable, "-m", "prdp_torch", "train", scene, "--out", tmp_path / "run", "--intervals", "1"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    line = source.splitlines().index('            raise ValueError("a mistake of mine")') + 1
    assert done.stderr.endswith(f"prdp: a mistake of mine ({module}.py, line {line})\n")


def test_a_changed_class_is_another_training_and_load_trained_warns(tmp_path, module):
    scene = scenes.load(scene_with(tmp_path, f"{module}:Net"))
    trained(scene, tmp_path / "run", intervals=1)
    record = tmp_path / "run/prdp/seed_0.json"
    before = record.read_bytes()
    trained(scene, tmp_path / "run", intervals=1, resume=True)
    assert record.read_bytes() == before
    (tmp_path / f"{module}.py").write_text(SOURCE.format(more="# changed"))
    with pytest.warns(UserWarning, match=f"{module}.py' has changed since the training"):
        prdp.load_trained(tmp_path / "run")
    trained(scene, tmp_path / "run", intervals=1, resume=True)
    assert record.read_bytes() != before
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        prdp.load_trained(tmp_path / "run")


def test_the_cpp_trainer_says_that_it_cannot(tmp_path, module):
    scene = scene_with(tmp_path, f"{module}:Net")
    done = subprocess.run([TRAINER, scene, "--out", tmp_path / "cpp"], capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    words = f"network: '{module}:Net' is a class in Python, which prdp_train cannot make; run prdp train {scene}\n"
    assert done.stderr == f"prdp_train: {words}"


@pytest.mark.parametrize(
    "network, message",
    [
        ("nowhere_at_all:Net", "there is no module 'nowhere_at_all' in '{folder}', nor where Python looks"),
        ("{module}:Gone", "'{folder}/{module}.py' has no such name, Gone"),
        ("{module}:Broken", "'{folder}/{module}.py' has no subclass of torch.nn.Module, Broken"),
        ("os:abort", "has no subclass of torch.nn.Module, abort"),
        ("{module}:Wide", "Wide() raised TypeError: "),
        ("{module}:Lazy", "Lazy() has lazy layers, whose sizes are not known when weights are read; give them"),
    ],
)
def test_what_is_no_network_is_refused_in_words(tmp_path, module, network, message):
    network = network.format(module=module)
    scene = scenes.load(scene_with(tmp_path, network))
    with pytest.raises(ValueError) as error:
        make_network(scene, 0)
    text = str(error.value)
    assert text.startswith(f"network: '{network}' of the scene '{scene.path}': ") and "\n" not in text
    assert message.format(folder=tmp_path, module=module) in text


def test_a_network_that_changes_its_input_is_refused_before_it_is_trained(tmp_path, module):
    scene = scenes.load(scene_with(tmp_path, f"{module}:InPlace"))
    with pytest.raises(ValueError, match="train: network changes its input in place"):
        trained(scene, tmp_path)
    with pytest.raises(ValueError, match=r"train: network must keep the dtype of its input, torch\.float32, got"):
        train(scene, Refinement.auto(), network=Doubled())


class Doubled(torch.nn.Linear):
    def __init__(self):
        super().__init__(30, 30)

    def forward(self, u):
        return super().forward(u).double()


def test_a_module_that_raises_is_refused_in_words(tmp_path, module):
    scene = scenes.load(scene_with(tmp_path, f"{module}:Net"))
    for more, words in (
        ("1 / 0", "raised ZeroDivisionError: division"),
        ("import gone_gone", "raised No module named"),
    ):
        (tmp_path / f"{module}.py").write_text(SOURCE.format(more=more))
        with pytest.raises(ValueError, match=f"network: .*its module {words}"):
            make_network(scene, 0)


def test_two_modules_of_one_name_are_not_mistaken(tmp_path, module):
    make_network(scenes.load(scene_with(tmp_path, f"{module}:Net")), 0)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / f"{module}.py").write_text(SOURCE.format(more=""))
    with pytest.raises(ValueError, match=f"another module '{module}' is imported already, '{tmp_path}/{module}.py'"):
        make_network(scenes.load(scene_with(tmp_path / "other", f"{module}:Net")), 0)


@pytest.mark.parametrize("network", ["Net", ":Net", "nets:", "a:b:c", ""])
def test_a_text_that_names_no_class_is_refused_with_its_line(tmp_path, network):
    assert_refused(scene_with(tmp_path, network), "network =", 'network: expected a table, or "module:Class"')
