from __future__ import annotations
import collections.abc
import torch
import typing
__all__: list[str] = ['AdjointLog', 'CHECKPOINT_SQRT', 'Controller', 'DEFAULT_RESTART', 'DEFAULT_RTOL', 'Equation', 'FlowBox', 'FlowEquation', 'FunctionCode', 'LinearSchedule', 'PRDPController', 'PRDP_DEFAULTS', 'RegisteredProducts', 'SMALL_RESIDUAL', 'SOLVE_STATUSES', 'SolveOptions', 'StepOfRollout', 'TOLERANCE_DEFAULTS', 'ToleranceController', 'VERSION', 'any_nonfinite', 'batched_axes', 'block_gradients_of_failed', 'bytes_of_factorisations', 'check_operator', 'check_start', 'clear_factorisations', 'count_factorisations', 'is_sum_over_axes', 'join_adjoint_logs', 'kernels_made', 'linear_solve', 'physical_memory', 'product_rule', 'read_adjoint_log', 'sentence', 'solve_with_tensors', 'step', 'warn', 'warn_of_idle_steps', 'way_of_last_solve']
class FunctionCode:
    def __init__(self) -> None:
        ...
class RegisteredProducts:
    def __init__(self, apply: collections.abc.Callable, apply_transpose: collections.abc.Callable | None, diagonal: collections.abc.Callable | None, transpose_in_transforms: collections.abc.Callable, product_rule: collections.abc.Callable, code: FunctionCode) -> None:
        ...
    @property
    def number(self) -> int:
        ...
class AdjointLog:
    def __init__(self) -> None:
        ...
    @property
    def number(self) -> int:
        ...
class StepOfRollout:
    def __enter__(self) -> None:
        ...
    def __exit__(self, *args) -> None:
        ...
    def __init__(self, step: typing.SupportsInt | typing.SupportsIndex, steps: typing.SupportsInt | typing.SupportsIndex) -> None:
        ...
class SolveOptions:
    """
    The options of a solve but for max_iter and the log.
    """
    def __init__(self, names: collections.abc.Sequence[str], counts: collections.abc.Sequence[typing.SupportsInt | typing.SupportsIndex], numbers: collections.abc.Sequence[typing.SupportsFloat | typing.SupportsIndex], preconditioner: collections.abc.Sequence[torch.Tensor]) -> None:
        ...
    def check(self, who: str) -> None:
        ...
class Equation:
    """
    An equation but for its tensors.
    """
    def __init__(self, arg0: str, arg1: collections.abc.Sequence[typing.SupportsInt | typing.SupportsIndex], arg2: collections.abc.Sequence[typing.SupportsFloat | typing.SupportsIndex], arg3: typing.SupportsInt | typing.SupportsIndex) -> None:
        ...
class FlowBox:
    """
    The grid of a flow, its boundary and its obstacle.
    """
    def __init__(self, shape: collections.abc.Sequence[typing.SupportsInt | typing.SupportsIndex], boundary: collections.abc.Sequence[str], length: collections.abc.Sequence[typing.SupportsFloat | typing.SupportsIndex], obstacle: torch.Tensor | None) -> None:
        ...
    def fill_pockets(self, obstacle: torch.Tensor) -> torch.Tensor:
        ...
class FlowEquation:
    """
    A flow and how it is stepped.
    """
    def __init__(self, box: FlowBox, dt: typing.SupportsFloat | typing.SupportsIndex, nu: torch.Tensor, force: torch.Tensor | None, inflow: torch.Tensor | None, wall_velocity: collections.abc.Sequence[torch.Tensor | None], advection: str, diffusion: str, pressure: str) -> None:
        ...
    def check(self) -> None:
        ...
    def divergence(self, u: torch.Tensor) -> torch.Tensor:
        ...
    def pressure(self, u: torch.Tensor, options: SolveOptions, max_iter: typing.SupportsInt | typing.SupportsIndex) -> torch.Tensor:
        ...
    def project(self, u: torch.Tensor, options: SolveOptions, max_iter: typing.SupportsInt | typing.SupportsIndex) -> torch.Tensor:
        ...
    def rollout(self, u: torch.Tensor, steps: typing.SupportsInt | typing.SupportsIndex, options: SolveOptions, max_iter: typing.SupportsInt | typing.SupportsIndex, adjoint_log: typing.SupportsInt | typing.SupportsIndex) -> tuple:
        ...
    def step(self, u: torch.Tensor, options: SolveOptions, max_iter: typing.SupportsInt | typing.SupportsIndex, adjoint_log: typing.SupportsInt | typing.SupportsIndex) -> tuple:
        ...
    def step_and_pressure(self, u: torch.Tensor, options: SolveOptions, max_iter: typing.SupportsInt | typing.SupportsIndex, adjoint_log: typing.SupportsInt | typing.SupportsIndex) -> tuple:
        ...
