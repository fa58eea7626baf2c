"""Trajectories in HDF5 files of PDEBench's layout (Takamoto et al. 2022).

`tensor` is (samples, times, X), (samples, times, X, Y) or (samples, times, X, Y, Z), with the channels as a last axis
where there are several. `x-coordinate`, `y-coordinate`, `z-coordinate` and `t-coordinate` are vectors. In the library
the same fields are (samples, times, channels, *shape), and x is the last axis of `shape`.
"""

from pathlib import Path

import torch

_AXES = ("x", "y", "z")
_SPACING = 1e-3  # relative; float32 coordinates are that exact


def write(path, trajectories, scene):
    """Write trajectories (samples, times, channels, *shape) of a scene. Raises ValueError if the file cannot be
    written, and ImportError without the package h5py."""
    dim = len(scene.physics.shape)
    spatial = range(2 + dim, 2, -1)
    tensor = trajectories.permute(0, 1, *spatial, 2).numpy()
    with _open(path, "w") as file:
        file["tensor"] = tensor[..., 0] if tensor.shape[-1] == 1 else tensor
        for name, n in zip(_AXES, reversed(scene.physics.shape), strict=False):
            first, dx = _grid(scene, n)
            file[f"{name}-coordinate"] = _points(first, dx, n)
        file["t-coordinate"] = _points(0.0, scene.physics.dt or 1.0, trajectories.shape[1])


def read(path, scene):
    """Read the first `data.train` + `data.valid` trajectories for a scene: (samples, times, channels, *shape) in the
    scene's dtype.

    Raises:
        ValueError: the file does not fit the scene. Its grid, its number of samples and times, its spacings dx and
            dt, and that its values are finite are all checked; the message names the mismatch.
        ImportError: the package h5py is missing.
    """
    wanted = scene.data.train + scene.data.valid
    with _open(path, "r") as file:
        tensor = _dataset(path, file, "tensor")
        with_channels = _check_shape(path, scene, tensor)
        if len(tensor) < wanted:
            raise ValueError(
                f"data: '{path}' has {len(tensor)} trajectories; data.train + data.valid of the scene is {wanted}"
            )
        for name, n in zip(_AXES, reversed(scene.physics.shape), strict=False):
            _check_spacing(path, file, name, n, _grid(scene, n)[1], f"dx of the grid of {n} unknowns")
        if scene.physics.dt:
            _check_spacing(path, file, "t", tensor.shape[1], scene.physics.dt, "physics.dt")
        content = torch.from_numpy(tensor[:wanted])
    if not with_channels:
        content = content[..., None]
    dim = len(scene.physics.shape)
    content = content.permute(0, 1, content.dim() - 1, *range(1 + dim, 1, -1)).to(scene.dtype)
    check_finite(f"data: '{path}'", content)
    return content.contiguous()


def check_finite(who, trajectories):
    """ValueError for a trajectory with NaN or Inf."""
    bad = (~trajectories.isfinite().flatten(1).all(1)).nonzero().flatten()
    if len(bad):
        raise ValueError(f"{who}: trajectory {int(bad[0])} holds NaN or Inf")


def _open(path, mode):
    try:
        import h5py
    except ImportError:
        raise ImportError("data: HDF5 files need the package h5py; pip install h5py") from None
    try:
        return h5py.File(path, mode)
    except OSError as error:
        what = "no such file" if mode == "r" and not Path(path).exists() else str(error)
        raise ValueError(f"data: cannot {'read' if mode == 'r' else 'write'} '{path}': {what}") from None


def _grid(scene, n):
    """Place of the first unknown on an axis of n, and the spacing, on the unit domain."""
    return (0.0, 1 / n) if scene.physics.periodic else (1 / (n + 1), 1 / (n + 1))


def _points(first, spacing, n):
    return (first + spacing * torch.arange(n, dtype=torch.float64)).numpy()


def _dataset(path, file, name):
    if name not in file:
        raise ValueError(f"data: '{path}' has no '{name}'; it holds: {', '.join(file) or 'nothing'}")
    return file[name]


def _check_shape(path, scene, tensor):
    """Whether the last axis of a tensor that fits the scene is that of channels."""
    shape, channels = tuple(reversed(scene.physics.shape)), scene.physics.channels
    if tensor.dtype.kind != "f":
        raise ValueError(f"data: '{path}': tensor must hold floating-point numbers, got {tensor.dtype}")
    if tensor.shape[2:] == (*shape, channels):
        return True
    if tensor.shape[2:] == shape and channels == 1:
        return False
    wanted = ", ".join(map(str, shape if channels == 1 else (*shape, channels)))
    raise ValueError(
        f"data: '{path}': tensor has shape {tensor.shape}; the scene needs (samples, times, {wanted}), "
        f"which is x first{' and channels last' if channels > 1 else ''}"
    )


def _check_spacing(path, file, axis, n, wanted, what):
    """The points of an axis must be evenly spaced, as the scene has them. Edges of cells are one more."""
    points = torch.from_numpy(_dataset(path, file, f"{axis}-coordinate")[...]).double()
    if points.shape not in ((n,), (n + 1,)):
        got = tuple(points.shape)
        raise ValueError(f"data: '{path}': {axis}-coordinate has shape {got}, but tensor has {n} points there")
    if n == 1:
        return
    steps = points.diff()
    spacing = float(steps.mean())
    if not ((steps - spacing).abs() <= 10 * _SPACING * abs(spacing)).all():
        raise ValueError(f"data: '{path}': {axis}-coordinate is not evenly spaced")
    if not abs(spacing - wanted) <= _SPACING * wanted:
        raise ValueError(
            f"data: '{path}': the spacing of {axis}-coordinate is {spacing:.6g}, but {what} is {wanted:.6g}"
        )
