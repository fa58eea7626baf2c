"""Types of the compiled library, for editors."""

from collections.abc import Callable, Sequence
from os import PathLike
from typing import NoReturn

from torch import Tensor, dtype

VERSION: str
DEFAULT_RTOL: float
DEFAULT_RESTART: int
CHECKPOINT_SQRT: int
SOLVE_STATUSES: dict[str, int]
PRDP_DEFAULTS: dict[str, float | int | None]
TOLERANCE_DEFAULTS: dict[str, float | int]

class RegisteredProducts:
    def __init__(
        self,
        apply: Callable[[Tensor, list[Tensor]], Tensor],
        apply_transpose: Callable[[Tensor, list[Tensor]], Tensor] | None,
        diagonal: Callable[[list[Tensor]], Tensor] | None,
        transpose_in_transforms: Callable[[Tensor, list[Tensor]], Tensor],
        product_rule: Callable[[Tensor, Tensor, list[Tensor]], list[Tensor]],
    ) -> None: ...
    @property
    def number(self) -> int: ...

def check_operator(kind: str, shape: list[int], parameters: list[float], tensors: list[Tensor]) -> None: ...
def check_solver(who: str, method: str, max_iter: int, rtol: float, restart: int) -> None: ...
def check_options(
    who: str,
    method: str,
    max_iter: int,
    rtol: float,
    restart: int,
    backward: str,
    adjoint_max_iter: int | None,
    adjoint_rtol: float | None,
    on_failure: str,
    checkpoint_every: int,
    start: str = ...,
) -> None: ...
def open_adjoint_log() -> int: ...
def close_adjoint_log(log: int) -> None: ...
def read_adjoint_log(log: int) -> tuple[Tensor, Tensor, Tensor, Tensor] | None: ...
def join_adjoint_logs(logs: list[int]) -> tuple[Tensor, Tensor, Tensor, Tensor] | None: ...
def product_rule(
    lambda_: Tensor, v: Tensor, tensors: list[Tensor], kind: str, shape: list[int], parameters: list[float]
) -> list[Tensor | None]: ...

class Failures:
    count: int
    def take(self, forward: list[Tensor], adjoint: list[Tensor], samples: Tensor | None) -> None: ...
    def line(self, interval: int) -> str: ...

class StepOfRollout:
    def __init__(self, step: int, steps: int) -> None: ...
    def __enter__(self) -> None: ...
    def __exit__(self, *args: object) -> None: ...

class SolveOptions:
    def __init__(
        self,
        method: str,
        rtol: float,
        restart: int,
        backward: str,
        adjoint_max_iter: int | None,
        adjoint_rtol: float | None,
        on_failure: str,
        checkpoint_every: int,
        from_state: bool,
    ) -> None: ...

class Equation:
    def __init__(self, kind: str, shape: Sequence[int], parameters: Sequence[float], picard_steps: int) -> None: ...

def step(
    u: Tensor,
    tensors: list[Tensor],
    equation: Equation,
    options: SolveOptions,
    max_iter: Tensor | int,
    adjoint_log: int,
) -> tuple[Tensor, ...] | None: ...
def linear_solve(
    b: Tensor,
    tensors: list[Tensor],
    kind: str,
    shape: list[int],
    parameters: list[float],
    options: SolveOptions,
    max_iter: Tensor | int,
    adjoint_log: int,
    x0: Tensor | None,
) -> tuple[Tensor, ...] | None: ...
def count_factorisations() -> int: ...
def clear_factorisations() -> None: ...
def solve_with_tensors(
    b: Tensor,
    tensors: list[Tensor],
    kind: str,
    shape: list[int],
    parameters: list[float],
    transposed: bool,
    solver: str,
    max_iter: int,
    rtol: float,
    restart: int = ...,
    x0: Tensor | None = ...,
) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]: ...

class Controller:
    @property
    def max_iter(self) -> int: ...
    @property
    def warning(self) -> str | None: ...

class PRDPController(Controller):
    def __init__(
        self,
        *,
        tau_step: float,
        tau_stop: float,
        delta: int,
        window: int,
        initial: int,
        increment: int,
        maximum: int | None,
        growth: float,
        adjoint_ratio: float | None,
    ) -> None: ...
    @property
    def settings(self) -> dict[str, float | int | None]: ...