class Controller:
    def _history_from(self, first: typing.SupportsInt | typing.SupportsIndex) -> list[tuple[float, float, int, bool, float | None, float | None]]:
        ...
    def _load(self, max_iter: typing.SupportsInt | typing.SupportsIndex, checkpoint: typing.SupportsFloat | typing.SupportsIndex, history: collections.abc.Sequence[tuple[typing.SupportsFloat | typing.SupportsIndex, typing.SupportsFloat | typing.SupportsIndex, typing.SupportsInt | typing.SupportsIndex, bool, typing.SupportsFloat | typing.SupportsIndex | None, typing.SupportsFloat | typing.SupportsIndex | None]]) -> None:
        ...
    def _step(self, metric: typing.SupportsFloat | typing.SupportsIndex, converged: bool, residual: typing.SupportsFloat | typing.SupportsIndex | None, error: typing.SupportsFloat | typing.SupportsIndex | None, idle: typing.SupportsFloat | typing.SupportsIndex, failed: typing.SupportsFloat | typing.SupportsIndex) -> bool:
        ...
    @property
    def _budget(self) -> dict:
        ...
    @property
    def _checkpoint(self) -> float:
        ...
    @property
    def max_iter(self) -> int:
        ...
    @property
    def warning(self) -> str | None:
        ...
class PRDPController(Controller):
    def __init__(self, *, tau_step: typing.SupportsFloat | typing.SupportsIndex, tau_stop: typing.SupportsFloat | typing.SupportsIndex, delta: typing.SupportsInt | typing.SupportsIndex, window: typing.SupportsInt | typing.SupportsIndex, initial: typing.SupportsInt | typing.SupportsIndex, increment: typing.SupportsInt | typing.SupportsIndex, maximum: typing.SupportsInt | typing.SupportsIndex | None, growth: typing.SupportsFloat | typing.SupportsIndex, adjoint_ratio: typing.SupportsFloat | typing.SupportsIndex | None) -> None:
        ...
    @property
    def settings(self) -> dict:
        ...
class ToleranceController(Controller):
    def __init__(self, *, ratio: typing.SupportsFloat | typing.SupportsIndex, adjoint_ratio: typing.SupportsFloat | typing.SupportsIndex, floor: typing.SupportsFloat | typing.SupportsIndex, adjoint_floor: typing.SupportsFloat | typing.SupportsIndex, maximum: typing.SupportsInt | typing.SupportsIndex) -> None:
        ...
    def _rtol_for(self, smallest: typing.SupportsFloat | typing.SupportsIndex) -> float:
        ...
    @property
    def adjoint_rtol(self) -> float:
        ...
    @property
    def rtol(self) -> float:
        ...
    @property
    def settings(self) -> dict:
        ...
class LinearSchedule(Controller):
    def __init__(self, *, initial: typing.SupportsInt | typing.SupportsIndex, increment: typing.SupportsInt | typing.SupportsIndex, maximum: typing.SupportsInt | typing.SupportsIndex, adjoint_ratio: typing.SupportsFloat | typing.SupportsIndex | None) -> None:
        ...
    @property
    def settings(self) -> dict:
        ...
def any_nonfinite(status: torch.Tensor) -> bool:
    """
    Whether a sample was refused for a NaN or Inf in b or A.
    """
def batched_axes(kind: str, axes: typing.SupportsInt | typing.SupportsIndex, tensors: typing.SupportsInt | typing.SupportsIndex) -> list[int] | None:
    """
    The number of axes of each of so many tensors of an operator where it has one for the batch, on a grid of so many axes: 0 if all samples share it. None if that is not known.
    """
def block_gradients_of_failed(u: torch.Tensor, status: torch.Tensor, on_failure: str) -> None:
    """
    No gradient passes through a state u from here on, for samples whose solve has none.
    """
def bytes_of_factorisations() -> int:
    """
    The memory of those that are kept for later solves.
    """
def check_operator(kind: str, shape: collections.abc.Sequence[typing.SupportsInt | typing.SupportsIndex], parameters: collections.abc.Sequence[typing.SupportsFloat | typing.SupportsIndex], tensors: collections.abc.Sequence[torch.Tensor]) -> None:
    ...
def check_start(start: str) -> None:
    ...
def clear_factorisations() -> None:
    """
    Frees those that are kept for later solves.
    """
def count_factorisations() -> int:
    """
    How many sparse factorisations were made so far.
    """
