"""Files of trajectories, HDF5 and .npz: the same keys and checks, and no traceback for any file."""

import io
import subprocess
import sys
import zipfile

import h5py
import numpy as np
import pytest
import torch
from helpers import written
from trainings import without_seconds
from typer.testing import CliRunner

from prdp_torch.experiments import _C, array_files, cli, datasets, pdebench, scenes
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

PRDP = [sys.executable, "-m", "prdp_torch"]
SMALL = ("train = 200", "train = 50"), ("epochs = 100", "epochs = 3")
NAMES = ("x.h5", "x.npz")


def made(tmp_path):
    return scenes.load(written(tmp_path, *SMALL, name="made"))


def from_file(tmp_path, name):
    changes = ("modes = 5               # sines and cosines 2πn, n = 1 … 5", f'file = "{name}"'), ("seed = 0\n", "")
    return scenes.load(written(tmp_path, *SMALL, *changes, name="read"))


def arrays_of(path):
    with array_files.opened(path) as file:
        return {name: file.array(name).read() for name in file.names()}


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_trains_on_its_exported_data_as_on_its_own(tmp_path, name):
    scene = made(tmp_path)
    done = subprocess.run([*PRDP, "export", scene.path, "--out", name], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and "55 trajectories of 3 states" in done.stdout, done.stderr
    arrays = arrays_of(tmp_path / name)
    assert arrays["tensor"].shape == (55, 3, 30) and sorted(arrays) == ["t-coordinate", "tensor", "x-coordinate"]
    assert np.array_equal(arrays["tensor"][:50, 2], _C.make_dataset(scene).train_end[:, 0].numpy())
    wanted = without_seconds(train(scene, Refinement.constant(5)))
    assert without_seconds(train(from_file(tmp_path, name), Refinement.constant(5))) == wanted


@pytest.mark.parametrize("write", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("convert", [np.asfortranarray, lambda a: a.astype(">f8"), lambda a: a.astype(np.longdouble)])
def test_an_npz_of_any_order_and_compression_is_read(tmp_path, write, convert):
    scene = from_file(tmp_path, "x.npz")
    states = torch.randn(60, 3, 1, 30)
    pdebench.write(tmp_path / "x.npz", states, scene)
    arrays = {name: convert(array) for name, array in arrays_of(tmp_path / "x.npz").items()}
    with open(tmp_path / "x.npz", "wb") as file:
        write(file, **arrays)
    assert torch.equal(pdebench.read(tmp_path / "x.npz", scene), states[:55])


@pytest.mark.parametrize("byte_order", [">f4", "<f4"])
def test_hdf5_of_either_byte_order_is_read(tmp_path, byte_order):
    scene = from_file(tmp_path, "x.h5")
    states = torch.randn(55, 3, 1, 30)
    pdebench.write(tmp_path / "x.h5", states, scene)
    with h5py.File(tmp_path / "x.h5", "a") as file:
        del file["tensor"]
        file["tensor"] = states[:, :, 0].numpy().astype(byte_order)
    assert torch.equal(pdebench.read(tmp_path / "x.h5", scene), states)


def replace(name, change):
    return lambda arrays: arrays.update({name: change(arrays[name])})


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "change, message",
    [
        (replace("t-coordinate", lambda t: t * 2), "the spacing of t-coordinate is 2, but physics.dt is 1"),
        (replace("x-coordinate", lambda x: x / 2), "the spacing of x-coordinate is 0.016129, but dx of the grid"),
        (replace("x-coordinate", np.square), "x-coordinate is not evenly spaced"),
        (replace("x-coordinate", lambda x: x[:7]), "x-coordinate has shape (7,), but tensor has 30 points there"),
        (replace("x-coordinate", lambda x: np.float64(1.0)), "x-coordinate must be an array, got a single number"),
        (replace("x-coordinate", lambda x: x.astype("S5")), "x-coordinate must hold floating-point numbers, got |S5"),
        (replace("tensor", lambda u: u[..., :20]), "the scene needs (samples, times, 30), which is x first"),
        (replace("tensor", lambda u: u[:40]), "has 40 trajectories; data.train + data.valid of the scene is 55"),
        (replace("tensor", lambda u: u.astype(int)), "tensor must hold floating-point numbers, got int64"),
        (replace("tensor", lambda u: u.astype(complex)), "tensor must hold floating-point numbers, got complex128"),
        (replace("tensor", lambda u: np.where(np.arange(55)[:, None, None] == 7, np.nan, u)), "trajectory 7 holds NaN"),
        (replace("tensor", lambda u: u[:, :0]), "t-coordinate has shape (3,), but tensor has 0 points there"),
        (lambda arrays: arrays.pop("t-coordinate"), "has no 't-coordinate'; it holds: tensor, x-coordinate"),
        (lambda arrays: arrays.clear(), "has no 'tensor'; it holds: nothing"),
    ],
)
def test_a_file_that_does_not_fit_the_scene_is_refused_in_words(tmp_path, name, change, message):
    path, scene = tmp_path / name, from_file(tmp_path, name)
    pdebench.write(path, torch.randn(55, 3, 1, 30), scene)
    arrays = arrays_of(path)
    change(arrays)
    array_files.write(path, arrays)
    with pytest.raises(ValueError) as error:
        datasets.of_scene(scene)
    assert message in str(error.value) and str(error.value).startswith(f"data: '{path}")


def as_group(file, name):
    del file[name]
    file.create_group(name)


def as_link(link):
    def change(file, name):
        del file[name]
        file[name] = link

    return change


def external(file, name):
    del file[name]
    file.create_dataset(name, (55, 3, 30), "f4", external=[("/etc/hostname", 0, 55 * 3 * 30 * 4)])


def virtual(file, name):
    del file[name]
    layout = h5py.VirtualLayout((55, 3, 30), "f4")
    layout[:] = h5py.VirtualSource("other.h5", "tensor", (55, 3, 30))
    file.create_virtual_dataset(name, layout)


def huge(file, name):
    del file[name]
    file.create_dataset(name, (55, 2**40, 30), "f4", chunks=(1, 8, 30))
    del file["t-coordinate"]
    file.create_dataset("t-coordinate", (2**40,), "f8", chunks=(8,))


@pytest.mark.parametrize("name", ["tensor", "x-coordinate"])
@pytest.mark.parametrize(
    "change, message",
    [
        (as_group, "is a group; the file must hold the numbers itself"),
        (
            as_link(h5py.ExternalLink("other.h5", "/tensor")),
            "is an external link; the file must hold the numbers",
        ),
        (as_link(h5py.SoftLink("/gone")), "is a link; the file must hold the numbers itself"),
        (as_link(np.dtype("f4")), "is a type; the file must hold the numbers itself"),
        (as_link(h5py.Empty("f4")), "is empty; the file must hold the numbers itself"),
        (external, "is kept in another file; the file must hold the numbers itself"),
        (virtual, "is kept in another file; the file must hold the numbers itself"),
        (huge, "would take "),  # the times, which are read first
    ],
    ids=["group", "external link", "soft link", "type", "empty", "external storage", "virtual", "huge"],
)
def test_what_is_no_data_set_of_hdf5_is_refused_in_words(tmp_path, name, change, message):
    if change is huge:
        name = "t-coordinate"
    path, scene = tmp_path / "x.h5", from_file(tmp_path, "x.h5")
    pdebench.write(path, torch.randn(55, 3, 1, 30), scene)
    pdebench.write(tmp_path / "other.h5", torch.randn(55, 3, 1, 30), scene)
    with h5py.File(path, "a") as file:
        change(file, "tensor" if change is huge else name)
    with pytest.raises(ValueError) as error:
        datasets.of_scene(scene)
    assert str(error.value).startswith(f"data: '{path}'") and f"{name} {message}" in str(error.value)


def zipped(**files):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, body in files.items():
            archive.writestr(name.replace("_", "."), body)
    return content.getvalue()


def npy(header):
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def pickled():
    content = io.BytesIO()
    np.savez(content, tensor=np.array([print, None], dtype=object))
    return content.getvalue()


@pytest.mark.parametrize(
    "content, message",
    [
        (b"", "File is not a zip file"),
        (b"no archive", "File is not a zip file"),
        (zipped(tensor_npy=b"no array"), "cannot read"),
        (zipped(tensor_npy=b"\x93NUMPY\x09\x00"), "cannot read"),
        (zipped(tensor_npy=npy("{'descr': '<f4', 'fortran_order': False, 'shape': (9, 9, 30)}")), "tensor has 0 bytes"),
        (zipped(tensor_npy=npy("{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 3, 30)}")), "impossible shape"),
        (zipped(tensor_npy=npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1e99,)}")), "cannot read"),
        (zipped(tensor_npy=npy("(" * 90)), "cannot read"),
        (pickled(), "tensor must hold floating-point numbers, got object"),
        (zipped(other_npy=b""), "has no 'tensor'; it holds: other"),
    ],
)
def test_what_is_no_npz_of_arrays_is_refused_in_words(tmp_path, content, message):
    (tmp_path / "x.npz").write_bytes(content)
    with pytest.raises(ValueError) as error:
        datasets.of_scene(from_file(tmp_path, "x.npz"))
    text = str(error.value)
    assert message in text and f"'{tmp_path}/x.npz'" in text and "\n" not in text


@pytest.mark.parametrize("name", NAMES)
def test_a_folder_in_place_of_a_file_is_refused_in_words(tmp_path, name):
    (tmp_path / name).mkdir()
    with pytest.raises(ValueError, match=f"data: cannot read '{tmp_path}/{name}': it is not a regular file"):
        datasets.of_scene(from_file(tmp_path, name))
    with pytest.raises(ValueError, match=f"cannot write '{tmp_path}/{name}': Is a directory"):
        datasets.export(made(tmp_path), tmp_path / name)


def test_an_export_sees_that_it_can_write_before_it_computes(tmp_path):
    (tmp_path / "file").touch()
    command = [*PRDP, "export", "navier_stokes", "--out", "file/x.npz"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and "--out: cannot write to 'file'" in done.stderr, done.stderr


@pytest.mark.parametrize("name, got", [("x.csv", "'.csv'"), ("x", "none")])
def test_an_export_into_another_format_is_refused_before_it_computes(tmp_path, name, got):
    done = CliRunner().invoke(cli.app, ["export", "navier_stokes", "--out", str(tmp_path / name)])
    words = f"prdp: data: '{tmp_path / name}' must end in .h5, .hdf5 or .npz, which tells the format; got {got}\n"
    assert (done.exit_code, done.stderr, list(tmp_path.iterdir())) == (2, words, [])


def test_a_single_array_is_no_file_of_trajectories(tmp_path):
    np.save(tmp_path / "x.npy", np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"x\.npy' holds one array without its grid; write an \.npz file"):
        datasets.of_scene(from_file(tmp_path, "x.npy"))


def test_npz_needs_no_h5py(tmp_path):
    code = "import sys; sys.modules['h5py'] = None; from prdp_torch.experiments.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", code, "export", "heat_1d", "--out", "x.npz"], cwd=tmp_path,
                          capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 0 and (tmp_path / "x.npz").exists(), done.stderr


@pytest.mark.parametrize("scene", ["poisson_1p", "darcy_emulator"])
def test_a_scene_without_trajectories_exports_none(scene, tmp_path):
    done = CliRunner().invoke(cli.app, ["export", scene, "--out", str(tmp_path / "x.npz")])
    assert done.exit_code == 2 and f"export: the scene {scene} has no trajectories" in done.stderr
    assert not list(tmp_path.iterdir())
