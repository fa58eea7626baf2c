"""Forged checkpoints and records, of both trainers. See forgeries.py."""

import contextlib
import shutil

import forge
import torch
from forgery import BEFORE, SMALL, TAKEN, CppForgery, Fault, Forgery, seal_record
from helpers import reseal, small_field, written
from trainings import without_seconds

import prdp_torch as prdp
from prdp_torch.experiments import compare, records, scenes
from prdp_torch.experiments.checkpoint import Checkpoint
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

INTERVALS = 6
OTHER_CURVES = "the training that went on from the checkpoint before has other curves"


def forge_checkpoints(kept, dice):
    """Write both files, the last one forged. Whether the one before is as it was; in a fifth of the cases it is not."""
    is_good = dice.random() < 0.8
    for path, content in kept.items():
        path.write_bytes(content)
        if path.suffix == ".checkpoint" or not is_good:
            reseal(path, forge.tensors_of(content.split(b"\n", 2)[2], dice))
    return is_good


class PythonCheckpoint(Forgery):
    """Of three tasks."""

    def make(self):
        self.tasks, self.environment = [], records.environment()
        paths = {
            "emulator": written(self.folder, SMALL, ("train = 200", "train = 50")),
            "parameters": written(self.folder, scene="poisson_1p", name="parameters"),
            "field": small_field(self.folder),
        }
        for name, path in paths.items():
            scene = scenes.load(path)
            scene.training.intervals = INTERVALS
            refinement = Refinement.auto() if name == "field" else Refinement.prdp(scene)
            alone = without_seconds(train(scene, refinement))
            out = self.folder / name
            with contextlib.suppress(KeyboardInterrupt):
                self._run(scene, refinement, out, False, [self._stop])
            kept = [out / refinement.label / f"seed_0.checkpoint{end}" for end in ("", ".before")]
            self.tasks.append((scene, refinement, out, alone, {path: path.read_bytes() for path in kept}))

    @staticmethod
    def _stop(interval):
        if interval.number == INTERVALS - 1:
            raise KeyboardInterrupt

    def _run(self, scene, refinement, out, resume, callbacks=()):
        return compare.run_one(scene, refinement.label, refinement, 0, out, self.environment, resume, callbacks)

    def forge(self, dice):
        *self.task, kept = dice.choice(self.tasks)
        shutil.rmtree(self.task[2])
        (self.task[2] / self.task[1].label).mkdir(parents=True)
        self.before_is_good = forge_checkpoints(kept, dice)

    def read(self):
        scene, refinement, out, _ = self.task
        return self._run(scene, refinement, out, True)

    def check_before(self, result):
        if self.before_is_good and without_seconds(result) != self.task[3]:
            raise Fault(OTHER_CURVES)


class CppCheckpoint(CppForgery):
    intervals = INTERVALS

    def make(self):
        super().make()
        assert self.run(self.folder / "alone").returncode == 0
        self.out = self.folder / "out"
        # What a training of as many intervals leaves behind where it cannot write its record.
        (self.out / "prdp/seed_0.json").mkdir(parents=True)
        assert self.run(self.out).returncode == 2
        self.kept = {path: path.read_bytes() for path in (self.out / "prdp").glob("seed_0.checkpoint*")}
        assert len(self.kept) == 2

    def try_one(self, dice):
        shutil.rmtree(self.out)
        (self.out / "prdp").mkdir(parents=True)
        before_is_good = forge_checkpoints(self.kept, dice)
        done = self.run(self.out, "--resume")
        outcome = self.outcome(done)
        if outcome != TAKEN or "goes on from the one before" not in done.stderr:
            return outcome
        if before_is_good and self._curves("out") != self._curves("alone"):
            raise Fault(OTHER_CURVES)
        return BEFORE

    def _curves(self, folder):
        return without_seconds(records.read_training(self.folder / folder / "prdp/seed_0.json")["curves"])


def forge_record(path, content, dice):
    if dice.random() < 0.1:
        text = forge.bytes_of(content.encode(), dice).decode("utf-8", "replace")
    else:
        text = forge.json_of(content, dice)
    path.write_text(seal_record(text), errors="surrogatepass")


class PythonRecord(Forgery):
    """Read by --resume, and by load_trained."""

    def make(self):
        self.scene = scenes.load(written(self.folder, SMALL))
        self.scene.training.intervals = 2
        refinement = Refinement.prdp(self.scene)
        compare.run_one(self.scene, "prdp", refinement, 0, self.folder, records.environment())
        self.record = self.folder / "prdp/seed_0.json"
        self.content = self.record.read_text()

    def forge(self, dice):
        forge_record(self.record, self.content, dice)

    def read(self):
        checkpoint = Checkpoint(self.record.with_suffix(".checkpoint"))
        compare._finished(self.record, self.scene, checkpoint)
        prdp.load_trained(self.folder / "prdp").rollout(torch.zeros(1, 1, 30), 2)


class CppRecord(CppForgery):
    def make(self):
        super().make()
        self.record = self.folder / "prdp/seed_0.json"
        assert self.run(self.folder).returncode == 0
        self.content = self.record.read_text()

    def try_one(self, dice):
        forge_record(self.record, self.content, dice)
        return self.outcome(self.run(self.folder, "--resume"))
