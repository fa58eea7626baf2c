"""What a network is trained on: data that the scene makes, a file of trajectories, or your own tensors."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, cast

import torch
from torch import Tensor

from prdp_torch._C import sentence
from prdp_torch.advice_text import dtype_name
from prdp_torch.experiments import _C, array_files, pdebench

OnData: TypeAlias = Callable[[int, int], None]
"""Called with (steps done, all steps)."""

Own: TypeAlias = Any
"""Trajectories: a tensor, whatever `torch.as_tensor` takes, a dataset, or a pair of them."""


class Data(NamedTuple):
    """Training and validation states; each (samples, channels, *shape)."""

    train_start: Tensor
    train_between: Tensor
    """(samples, trained_steps - 1, channels, *shape): the steps between."""
    train_end: Tensor
    """`data.trained_steps` steps later."""
    valid_start: Tensor
    valid_end: Tensor
    """`data.valid_steps` steps later."""


def of_scene(scene: _C.Scene, own: Own = None, on_data: OnData | None = None) -> "Data | _C.Dataset":
    """The data of a training, on the device of the scene.

    Args:
        scene: from `prdp_torch.experiments.scenes.load`.
        own: trajectories in place of the scene's: a tensor, an array or a dataset of trajectories, whose first
            `data.train` train and whose next `data.valid` validate; or a pair of them, for training and validation.
            Every state of a training trajectory that two more follow is a start.
        on_data: as in `training.train`.

    Raises ValueError or TypeError, in words, if the trajectories do not fit the scene.
    """
    if own is None and not scene.data.file:
        return _C.make_dataset(scene, on_data)  # type: ignore[arg-type]  # it takes None
    if scene.data.fresh:
        raise ValueError("train: a scene with data.fresh makes its own data in every epoch; it takes no others")
    if own is None:
        own = pdebench.read(path_of(scene), scene)
    pair = own if isinstance(own, (tuple, list)) else _split(scene, _tensor(scene, "data", own))
    if len(pair) != 2:
        raise ValueError(f"train: data must be trajectories, or a pair (training, validation), got {len(pair)} of them")
    train, valid = (_tensor(scene, name, part) for name, part in zip(("data[0]", "data[1]"), pair, strict=True))
    steps = scene.data.trained_steps
    _check_times("training", train, steps)
    _check_times("validation", valid, scene.data.valid_steps)
    starts, *between, end = (train[:, n : train.shape[1] - steps + n].flatten(0, 1) for n in range(steps + 1))
    valid_start, valid_end = (valid[:, n].contiguous() for n in (0, scene.data.valid_steps))
    _check_scale(scene, "validation", valid_end, 1, scene.data.valid_steps)
    if scene.training.loss == "nmse":
        _check_scale(scene, "training", end, train.shape[1] - steps, steps)
    parts = starts, torch.stack(between, 1), end, valid_start, valid_end
    return Data(*(part.to(scene.device) for part in parts))


def reference(scene: _C.Scene, steps: int, on_data: OnData | None = None) -> Tensor:
    """Validation trajectories of `steps` steps, or of as many as the scene's file has, on the device of the scene:
    (samples, steps + 1, channels, *shape)."""
    if not scene.data.file:
        made = _C.validation_trajectories(scene, steps, on_data)  # type: ignore[arg-type]  # it takes None
    else:
        made = pdebench.read(path_of(scene), scene)[scene.data.train :, : steps + 1]
    return made.to(scene.device)


def export(
    scene: _C.Scene, path: str | Path, steps: int | None = None, on_data: OnData | None = None
) -> tuple[int, ...]:
    """Write the trajectories of a scene to a file that `[data] file` reads, HDF5 or .npz. Returns their shape.

    Args:
        scene: a scene that trains a network and makes its own data.
        path: of the file, .h5, .hdf5 or .npz, in PDEBench's layout (`prdp_torch.experiments.pdebench`).
        steps: how many steps each has; by default what the training and the validation metric need.
    """
    array_files.check_name(path)  # before any work
    steps = max(scene.data.trained_steps, scene.data.valid_steps) if steps is None else steps
    trajectories = _C.all_trajectories(scene, steps, on_data)  # type: ignore[arg-type]  # it takes None
    pdebench.write(path, trajectories, scene)
    return tuple(trajectories.shape)


def path_of(scene: _C.Scene) -> Path:
    """The file of a scene's data, which is relative to the scene's own."""
    return Path(scene.path).parent / scene.data.file


def fingerprint(scene: _C.Scene) -> str:
    """What tells the file of a scene's data from another one: its size and the bytes at both ends."""
    path = path_of(scene)
    try:
        with open(path, "rb") as file:
            head = file.read(2**20)
            size = file.seek(0, 2)
            file.seek(max(0, size - 2**20))
            content = head + file.read() + str(size).encode()
            return _C.fingerprint(content)  # type: ignore[arg-type]  # it takes bytes
    except OSError as error:
        raise ValueError(f"data: cannot read '{path}': {error.strerror}") from None


