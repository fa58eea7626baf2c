"""Scenes: training experiments as TOML files, read by the compiled library for both languages."""

import copy
from pathlib import Path
from typing import Any

import torch

from prdp_torch import data_parallel, solvers, steppers
from prdp_torch.experiments import _C, field_task
from prdp_torch.flow import Flow
from prdp_torch.stepper import Stepper

_PACKAGE = Path(__file__).parents[1]
# In a checkout the scenes lie among the examples; a wheel carries them along.
_FOLDERS = [_PACKAGE.parent / "examples" / "scenes", _PACKAGE / "scenes"]

_SOLVERS = {solver.method: solver for solver in solvers.Solver.__subclasses__()}


def available() -> dict[str, Path]:
    """Return the scenes that come with the project, as a dict from name to path."""
    for folder in _FOLDERS:
        if folder.is_dir():
            return {path.stem: path for path in sorted(folder.glob("*.toml"))}
    return {}


def load(scene: str | Path) -> _C.Scene:
    """Read a scene by its name, or by the path of a .toml file. The ValueError for a mistake names the file, the line
    and what is allowed."""
    if str(scene).endswith(".toml"):
        return _checked(_C.read_scene(str(scene)))
    known = available()
    if str(scene) not in known:
        raise ValueError(f"no scene '{scene}'; available: {', '.join(known)}; or give the path of a .toml file")
    return _checked(_C.read_scene(str(known[str(scene)])))


def _checked(scene: _C.Scene) -> _C.Scene:
    """The scene, whose solver and steps can be made: what they themselves refuse is told with the file."""
    try:
        make_solver(scene, scene.max_iter)
    except ValueError as error:
        raise ValueError(f"{scene.path}: [solver]: {error}") from None
    if scene.device.type == "cpu":
        try:
            make_stepper(scene)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{scene.path}: {error}") from None
    if scene.compare.rtol is not None and scene.compare.rtol >= 1:
        raise ValueError(f"{scene.path}: compare.rtol: must be < 1, got {scene.compare.rtol:g}")
    return scene


def placed(scene: _C.Scene, device: "str | torch.device | None" = None) -> _C.Scene:
    """Return a copy of a scene whose data, network and solves live on `device`; None keeps the scene's own. Of
    several processes each takes its own GPU for "cuda". ValueError if there is no such device here."""
    there = copy.copy(scene)
    if device is not None:
        there.set_device(str(device))
    there.set_device(str(data_parallel.own_gpu(there.device)))  # before anything is made on another GPU
    _C.find_device(str(there.device))
    return there


def make_stepper(scene: _C.Scene, direct: bool = False, max_iter: int | None = None) -> Stepper:
    """Make the stepper of a scene, on its device.

    Args:
        scene: from `load`.
        direct: whether to use the exact solver in place of the scene's.
        max_iter: K in place of the scene's.

    A failed sample does not raise, because poorly converged steps may diverge early in a training. The scene's
    `on_failure` says whether it gets a gradient.
    """
    physics = scene.physics
    options: dict[str, Any] = {
        "solver": solvers.Direct() if direct else make_solver(scene, scene.max_iter if max_iter is None else max_iter),
        "backward": scene.backward,
        "on_failure": scene.on_failure,
        "start": scene.start,
    }
    if scene.task == "field":
        return field_task.make_stepper(scene, **options)
    if physics.equation == "darcy":
        return field_task.make_darcy_step(scene, **options)
    if physics.equation == "poisson":
        return steppers.Poisson(physics.shape, length=physics.length, **options)
    if physics.force is not None:
        # As the C++ trainer has it: central differences would make waves grow at these Courant numbers.
        return Flow(
            physics.shape, physics.nu, physics.dt, length=physics.length, force=physics.force.to(scene.device),
            advection="upwind", **options,
        )  # fmt: skip
    kinds = {"heat": steppers.Heat, "burgers": steppers.Burgers, "navier_stokes": steppers.NavierStokes}
    kind = kinds[physics.equation]
    made: Stepper = kind(physics.shape, physics.nu, physics.dt, length=physics.length, **options)
    return made


def make_solver(scene: _C.Scene, max_iter: int) -> solvers.Solver:
    """Make the solver of a scene with K = max_iter."""
    extra: dict[str, Any] = {"restart": scene.restart} if scene.method == "gmres" else {}
    if scene.preconditioner and scene.method != "multigrid":
        extra["preconditioner"] = scene.preconditioner
    return _SOLVERS[scene.method](max_iter=max_iter, rtol=scene.rtol, **extra)
