"""Forged weights, cached data and files of trajectories. See forgeries.py."""

import os

import forge
import h5py
import numpy as np
import torch
from forged_trainings import PythonRecord
from forgery import CppForgery, Forgery, seal_record
from helpers import reseal, tiny, written

import prdp_torch as prdp
from prdp_torch.experiments import _C, pdebench, scenes


class Weights(PythonRecord):
    """Read by load_trained, with a record that holds their fingerprint."""

    def make(self):
        super().make()
        self.path = self.record.with_suffix(".pt")
        self.weights = self.path.read_bytes()

    def forge(self, dice):
        forged = forge.tensors_of(self.weights, dice)
        self.path.write_bytes(forged)
        known = _C.fingerprint(self.weights), _C.fingerprint(forged)
        self.record.write_text(seal_record(self.content.replace(*known)))

    def read(self):
        prdp.load_trained(self.folder / "prdp").rollout(torch.zeros(1, 1, 30), 2)


class CppWeights(CppForgery):
    """Given to `prdp_train` to begin with."""

    def make(self):
        super().make()
        assert self.run(self.folder).returncode == 0
        self.content = (self.folder / "prdp/seed_0.pt").read_bytes()

    def try_one(self, dice):
        path = self.folder / "forged.pt"
        path.write_bytes(forge.tensors_of(self.content, dice))
        return self.outcome(self.run(self.folder, "--weights", path))


class Cache(Forgery):
    """The data of a corrector."""

    def make(self):
        os.environ["PRDP_CACHE"] = str(self.folder / "cache")
        self.scene = scenes.load(tiny(self.folder))
        _C.make_dataset(self.scene)
        (self.path,) = (self.folder / "cache").iterdir()
        self.content = self.path.read_bytes()

    def forge(self, dice):
        self.path.write_bytes(self.content)
        reseal(self.path, forge.tensors_of(self.content.split(b"\n", 2)[2], dice))

    def read(self):
        os.environ["PRDP_CACHE"] = str(self.folder / "cache")
        _C.make_dataset(self.scene)


class Data(Forgery):
    """A file of trajectories."""

    name = None

    def make(self):
        self.scene = scenes.load(written(self.folder, ("train = 200", "train = 6"), ("shape = [30]", "shape = [12]")))
        self.path = self.folder / self.name
        states = torch.randn(11, 3, 1, 12, generator=torch.Generator().manual_seed(0))
        pdebench.write(self.path, states, self.scene)
        self.content = self.path.read_bytes()

    def read(self):
        pdebench.read(self.path, self.scene)

    def forge(self, dice):
        self.path.write_bytes(self.content)
        if dice.random() < 0.5:
            self.path.write_bytes(forge.bytes_of(self.content, dice))
        else:
            self.change(dice.choice(("tensor", "x-coordinate", "t-coordinate")), dice)

    @staticmethod
    def strange(array, dice):
        """In place of an array."""
        return dice.choice(
            (
                lambda: array[:-1], lambda: array[None], lambda: array[..., :0], lambda: array.astype(np.int64),
                lambda: array.astype(">f4"), lambda: array.astype(np.float16), lambda: array.astype(np.longdouble),
                lambda: array.astype(complex), lambda: array.astype("S3"), lambda: np.float32(1.0),
                lambda: array * np.nan, lambda: array * 2, lambda: -array, lambda: np.zeros((0,)),
                lambda: np.asfortranarray(array),
                lambda: array.astype([("a", "f4"), ("b", "f8")]),
            )
        )()  # fmt: skip


class Hdf5(Data):
    name = "x.h5"

    def change(self, name, dice):
        with h5py.File(self.path, "a") as file:
            array = file.pop(name)[...]
            how = dice.randrange(9)
            if how == 0:
                file.create_group(name)
            elif how == 1:
                file[name] = h5py.ExternalLink(dice.choice(("gone.h5", "x.h5", "/etc/passwd")), "/tensor")
            elif how == 2:
                file[name] = h5py.SoftLink(dice.choice(("/gone", f"/{name}", "/")))
            elif how == 3:
                file[name] = h5py.Empty("f")
            elif how == 4:
                huge = dice.choice(((2**40, 3, 12), (11, 2**40, 12), (2**62,)))
                file.create_dataset(name, huge, "f4", chunks=tuple(min(n, 8) for n in huge))
            elif how == 5:
                file.create_dataset(name, (11,), h5py.string_dtype())
            elif how == 6:
                file[name] = np.dtype("f4")
            elif how == 7:
                file.create_dataset(name, (11, 3, 12), "f4", external=[("/etc/passwd", 0, 11 * 3 * 12 * 4)])
            else:
                file[name] = self.strange(array, dice)


class Npz(Data):
    name = "x.npz"

    def forge(self, dice):
        super().forge(dice)
        if dice.random() < 0.3:
            self.path.write_bytes(forge.archive_of(self.content, dice))

    def change(self, name, dice):
        with np.load(self.path) as file:
            arrays = dict(file)
        how = dice.randrange(5)
        if how == 0:
            del arrays[name]
        elif how == 1:
            arrays[name] = np.array([{}, None], dtype=object)
        else:
            arrays[name] = self.strange(arrays[name], dice)
        (np.savez_compressed if how == 2 else np.savez)(self.path, **arrays)
