"""Weights that pass between the two trainers."""

import io
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from helpers import tiny, written

import prdp_torch as prdp
from prdp_torch.experiments import scenes
from prdp_torch.experiments.networks import make_network
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def environment(tmp_path, monkeypatch):
    monkeypatch.setenv("PRDP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


def prdp_train(*arguments):
    command = [ROOT / "build" / "prdp_train", "--prdp", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    return done.returncode, done.stderr


def scene_of(kind, tmp_path):
    if kind == "unet":
        unet = ('kind = "mlp"\nhidden = [64, 64, 64]', 'kind = "unet"\nlevels = 1\nwidth = 4')
        return written(tmp_path, unet, scene="heat_1d")
    return written(tmp_path) if kind == "mlp" else tiny(tmp_path)


@pytest.mark.parametrize("kind", ["mlp", "resnet", "unet"])
def test_weights_pass_from_cpp_to_python_and_back(tmp_path, kind):
    path = scene_of(kind, tmp_path)
    scene = scenes.load(path)
    scene.training.intervals = 2
    assert prdp_train(path, "--out", tmp_path / "cpp", "--intervals", 2, "--seeds", 2)[0] == 0

    # Python has the network that C++ has trained, not that of the seed.
    trained = prdp.load_trained(tmp_path / "cpp/prdp")
    weights = torch.load(tmp_path / "cpp/prdp/seed_0.pt", weights_only=True)
    assert weights.keys() == make_network(scene, 0).state_dict().keys()
    scene.training.intervals = 1
    on = train(scene, Refinement.prdp(scene), network=trained.network)
    assert on["metric"][0] == pytest.approx(trained.curves["metric"][-1], rel=1e-5)

    # C++ begins with the network that Python has gone on with.
    torch.save(trained.network.state_dict(), tmp_path / "python.pt")
    again = (path, "--out", tmp_path / "again", "--intervals", 1, "--weights")
    for file in (tmp_path / "python.pt", tmp_path / "cpp/prdp/seed_1.pt"):
        assert prdp_train(*again, file)[0] == 0
        record = json.loads((tmp_path / "again/prdp/seed_0.json").read_text())
        other = file.with_suffix(".json")
        wanted = json.loads(other.read_text())["curves"]["metric"] if other.exists() else on["metric"]
        assert record["curves"]["metric"][0] == pytest.approx(wanted[-1], rel=1e-5)
        assert len(record["settings"]["weights"]) == 16


class Bomb:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)


def test_weights_that_do_not_fit_are_one_line_and_run_no_code(tmp_path):
    path = written(tmp_path)
    state = make_network(scenes.load(path), 0).state_dict()
    renamed = {f"x{name}": value for name, value in state.items()}
    wide = {name: value.double() for name, value in state.items()}
    less = dict(list(state.items())[1:])
    more = {**state, "more": torch.zeros(1)}
    unknown = {**state, "layers.0.bias": state["layers.0.bias"] * torch.nan}
    bomb = state | {"layers.0.weight": Bomb(str(tmp_path / "crater"))}
    for content, words in [
        (renamed, "weights: there is no tensor 'layers.0.weight'"),
        (wide, "weights: tensor 'layers.0.weight' is float64 of sizes [64, 30], expected float32 of sizes [64, 30]"),
        (less, "weights: there is no tensor 'layers.0.weight'"),
        (more, "weights: nobody knows its tensor 'more'"),
        (unknown, "weights: tensor 'layers.0.bias' holds NaN or Inf"),
        (bomb, "weights: expected a dict of tensors, as torch.save(network.state_dict(), path) writes it"),
        (None, "weights: expected a dict of tensors, as torch.save(network.state_dict(), path) writes it"),
    ]:
        saved = io.BytesIO()
        torch.save(content, saved)
        (tmp_path / "given.pt").write_bytes(saved.getvalue() if content is not None else b"nothing of the kind")
        status, errors = prdp_train(path, "--out", tmp_path / "out", "--weights", tmp_path / "given.pt")
        assert status == 2 and words in errors and f"'{tmp_path / 'given.pt'}'" in errors and errors.count("\n") == 1
    status, errors = prdp_train(path, "--out", tmp_path / "out", "--weights", tmp_path / "missing.pt")
    assert status == 2 and "weights: cannot read" in errors
    assert not (tmp_path / "crater").exists()
    poisson = scenes.available()["poisson_1p"]
    status, errors = prdp_train(poisson, "--out", tmp_path / "out", "--weights", tmp_path / "given.pt")
    assert status == 2 and "weights: the scene 'poisson_1p' trains no network" in errors


def patched(saved, *changes, **sizes):
    """The file of torch.save with texts in its files replaced, and with other sizes in its directory than they have."""
    with zipfile.ZipFile(io.BytesIO(saved)) as whole:
        files = {file.filename.removeprefix("archive/"): whole.read(file) for file in whole.infolist()}
    for name, old, new in changes:
        assert old in files[name]
        files[name] = files[name].replace(old, new, 1)
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for name, content in files.items():
            archive.writestr(f"archive/{name}", content)
        for file in archive.infolist():
            size = sizes.get(file.filename.replace("archive/data/", "file_"), file.file_size)
            file.file_size = file.compress_size = size
    return made.getvalue()


PICKLE = "data.pkl"
LENGTH = b"M\x80\x07t"  # of the first storage, 64 · 30 numbers
FAR, FARTHER = (b"J" + number.to_bytes(4, "little") for number in (1 << 30, 1 << 30 | 1 << 11))
FAR_AWAY = (PICKLE, b"QK\x00", b"Q" + FAR)  # where the first tensor begins
FORGERIES = {
    "a tensor beyond its storage": ([FAR_AWAY], {}),
    "a storage beyond its file": ([(PICKLE, LENGTH, FAR + b"t")], {}),
    "a tensor beyond its file": ([(PICKLE, LENGTH, FARTHER + b"t"), FAR_AWAY], {}),
    "a text of 4 GB": ([(PICKLE, b"X\x0f\0\0\0layers", b"X\xf0\xff\xff\xfflayers")], {}),
    "the last memo of 32 bits": ([(PICKLE, b"q\x02", b"r\xff\xff\xff\xff")], {}),
    "another byte order": ([("byteorder", b"little", b"big")], {}),
    "a file of 3 GB": ([], {"file_0": 3 << 30}),
    "a file without end": ([], {"file_1": 1 << 62}),
}

# Prints the peak of the command's memory in KiB. A program of its own: a child's peak starts at that of its parent,
# which for pytest with everything imported is a gigabyte and more.
PEAK = """
import resource, subprocess, sys
status = subprocess.run(sys.argv[1:]).returncode
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(status)
"""


@pytest.mark.parametrize("forgery", FORGERIES)
def test_forged_weights_are_refused_and_take_no_memory(tmp_path, forgery):
    path = written(tmp_path)
    changes, sizes = FORGERIES[forgery]
    saved = io.BytesIO()
    torch.save(dict(make_network(scenes.load(path), 0).state_dict()), saved)
    (tmp_path / "given.pt").write_bytes(patched(saved.getvalue(), *changes, **sizes))
    command = [ROOT / "build" / "prdp_train", path, "--out", tmp_path / "out", "--weights", tmp_path / "given.pt"]
    trainer = subprocess.run([sys.executable, "-c", PEAK, *command], capture_output=True, text=True)
    assert trainer.returncode == 2 and trainer.stderr.count("\n") == 1
    assert "weights: expected a dict of tensors, as torch.save(network.state_dict(), path) writes it" in trainer.stderr
    assert int(trainer.stdout.splitlines()[-1]) < 1 << 20


def test_archives_with_numbers_of_64_bits_are_read(tmp_path, monkeypatch):
    """torch writes them where a file, or all of them together, has 4 GB."""
    path = written(tmp_path)
    saved = io.BytesIO()
    torch.save(make_network(scenes.load(path), 1).state_dict(), saved)
    curves = []
    for limit in (zipfile.ZIP64_LIMIT, 0):
        monkeypatch.setattr(zipfile, "ZIP64_LIMIT", limit)
        (tmp_path / "given.pt").write_bytes(patched(saved.getvalue()))
        assert (b"PK\6\6" in (tmp_path / "given.pt").read_bytes()) == (limit == 0)
        given = ("--intervals", 1, "--weights", tmp_path / "given.pt")
        assert prdp_train(path, "--out", tmp_path / str(limit), *given)[0] == 0
        record = json.loads((tmp_path / str(limit) / "prdp/seed_0.json").read_text())
        curves.append(record["curves"]["metric"])
    assert curves[0] == curves[1]