def is_sum_over_axes(b: torch.Tensor, tensors: collections.abc.Sequence[torch.Tensor], kind: str, shape: collections.abc.Sequence[typing.SupportsInt | typing.SupportsIndex], parameters: collections.abc.Sequence[typing.SupportsFloat | typing.SupportsIndex]) -> bool:
    """
    Whether `Direct` solves with A, axis by axis, without a factorisation of the whole.
    """
def join_adjoint_logs(logs: collections.abc.Sequence[typing.SupportsInt | typing.SupportsIndex]) -> tuple | None:
    ...
def kernels_made() -> list[str]:
    """
    The kernels of GPUs that this process has made, by name.
    """
def linear_solve(b: typing.Any, tensors: collections.abc.Sequence[typing.Any], kind: str, shape: collections.abc.Sequence[typing.SupportsInt | typing.SupportsIndex], parameters: collections.abc.Sequence[typing.SupportsFloat | typing.SupportsIndex], options: SolveOptions, max_iter: typing.SupportsInt | typing.SupportsIndex, adjoint_log: typing.SupportsInt | typing.SupportsIndex, x0: typing.Any | None) -> typing.Any:
    ...
def physical_memory() -> float:
    ...
def product_rule(lambda_: torch.Tensor, v: torch.Tensor, tensors: collections.abc.Sequence[torch.Tensor], kind: str, shape: collections.abc.Sequence[typing.SupportsInt | typing.SupportsIndex], parameters: collections.abc.Sequence[typing.SupportsFloat | typing.SupportsIndex]) -> list[torch.Tensor]:
    """
    ∂⟨lambda, A v⟩ with respect to each tensor of A, as the solves take it; None where there is none.
    """
def read_adjoint_log(log: typing.SupportsInt | typing.SupportsIndex) -> tuple | None:
    ...
def sentence(what: str) -> str:
    ...
def solve_with_tensors(b: torch.Tensor, tensors: collections.abc.Sequence[torch.Tensor], kind: str, shape: collections.abc.Sequence[typing.SupportsInt | typing.SupportsIndex], parameters: collections.abc.Sequence[typing.SupportsFloat | typing.SupportsIndex], transposed: bool, solver: str, max_iter: typing.SupportsInt | typing.SupportsIndex, rtol: typing.SupportsFloat | typing.SupportsIndex, restart: typing.SupportsInt | typing.SupportsIndex = 10, x0: torch.Tensor | None = None, preconditioner: str = '') -> tuple[torch.Tensor, tuple]:
    """
    The plain-tensor solver behind linear_solve, without derivatives: the oracle of the CPU loops.
    """
def step(u: typing.Any, tensors: collections.abc.Sequence[typing.Any], equation: Equation, options: SolveOptions, max_iter: typing.SupportsInt | typing.SupportsIndex, adjoint_log: typing.SupportsInt | typing.SupportsIndex) -> typing.Any:
    ...
def warn(text: str) -> None:
    """
    Warn, at the line of the user's that led here.
    """
def warn_of_idle_steps(iterations: torch.Tensor, residual: torch.Tensor, status: torch.Tensor, rtol: typing.SupportsFloat | typing.SupportsIndex, has_controller: bool, on_failure: str) -> None:
    """
    Warn where the steps of a rollout, (batch, steps), hand their start on.
    """
def way_of_last_solve() -> str:
    """
    How this thread's last solve was computed: kernel, loops or tensors.
    """
CHECKPOINT_SQRT: int = -1
DEFAULT_RESTART: int = 10
DEFAULT_RTOL: float = 1e-05
PRDP_DEFAULTS: dict = {'tau_step': 0.95, 'tau_stop': 0.9, 'delta': 3, 'window': 6, 'initial': 1, 'increment': 1, 'maximum': None, 'growth': 1.0, 'adjoint_ratio': None}
SMALL_RESIDUAL: float = 0.0001
SOLVE_STATUSES: dict = {'CONVERGED_BREAKDOWN': 2, 'CONVERGED': 1, 'MAX_ITER': -1, 'STAGNATED': -2, 'DIVERGED': -3, 'OVERFLOW': -4, 'BREAKDOWN': -5, 'ZERO_DIAGONAL': -6, 'INCONSISTENT': -7, 'NONFINITE_INPUT': -8, 'NONFINITE_OPERATOR': -9}
TOLERANCE_DEFAULTS: dict = {'ratio': 0.1, 'adjoint_ratio': 0.1, 'floor': 1e-05, 'adjoint_floor': 0.01, 'maximum': 10000}
VERSION: str = '0.1.0'
