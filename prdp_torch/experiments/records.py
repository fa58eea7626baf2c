"""Records: what a training was, what it cost and what it reached, as JSON."""

import contextlib
import io
import json
import math
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from prdp_torch import data_parallel
from prdp_torch._C import VERSION
from prdp_torch.experiments import _C, datasets, own_networks


def environment(device: torch.device | None = None) -> dict[str, Any]:
    """Versions, machine and commit, as far as they can be found out; `device` is that of a training."""
    return {
        "versions": {"prdp_torch": VERSION, "torch": torch.__version__, "python": platform.python_version()},
        "machine": {
            "processor": _processor(),
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "processes": data_parallel.count(),
            **({} if device is None else _of_device(device)),
        },
        "commit": _commit(),
        "command": " ".join([_program(), *sys.argv[1:]]),
    }


def _of_device(device: torch.device) -> dict[str, str]:
    card = {"gpu": torch.cuda.get_device_name(device)} if device.type == "cuda" else {}
    return {"device": str(device), **card}


def _program() -> str:
    """As it was called: a command, a script, or python -m and a module."""
    module = getattr(sys.modules["__main__"], "__spec__", None)
    return f"python -m {module.name.removesuffix('.__main__')}" if module else Path(sys.argv[0]).name


def _processor() -> str:
    """With family and model where Linux knows them: the name alone is often the same for several generations."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().split("\n\n")[0].splitlines() if info.exists() else []
    of_first = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    if "model name" not in of_first:
        return platform.processor() or platform.machine()
    numbers = [f"{key.split()[-1]} {of_first[key]}" for key in ("cpu family", "model") if key in of_first]
    return ", ".join([of_first["model name"], *numbers])


def _commit() -> str | None:
    folder = Path(__file__).resolve().parent
    try:
        answer = subprocess.run(
            ["git", "--no-optional-locks", "-C", folder, "describe", "--always", "--dirty", "--abbrev=12"],
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return answer.stdout.strip()


def identity(scene: _C.Scene) -> dict[str, str]:
    """What a training must agree on to be the same one, however many intervals it goes on for."""
    same = {"scene": scene.name, "text": scene.text, "backward": scene.backward}
    if scene.data.file:
        same["data"] = datasets.fingerprint(scene)
    if scene.network.python:
        same["network"] = own_networks.fingerprint(scene)
    return same


def settings(scene: _C.Scene) -> dict[str, Any]:
    """The scene as it ran."""
    return {**identity(scene), "intervals": scene.training.intervals}


@contextlib.contextmanager
def alone_in(folders: Sequence[Path]) -> Iterator[None]:
    """Make the folders, and keep other trainings out of them meanwhile. ValueError if one is there already. Of several
    processes that train together, the first one does so."""
    locks = []
    try:
        for folder in folders if data_parallel.is_first() else ():
            folder.mkdir(parents=True, exist_ok=True)
            locks.append(_C.FolderLock(folder))
        yield
    finally:
        for lock in locks:
            lock.release()


def write(path: Path, content: str | dict[str, Any]) -> None:
    """Write JSON (or text) whole or not at all. NaN is null. ValueError if it cannot be written."""
    text = content if isinstance(content, str) else _json(content)
    _C.write_whole(path, text + "\n")


def write_training(path: Path, record: dict[str, Any], network: torch.nn.Module | None = None) -> None:
    """Write the record of a training, and the `state_dict` of what it trained beside it, on the CPU: both,
    each whole, or neither. The record holds the weights' fingerprint. ValueError if they cannot be written; an earlier
    record is then still there, with its weights. Of several processes the first one writes."""
    if not data_parallel.is_first():
        return
    weights = b""
    if network is not None:
        content = io.BytesIO()
        state = network.state_dict()
        for name, value in state.items():
            state[name] = value.cpu()
        torch.save(state, content)
        weights = content.getvalue()
        fingerprint = _C.fingerprint(weights)  # type: ignore[arg-type]  # it takes bytes
        record = {**record, "weights": fingerprint}
    _C.write_training(path, _json(record), weights)  # type: ignore[arg-type]  # it takes bytes


def read(path: Path) -> Any:
    """What `write_training` wrote; None where there is no file. ValueError, naming it, for one that is damaged."""
    text = _C.read_record(path)
    return None if text is None else json.loads(text)


def read_training(path: Path) -> dict[str, Any] | None:
    """The record of a training, with NaN in its curves where they hold it; None where there is no file. ValueError,
    naming the file and what is wrong, for any other file: every key, type, range and length is checked."""
    text = _C.read_training(path)
    if text is None:
        return None
    record: dict[str, Any] = json.loads(text)
    for name in ("metric", "error"):
        record["curves"][name] = [math.nan if value is None else value for value in record["curves"][name]]
    return record


def scene_of(path: Path, record: dict[str, Any]) -> _C.Scene:
    """The scene of a training as it ran, from its record at `path`. ValueError, naming the record, if it is none."""
    settings = record["settings"]
    try:
        name = f"{settings['scene']}.toml"
        scene = _C.parse_scene(settings["text"], str(Path(record["folder"], name)) if "folder" in record else name)
        scene.backward, scene.training.intervals = settings["backward"], settings["intervals"]
    except ValueError as error:
        raise ValueError(
            f"record: '{path}' holds no scene that can be read: {error}; delete it, and its training is run again"
        ) from None
    return scene


def weights_of(path: Path) -> Path:
    """Where the weights of a record lie."""
    return path.with_suffix(".pt")


def read_weights(path: Path, network: torch.nn.Module, record: dict[str, Any] | None = None) -> torch.nn.Module | None:
    """Load the weights that belong to the record at `path` into a network of the same make, and return it in
    evaluation mode. None if the record or its weights are not there, ValueError if the weights are not those of the
    record, or of another network."""
    record = read_training(path) if record is None else record
    content = None if record is None else _C.read_weights(path, record.get("weights", ""))
    if content is None:
        return None
    try:
        saved = _C.Saved(content)  # type: ignore[arg-type]  # it takes bytes
        parameters = dict(network.named_parameters())
        network.load_state_dict(
            {name: saved.take(name, value, finite=name in parameters) for name, value in network.state_dict().items()},
            assign=any(parameter.is_meta for parameter in parameters.values()),
        )
        saved.finish()
    except ValueError as error:
        raise ValueError(
            f"weights: '{weights_of(path)}' is not of the network of the record beside it: {error}; delete both, and "
            "the training is run again"
        ) from None
    return network.eval()


def _json(content: object) -> str:
    return json.dumps(_null_for_nan(content), indent=1, allow_nan=False)


def _null_for_nan(content: object) -> object:
    if isinstance(content, dict):
        return {name: _null_for_nan(value) for name, value in content.items()}
    if isinstance(content, list):
        return [_null_for_nan(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def prepare_folder(path: str | Path) -> Path:
    """Make the folder and see that it can be written to, before any work. ValueError if not."""
    path = Path(path)
    if not data_parallel.is_first():
        return path
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"--out: cannot write to '{path}': {error.strerror}") from None
    return path
