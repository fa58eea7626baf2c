"""Trajectories in files of PDEBench's layout (Takamoto et al. 2022), HDF5 or .npz.

`tensor` is (samples, times, X), (samples, times, X, Y) or (samples, times, X, Y, Z), with the channels as a last axis
where there are several. `x-coordinate`, `y-coordinate`, `z-coordinate` and `t-coordinate` are vectors. In the library
the same fields are (samples, times, channels, *shape), and x is the last axis of `shape`.
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from prdp_torch.advice_text import dtype_name
from prdp_torch.experiments import _C, array_files

_AXES = ("x", "y", "z")
_SPACING = 1e-3  # relative; float32 coordinates are that exact


def write(path: str | Path, trajectories: Tensor, scene: _C.Scene) -> None:
    """Write trajectories (samples, times, channels, *shape) of a scene: as .npz or HDF5 (.h5, .hdf5), as the path
    ends. The file is written whole or not at all. Raises ValueError if it cannot be written or ends otherwise, and
    ImportError without the package h5py."""
    dim = len(scene.physics.shape)
    spatial = range(2 + dim, 2, -1)
    tensor = trajectories.permute(0, 1, *spatial, 2).numpy()
    arrays = {"tensor": tensor[..., 0] if tensor.shape[-1] == 1 else tensor}
    for name, axis in zip(_AXES, reversed(range(dim)), strict=False):
        arrays[f"{name}-coordinate"] = _points(*_grid(scene, axis), scene.physics.shape[axis])
    arrays["t-coordinate"] = _points(0.0, scene.physics.dt or 1.0, trajectories.shape[1])
    array_files.write(path, arrays)


def read(path: str | Path, scene: _C.Scene) -> Tensor:
    """Read the first `data.train` + `data.valid` trajectories for a scene: (samples, times, channels, *shape) in the
    scene's dtype.

    Raises:
        ValueError: the file is damaged or does not fit the scene. Its grid, its number of samples and times, its
            spacings dx and dt, and that its values are finite are all checked; the message names the mismatch.
        ImportError: the package h5py is missing.
    """
    wanted, dim = scene.data.train + scene.data.valid, len(scene.physics.shape)
    with array_files.opened(path) as file:
        tensor = file.array("tensor")
        with_channels = _check_shape(path, scene, tensor)
        if tensor.shape[0] < wanted:
            raise ValueError(
                f"data: '{path}' has {tensor.shape[0]} trajectories; data.train + data.valid of the scene is {wanted}"
            )
        for name, axis in zip(_AXES, reversed(range(dim)), strict=False):
            n = scene.physics.shape[axis]
            _check_spacing(path, file, name, n, _grid(scene, axis)[1], f"dx of the grid of {n} unknowns")
        if scene.physics.dt:
            _check_spacing(path, file, "t", tensor.shape[1], scene.physics.dt, "physics.dt")
        content = torch.from_numpy(tensor.read(wanted))
    if not with_channels:
        content = content[..., None]
    content = content.permute(0, 1, content.dim() - 1, *range(1 + dim, 1, -1)).to(scene.dtype)
    check_finite(f"data: '{path}'", content)
    return content.contiguous()


def check_finite(who: str, trajectories: Tensor) -> None:
    """ValueError for a trajectory with NaN or Inf."""
    bad = (~trajectories.isfinite().flatten(1).all(1)).nonzero().flatten()
    if len(bad):
        raise ValueError(f"{who}: trajectory {int(bad[0])} holds NaN or Inf, in {dtype_name(trajectories.dtype)}")


def _grid(scene: _C.Scene, axis: int) -> tuple[float, float]:
    """Place of the first unknown on an axis, and the spacing."""
    n, length = scene.physics.shape[axis], scene.physics.length[axis]
    return (0.0, length / n) if scene.physics.periodic else (length / (n + 1), length / (n + 1))


def _points(first: float, spacing: float, n: int) -> np.ndarray:
    return (first + spacing * torch.arange(n, dtype=torch.float64)).numpy()


def _check_shape(path: str | Path, scene: _C.Scene, tensor: array_files.Array) -> bool:
    """Whether the last axis of a tensor that fits the scene is that of channels."""
    shape, channels = tuple(reversed(scene.physics.shape)), scene.physics.channels
    if tensor.shape[2:] == (*shape, channels):
        return True
    if tensor.shape[2:] == shape and channels == 1:
        return False
    wanted = ", ".join(map(str, shape if channels == 1 else (*shape, channels)))
    raise ValueError(
        f"data: '{path}': tensor has shape {tensor.shape}; the scene needs (samples, times, {wanted}), "
        f"which is x first{' and channels last' if channels > 1 else ''}"
    )


def _check_spacing(path: str | Path, file: array_files.File, axis: str, n: int, wanted: float, what: str) -> None:
    """The points of an axis must be evenly spaced, as the scene has them. Edges of cells are one more."""
    points = file.array(f"{axis}-coordinate")
    if points.shape not in ((n,), (n + 1,)):
        got = points.shape
        raise ValueError(f"data: '{path}': {axis}-coordinate has shape {got}, but tensor has {n} points there")
    steps = torch.from_numpy(points.read()).double().diff()
    if n == 1:
        return
    spacing = float(steps.mean())
    if not ((steps - spacing).abs() <= 10 * _SPACING * abs(spacing)).all():
        raise ValueError(f"data: '{path}': {axis}-coordinate is not evenly spaced")
    if not abs(spacing - wanted) <= _SPACING * wanted:
        raise ValueError(
            f"data: '{path}': the spacing of {axis}-coordinate is {spacing:.6g}, but {what} is {wanted:.6g}"
        )