class ToleranceController(Controller):
    def __init__(self, *, ratio: float, adjoint_ratio: float, floor: float, maximum: int) -> None: ...
    @property
    def rtol(self) -> float: ...
    @property
    def adjoint_rtol(self) -> float: ...
    @property
    def settings(self) -> dict[str, float | int]: ...

class LinearSchedule(Controller):
    def __init__(self, *, initial: int, increment: int, maximum: int, adjoint_ratio: float | None) -> None: ...
    @property
    def settings(self) -> dict[str, float | int | None]: ...

class Physics:
    equation: str
    shape: list[int]
    nu: float
    dt: float
    channels: int
    periodic: bool
    direct_is_cheap: bool

class Data:
    file: str
    modes: int
    train: int
    valid: int
    seed: int
    valid_steps: int
    valid_max_iter: int
    reference_shape: list[int]

class Network:
    kind: str
    hidden: list[int]
    blocks: int
    width: int
    zero_output: bool

class Training:
    loss: str
    batch: int
    intervals: int

class Field:
    steps: int
    every: int
    smoothing: float

class Compare:
    seeds: int
    constant: list[int]
    growth: float | None
    schedule: list[int]
    rtol: float | None
    target: float | None

class Scene:
    name: str
    path: str
    text: str
    title: str
    task: str
    unit: str
    trains_network: bool
    executions: int
    dtype: dtype
    physics: Physics
    data: Data
    network: Network
    field: Field
    training: Training
    compare: Compare
    method: str
    max_iter: int
    rtol: float
    restart: int
    backward: str
    start: str
    prdp: dict[str, float | int | None]

    def learning_rate(self, update: int) -> float: ...

class Dataset:
    train_start: Tensor
    train_first: Tensor | None
    train_end: Tensor
    valid_start: Tensor
    valid_end: Tensor

class ParameterProblem:
    modes: Tensor
    start: Tensor
    reference: Tensor
    solution: Tensor

class FieldProblem:
    start: Tensor
    snapshots: Tensor
    theta: Tensor
    reference: Tensor

class Checkpoint:
    def __init__(self, path: str | PathLike[str], settings: str) -> None: ...
    def due(self) -> bool: ...
    def write(self, state: bytes) -> None: ...
    def read(self) -> bytes | None: ...
    def read_before(self) -> bytes: ...
    @property
    def notice(self) -> str: ...
    def refuse(self) -> NoReturn: ...
    def remove_before(self, record: str | PathLike[str]) -> None: ...
    def check_length(self, done: int, intervals: int) -> None: ...
    def remove(self) -> None: ...

class FolderLock:
    def __init__(self, folder: str | PathLike[str]) -> None: ...
    def release(self) -> None: ...

MOST_COUNTED: int

def sentence(what: str) -> str: ...
def fingerprint(content: bytes) -> str: ...
def seal_record(object: str) -> str: ...
def read_record(path: str | PathLike[str]) -> str | None: ...
def refuse_finished(record: str | PathLike[str], intervals: int, wanted: int) -> NoReturn: ...
def write_whole(files: Sequence[tuple[str | PathLike[str], bytes]]) -> None: ...
def read_scene(path: str) -> Scene: ...
def scene_keys() -> list[dict[str, str | None]]: ...
def parse_scene(text: str, path: str) -> Scene: ...
def make_dataset(scene: Scene, on_progress: Callable[[int, int], None] | None = ...) -> Dataset: ...
def validation_trajectories(
    scene: Scene, steps: int, on_progress: Callable[[int, int], None] | None = ...
) -> Tensor: ...
def all_trajectories(scene: Scene, steps: int, on_progress: Callable[[int, int], None] | None = ...) -> Tensor: ...
def make_parameter_problem(scene: Scene) -> ParameterProblem: ...
def make_field_problem(scene: Scene, seed: int) -> FieldProblem: ...
def diffusion_stencil(kappa: Tensor, dt: float) -> tuple[Tensor, list[list[int]]]: ...
def observed(states: Tensor, scene: Scene) -> Tensor: ...
def roughness(theta: Tensor) -> Tensor: ...
def loss(kind: str, u: Tensor, reference: Tensor) -> Tensor: ...
def normalised_mse(u: Tensor, reference: Tensor) -> Tensor: ...
def without_mean_pressure(u: Tensor) -> Tensor: ...
def half_mse(u: Tensor, reference: Tensor) -> Tensor: ...
def relative_error(theta: Tensor, reference: Tensor) -> Tensor: ...
