"""What forged files of every kind have in common. See forgeries.py."""

import os
import subprocess
import warnings
from pathlib import Path

from helpers import written

from prdp_torch.experiments import _C

TRAINER = Path(__file__).parents[2] / "build" / "prdp_train"
REFUSED, BEFORE, TAKEN = "refused", "the one before", "taken"
SETTINGS = {"PRDP_CHECKPOINT_SECONDS": "0", "OMP_NUM_THREADS": "1"}
SMALL = ("hidden = [64, 64, 64]", "hidden = [8]")


class Fault(AssertionError):
    """What a reader must not do."""


def seal_record(text):
    """With the fingerprint of what it has become; as it is where it is no object of JSON any more."""
    body = text.rsplit(',\n "fingerprint"', 1)[0]
    return _C.seal_record(body + "\n}") if "{" in body else text


def checked_message(message, folder):
    if "\n" in message or str(folder) not in message:
        raise Fault(f"not one sentence that names the file: {message!r}")
    return REFUSED


class Forgery:
    """Files of one kind, in a folder."""

    def __init__(self, folder):
        self.folder = folder
        folder.mkdir()
        self.make()

    def try_one(self, dice):
        """Forge, read and say what came of it."""
        self.forge(dice)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            try:
                result = self.read()
            except ValueError as error:
                return checked_message(str(error), self.folder)
        if any("goes on from the one before" in str(warning.message) for warning in said):
            self.check_before(result)
            return BEFORE
        return TAKEN


class CppForgery(Forgery):
    """Read by `prdp_train`."""

    intervals = 1

    def make(self):
        self.scene = written(self.folder, SMALL, ("train = 200", "train = 50"))

    def run(self, out, *more):
        command = [TRAINER, self.scene, "--out", out, "--intervals", str(self.intervals), "--prdp", *more]
        environment = {**os.environ, **SETTINGS}
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)

    def outcome(self, done):
        """Refused or taken; a training may have diverged."""
        if done.returncode == 2:
            lines = done.stderr.splitlines()
            if lines and lines[0].startswith("prdp_train: replaces when it ends: "):  # an earlier record
                lines.pop(0)
            return checked_message("\n".join(lines), self.folder)
        if done.returncode not in (0, 1):
            raise Fault(f"exit status {done.returncode}: {done.stderr}")
        return TAKEN
