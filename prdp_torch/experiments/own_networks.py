"""Networks of a user's own, which a scene names as `network = "module:Class"`."""

import contextlib
import importlib
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import torch

from prdp_torch.experiments import _C


def make(scene: _C.Scene, seed: int) -> torch.nn.Module:
    """Make the network of a scene: `Class()`, with the random numbers of the seed. ValueError, in words, if its module
    cannot be imported or the class is no `torch.nn.Module` that is made without arguments."""
    cls = _class_of(scene)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        try:
            network = _in_dtype(cls(), scene.dtype)
        except Exception as error:
            raise _refused(scene, f"{cls.__name__}() raised {type(error).__name__}: {error}") from error
    if any(torch.nn.parameter.is_lazy(t) for t in (*network.parameters(), *network.buffers())):
        raise _refused(
            scene, f"{cls.__name__}() has lazy layers, whose sizes are not known when weights are read; give them"
        )
    return network


def fingerprint(scene: _C.Scene) -> str:
    """What tells the source of the class from another one."""
    return _C.fingerprint(_source(scene).read_bytes())  # type: ignore[arg-type]  # it takes bytes


def warn_if_changed(scene: _C.Scene, known: str | None) -> None:
    """Warn if the source of the class is not that of the training."""
    if fingerprint(scene) != known:
        warnings.warn(f"network: '{_source(scene)}' has changed since the training", stacklevel=3)


def _in_dtype(network: torch.nn.Module, dtype: torch.dtype) -> torch.nn.Module:
    """Its real numbers in this dtype, its complex ones in the complex dtype of the same precision, which
    `network.to(dtype)` would make real."""
    network = network.double() if dtype == torch.float64 else network.float()
    for t in (*network.parameters(), *network.buffers()):
        if t.is_complex():
            t.data = t.data.to(dtype.to_complex())
    return network


def _class_of(scene: _C.Scene) -> type[torch.nn.Module]:
    name = scene.network.python.partition(":")[2]
    found = getattr(_module(scene), name, None)
    if not isinstance(found, type) or not issubclass(found, torch.nn.Module):
        what = "no such name" if found is None else "no subclass of torch.nn.Module"
        raise _refused(scene, f"'{_source(scene)}' has {what}, {name}")
    return found


def _module(scene: _C.Scene) -> ModuleType:
    """The module, from the folder of the scene or from where Python looks otherwise."""
    name = scene.network.python.partition(":")[0]
    folder = Path(scene.path).resolve().parent
    importlib.invalidate_caches()  # it may have been written just now
    with _first_on_the_path(folder):
        try:
            module = importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{name}.".startswith(f"{error.name}."):
                raise _refused(scene, f"its module raised {error}") from error
            raise _refused(scene, f"there is no module '{name}' in '{folder}', nor where Python looks") from None
        except Exception as error:
            raise _refused(scene, f"its module raised {type(error).__name__}: {error}") from error
    beside = folder.joinpath(*name.split(".")).with_suffix(".py")
    if beside.is_file() and Path(module.__file__ or "").resolve() != beside:
        raise _refused(scene, f"another module '{name}' is imported already, '{module.__file__}'; rename one of them")
    return module


def _source(scene: _C.Scene) -> Path:
    path = getattr(_module(scene), "__file__", None)
    if path is None:
        raise _refused(scene, "its module has no file")
    return Path(path)


@contextlib.contextmanager
def _first_on_the_path(folder: Path) -> Iterator[None]:
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))


def _refused(scene: _C.Scene, what: str) -> ValueError:
    return ValueError(f"network: '{scene.network.python}' of the scene '{scene.path}': {what}")
