"""Records: what a training was, what it cost and what it reached, as JSON."""

import json
import math
import os
import pickle
import platform
import subprocess
import sys
from pathlib import Path

import torch

from prdp_torch import _C


def environment():
    """Versions, machine and commit, as far as they can be found out."""
    return {
        "versions": {"prdp_torch": _C.VERSION, "torch": torch.__version__, "python": platform.python_version()},
        "machine": {"processor": _processor(), "cores": os.cpu_count(), "threads": torch.get_num_threads()},
        "commit": _commit(),
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    }


def _processor():
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _commit():
    folder = Path(__file__).resolve().parent
    try:
        answer = subprocess.run(
            ["git", "-C", folder, "describe", "--always", "--dirty", "--abbrev=12"],
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return answer.stdout.strip()


def settings(scene):
    """What a record must agree on to be of the same training: the scene as it ran."""
    return {
        "scene": scene.name,
        "text": scene.text,
        "backward": scene.backward,
        "intervals": scene.training.intervals,
    }


def write(path, content):
    """Write JSON (or text) whole or not at all: beside its place, then moved there. NaN is null."""
    path = Path(path)
    text = content if isinstance(content, str) else json.dumps(_null_for_nan(content), indent=1, allow_nan=False)
    unfinished = path.with_name(path.name + ".part")
    unfinished.write_text(text + "\n")
    unfinished.replace(path)


def write_weights(path, network):
    """Write the network's `state_dict` whole or not at all."""
    unfinished = path.with_name(path.name + ".part")
    torch.save(network.state_dict(), unfinished)
    unfinished.replace(path)


def read_weights(path, network):
    """Load what `write_weights` wrote into a network of the same make. ValueError if the file does not fit."""
    try:
        network.load_state_dict(torch.load(path, weights_only=True))
    except (RuntimeError, EOFError, pickle.UnpicklingError):
        raise ValueError(
            f"weights: '{path}' is damaged or of another network; delete it, and its pictures are left out"
        ) from None
    return network


def read(path):
    """A record. ValueError, naming it, for a damaged one."""
    try:
        return json.loads(Path(path).read_text())
    except ValueError:
        message = f"record: '{path}' is damaged; delete it, and its training is run again"
        raise ValueError(message) from None


def _null_for_nan(content):
    if isinstance(content, dict):
        return {name: _null_for_nan(value) for name, value in content.items()}
    if isinstance(content, list):
        return [_null_for_nan(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def prepare_folder(path):
    """Make the folder and see that it can be written to, before any work. ValueError if not."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"--out: cannot write to '{path}': {error.strerror}") from None
    return path