@contextlib.contextmanager
def evaluating(network: object) -> Iterator[None]:
    """A network, or any function, in evaluation mode and without gradients: running means stay as they are. Then every
    module is in its mode again."""
    modes = [(m, m.training) for m in network.modules()] if isinstance(network, torch.nn.Module) else []
    try:
        for module, _ in modes:
            module.training = False
        with torch.no_grad():
            yield
    finally:
        for module, mode in modes:
            module.training = mode


def check_network(scene: _C.Scene, network: object, states: Tensor) -> None:
    """Raise TypeError or ValueError unless the network takes states of the scene to states, and can be trained."""
    if not isinstance(network, torch.nn.Module):
        raise TypeError(f"train: network must be a torch.nn.Module, got {type(network).__name__}")
    trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
    if not trained:
        raise ValueError("train: network has no parameters that require a gradient")
    wanted = {False: scene.dtype, True: scene.dtype.to_complex()}
    other = {p.dtype for p in trained if p.dtype != wanted[p.is_complex()]}
    if other:
        has_complex = any(dtype.is_complex for dtype in other)
        raise ValueError(
            f"train: the scene computes in {dtype_name(scene.dtype)}, but network has parameters in "
            f"{', '.join(sorted(map(dtype_name, other)))}; "
            + (
                f"make its complex ones {dtype_name(wanted[True])}"
                if has_complex
                else f"call network.to({scene.dtype})"
            )
        )
    before = states.clone()
    try:
        with evaluating(network), torch.random.fork_rng(devices=[]):
            answer = network(states)
    except RuntimeError as error:
        raise ValueError(f"train: network fails on states {tuple(states.shape)}: {sentence(str(error))}") from error
    if not isinstance(answer, torch.Tensor) or answer.shape != states.shape:
        got = tuple(answer.shape) if isinstance(answer, torch.Tensor) else type(answer).__name__
        raise ValueError(f"train: network must keep the shape of its input, {tuple(states.shape)}, got {got}")
    if answer.dtype != states.dtype:
        raise ValueError(f"train: network must keep the dtype of its input, {states.dtype}, got {answer.dtype}")
    if not states.equal(before):
        states.copy_(before)
        raise ValueError(
            "train: network changes its input in place, as a first layer with inplace=True does; it must leave it as "
            "it is"
        )


def _split(scene: _C.Scene, trajectories: Tensor) -> tuple[Tensor, Tensor]:
    """Training and validation trajectories, by the numbers of the scene."""
    train, valid = scene.data.train, scene.data.valid
    if len(trajectories) < train + valid:
        raise ValueError(
            f"train: data has {len(trajectories)} trajectories; data.train + data.valid of the scene is "
            f"{train + valid}; a pair (training, validation) may have any number"
        )
    return trajectories[:train], trajectories[train : train + valid]


def _tensor(scene: _C.Scene, name: str, own: Own) -> Tensor:
    """Trajectories as a tensor of the scene's dtype, checked."""
    if isinstance(own, torch.utils.data.Dataset):
        items: list[Any] = [own[i] for i in range(len(own))]  # type: ignore[arg-type]  # it has a length
        alone = [item[0] if isinstance(item, (tuple, list)) and len(item) == 1 else item for item in items]
        own = torch.stack(cast(list[Tensor], alone))
    try:
        found: Tensor = torch.as_tensor(own)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"train: {name} must be trajectories as a tensor, got {type(own).__name__}") from None
    shape = (scene.physics.channels, *scene.physics.shape)
    if found.dim() != 2 + len(shape) or found.shape[2:] != shape or found.numel() == 0:
        wanted = ", ".join(map(str, shape))
        raise ValueError(f"train: {name} must have shape (samples, times, {wanted}), got {tuple(found.shape)}")
    if not found.is_floating_point():
        raise TypeError(f"train: {name} must hold floating-point numbers, got {found.dtype}")
    found = found.detach().to("cpu", scene.dtype)
    pdebench.check_finite(f"train: {name}", found)
    return found


def _check_scale(scene: _C.Scene, what: str, states: Tensor, per_trajectory: int, steps: int) -> None:
    """ValueError for a state of zeros, which errors would be divided by."""
    of = slice(0, 1) if scene.task == "corrector" and what == "validation" else slice(None)
    zeros = (states[:, of] == 0).flatten(1).all(1).nonzero().flatten()
    if len(zeros):
        number = int(zeros[0]) // per_trajectory
        raise ValueError(f"train: {what} trajectory {number} is zero after {steps} steps; errors are relative to it")


def _check_times(what: str, trajectories: Tensor, steps: int) -> None:
    if trajectories.shape[1] <= steps:
        raise ValueError(
            f"train: {what} trajectories need {steps + 1} times, for {steps} steps, but the data have "
            f"{trajectories.shape[1]}"
        )
