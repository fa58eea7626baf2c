"""Trials of solvers on one step: products and seconds to a tolerance, forward and adjoint."""

import copy
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

import torch
from torch import Tensor

from prdp_torch import _C, torch_private
from prdp_torch.flow import Flow
from prdp_torch.operator_probes import is_renewed, is_symmetric, operator_of, random_cotangent
from prdp_torch.solve import AdjointLog, SolveInfo, SolveStatus
from prdp_torch.solvers import (
    CG,
    GMRES,
    MINRES,
    BiCGStab,
    Chebyshev,
    Direct,
    Jacobi,
    Multigrid,
    Preconditioner,
    Solver,
    SteepestDescent,
)
from prdp_torch.stepper import Stepper
from prdp_torch.steppers import EquationStepper

TOLERANCES = (1e-2, 1e-5)  # what a controller asks for at an error of 10 %, and of converged solves
RESTARTS = (2, 8, 30)
MOST_UNKNOWNS = {"sparse": 2**15, "dense": 2**12}  # of a factorisation, which the time limit cannot interrupt
RUNS = 5  # of which the median counts
FINER = 1e-3  # than the finest tolerance: what a solution is compared with, where none is exact


@dataclass
class Solve:
    """One direction of a measured step."""

    iterations: int
    """Of the slowest sample, as are the products with A."""
    products: int
    seconds: float
    """Of the whole batch; the median of up to five runs."""
    status: str
    """The worst of the samples, a name of `SolveStatus`."""
    solved: bool
    """Whether all samples met the tolerance."""
    cut_off: bool = False
    """Whether a sample ran out of iterations."""


@dataclass
class Row:
    """What one solver takes to one tolerance."""

    solver: Solver
    dtype: torch.dtype
    rtol: float
    forward: Solve
    adjoint: Solve | None
    """With a random cotangent; None where nothing in the step needs a gradient."""
    error: float | None = None
    """‖u - u*‖ / ‖u*‖ of the worst sample, where u* is the most accurate solution that was found; of solved rows."""

    @property
    def name(self) -> str:
        return name_of(self.solver)

    @property
    def solves(self) -> list[Solve]:
        return [self.forward] if self.adjoint is None else [self.forward, self.adjoint]

    @property
    def solved(self) -> bool:
        return all(solve.solved for solve in self.solves)

    @property
    def status(self) -> str:
        """The word solved, or the worse of the two statuses; of what the time limit cut off that is often MAX_ITER."""
        return "solved" if self.solved else min((solve.status for solve in self.solves), key=SolveStatus.__getitem__)

    @property
    def may_go_on(self) -> bool:
        """Whether more iterations may solve it: a sample ran out of them, and none failed. The status does not say so,
        as STAGNATED, at the rounding of another sample or of the adjoint solve, is worse than MAX_ITER."""
        return self.status in ("MAX_ITER", "STAGNATED") and any(solve.cut_off for solve in self.solves)


@dataclass
class Trial:
    """A step on which solvers are tried, and what it steps from."""

    step: Stepper
    sample: Tensor
    cotangent: Tensor
    renewed: bool
    """Whether A changes in every update: kept factors and coarse grids are then cleared before each run."""

    def forget(self) -> None:
        """Before a solve: frees what an update would not find."""
        if self.renewed:
            _C.clear_factorisations()


def name_of(solver: Solver) -> str:
    settings = [str(solver.restart)] if isinstance(solver, GMRES) else []
    if preconditioner_of(solver) is not None:
        settings.append(str(solver.preconditioner))
    return type(solver).__name__ + (f"({', '.join(settings)})" if settings else "")


def preconditioner_of(solver: Solver) -> Preconditioner:
    """Of a method that takes one; that of `Multigrid` is itself."""
    return None if isinstance(solver, Multigrid) else solver.preconditioner


FOR_SYMMETRIC = CG, MINRES, SteepestDescent


def candidates(step: Stepper) -> list[Solver]:
    """The solvers to try on a step. The systems of a `Flow` are symmetric, and do not depend on the state."""
    if isinstance(step, Flow):
        by_diagonal, by_cycles = CG(1, preconditioner="diagonal"), CG(1, preconditioner="multigrid")
        return [CG(1), by_diagonal, Multigrid(1), by_cycles, Direct(1)]
    own = [step.restart] if step.method.startswith("gmres") else []
    restarts = sorted({*RESTARTS, *own})
    every = [Jacobi(1), Chebyshev(1), SteepestDescent(1), CG(1), BiCGStab(1), MINRES(1)]
    every += [GMRES(1, restart=m) for m in restarts]
    kind = getattr(step, "kind", None)
    if kind not in ("heat", "poisson", "navier_stokes"):  # whose diagonals are constant
        every += [CG(1, preconditioner="diagonal"), BiCGStab(1, preconditioner="diagonal")]
        every += [GMRES(1, restart=8, preconditioner="diagonal")]
    every += [Multigrid(1), CG(1, preconditioner="multigrid"), BiCGStab(1, preconditioner="multigrid")]
    return [*every, GMRES(1, restart=8, preconditioner="multigrid"), Direct(1)]


def measure(step: Stepper, sample: Tensor, solvers: Sequence[Solver], seconds: float) -> tuple[list[Row], list[str]]:
    """Try the solvers on a step, `seconds` each. Returns the rows of all that the operator allows, and sentences: what
    is counted, and why the others were not tried. Raises TypeError or ValueError where step and sample do not fit each
    other."""
    copied = _copy(step)
    any_solver = GMRES(1, restart=1)
    set_solver(copied, any_solver, 1, 0.0)
    copied(sample)  # what does not fit is refused here
    trial = trial_of(copied, sample)
    run(trial, any_solver)  # the first backward pass of a process starts its threads
    symmetric = is_symmetric(copied, sample, trial.cotangent)
    rows, refused = [], []
    for solver in solvers:
        try:
            if isinstance(solver, FOR_SYMMETRIC) and not symmetric:
                raise ValueError("A is not symmetric")
            if isinstance(solver, Direct):
                _check_direct(trial, seconds)
            rows += _measure_one(trial, solver, seconds)
        except (ValueError, NotImplementedError) as error:  # the latter: on this device
            why = _C.sentence(str(error)).removeprefix(f"{type(solver).__name__}: ").removeprefix("linear_solve: ")
            refused.append((solver, why))
    measure_errors(trial, rows)
    counted = (
        "A depends on the state or is trained, so each forward solve makes its factors or grids anew."
        if trial.renewed
        else "Factors and grids of A are made once and not counted, as A depends on neither the state nor what is "
        "trained; if it changes with time, add them."
    )
    return rows, [counted, *_refusals(refused, {type(row.solver) for row in rows})]


def measure_errors(trial: Trial, rows: Sequence[Row]) -> None:
    """The error of each solved row. Residuals do not tell: of A with a large condition number, or with a b that is
    mostly values on the sides, a small one may leave a large error."""
    fine = [row for row in rows if row.solved and row.rtol == TOLERANCES[-1]]
    exact = [row for row in fine if isinstance(row.solver, Direct)]
    if not fine:
        return
    best = exact[0] if exact else min(fine, key=lambda row: row.forward.seconds)
    reference = _states(trial, best.solver, 4 * best.forward.iterations, FINER * TOLERANCES[-1]).double().flatten(1)
    for row in rows:
        if row.solved:
            u = _states(trial, row.solver, max(1, row.forward.iterations), row.rtol).double().flatten(1)
            errors = (u - reference).norm(dim=1) / reference.norm(dim=1)
            row.error = float(errors.nan_to_num(0.0).max())  # of a solution that is zero


def _states(trial: Trial, solver: Solver, max_iter: int, rtol: float) -> Tensor:
    set_solver(trial.step, solver, max_iter, rtol)
    with torch.no_grad():
        return trial.step(trial.sample)


def _refusals(refused: Sequence[tuple[Solver, str]], tried: set[type[Solver]]) -> list[str]:
    """A sentence for each reason. Of a method that was not tried at all, the first of its solvers is enough."""
    names: dict[str, list[str]] = {}
    named = set()
    for solver, why in refused:
        if type(solver) in tried or type(solver) not in named:
            names.setdefault(why, []).append(name_of(solver))
            named.add(type(solver))
    return [f"{' and '.join(of)} {'was' if len(of) == 1 else 'were'} not tried: {why}." for why, of in names.items()]


def measure_one_iteration(step: Stepper, sample: Tensor, solver: Solver) -> Row:
    """The row of a single iteration."""
    trial = trial_of(_copy(step), sample)
    set_solver(trial.step, solver, 1, 0.0)
    return run(trial, solver, RUNS)


def measure_with_start(step: Stepper, sample: Tensor, row: Row) -> Row:
    """The same solve as `row`, from the state."""
    trial = trial_of(_copy(step), sample)
    trial.step.start = "state"
    set_solver(trial.step, row.solver, 2 * max(solve.iterations for solve in row.solves), row.rtol)
    return run(trial, row.solver, RUNS)


def trial_of(step: Stepper, sample: Tensor) -> Trial:
    cotangent = random_cotangent(step, sample)
    return Trial(step, sample, cotangent, is_renewed(step, sample, cotangent))


def _measure_one(trial: Trial, solver: Solver, seconds: float) -> list[Row]:
    """K doubles until the tolerance is met or the time is spent; a finer one is not tried after a failure."""
    rows: list[Row] = []
    k, deadline, made = 1, time.perf_counter() + seconds, len(_C.kernels_made())
    for rtol in TOLERANCES:
        while True:
            set_solver(trial.step, solver, k, rtol)
            row = run(trial, solver)
            if len(_C.kernels_made()) > made:  # once, which no update waits for
                deadline, made = time.perf_counter() + seconds, len(_C.kernels_made())
                continue
            # The next run takes about as long as all that were before it.
            if not row.may_go_on or time.perf_counter() > deadline - seconds / 2:
                break
            k *= 2
        if not row.solved:
            return [*rows, row]
        rows.append(run(trial, solver, RUNS, time.perf_counter() + seconds / 10))
    return rows


def run(trial: Trial, solver: Solver, max_runs: int = 1, deadline: float = float("inf")) -> Row:
    """The row of a step and its adjoint as they are set; no run starts after the deadline but the first."""
    step, u = trial.step, trial.sample.clone().requires_grad_()
    forward: list[float] = []
    adjoint: list[float] = []
    while not forward or (len(forward) < max_runs and time.perf_counter() < deadline):
        trial.forget()
        started = now(u)
        u_next = step(u)
        between = now(u)
        forward.append(between - started)
        if u_next.requires_grad:
            # An operator may be made of what it is kept with, such as a field: its graph stays.
            torch.autograd.grad(u_next, torch_private.leaves_of(u_next), trial.cotangent, retain_graph=True)
            adjoint.append(now(u) - between)
    assert step.info is not None
    backward = _solve(step.adjoint_info, adjoint) if adjoint and step.adjoint_info is not None else None
    return Row(solver, u.dtype, step.rtol, _solve(step.info, forward), backward)


def _solve(info: SolveInfo, seconds: list[float]) -> Solve:
    worst = SolveStatus(int(info.status.min())).name
    return Solve(
        int(info.iterations.max()),
        int(info.operator_applications.max()),
        median(seconds),
        worst,
        bool(info.solved.all()),
        bool((info.status == SolveStatus.MAX_ITER).any()),
    )


def _copy(step: Stepper) -> Stepper:
    try:
        trial = copy.deepcopy(step)
    except RuntimeError:  # of an operator made of tensors that are not leaves of a graph
        trial = copy.copy(step)
        trial._adjoint_log = AdjointLog()
    trial.adjoint_max_iter = trial.adjoint_rtol = trial.checkpoint_every = None
    trial.backward, trial.on_failure = "implicit", "return"
    return trial


def set_solver(step: Stepper, solver: Solver, max_iter: int, rtol: float) -> None:
    # All at once: one by one, they would be checked together with those of the solver before.
    step.__dict__.update(method=solver.method, restart=solver.restart, preconditioner=solver.preconditioner)
    step.max_iter, step.rtol = max_iter, rtol


def _check_direct(trial: Trial, seconds: float) -> None:
    """ValueError where a factorisation would take too much time or memory; a device refuses it itself."""
    step, sample = trial.step, trial.sample
    n = sample[0].numel()
    if isinstance(step, Flow):
        n = math.prod(step.shape)
        most, cheap = MOST_UNKNOWNS["sparse"], step.obstacle is None  # transforms along the axes
    else:
        a = operator_of(step, sample)
        if a.kind in ("poisson", "heat") or (a.kind == "burgers" and len(a.shape) == 1):
            return
        most = MOST_UNKNOWNS["dense" if a.kind in ("dense", "function") else "sparse"]
        cheap = _C.is_sum_over_axes(sample, a.tensors, a.kind, a.shape, a.parameters)
    if sample.is_cpu and n > most and not cheap:
        raise ValueError(f"{n} unknowns are too many to factorise within the limit; at most {most}")
    set_solver(step, Direct(1), 1, 0.0)
    # The functions of a step of one's own may hold tensors of the whole batch.
    probe = sample[:1] if isinstance(step, EquationStepper) else sample
    with torch.no_grad():
        times = [now(sample)]
        while len(times) < 3 and times[-1] - times[0] <= seconds:
            trial.forget()
            step(probe)
            times.append(now(sample))
    whole = min(after - before for before, after in pairwise(times)) * len(sample) / len(probe)
    if 2 * whole > seconds:
        raise ValueError(f"the batch takes some {2 * whole:.2g} s forward and adjoint, more than {seconds:g} s")


def seconds_of_parts(step: Stepper, sample: Tensor) -> float:
    """What a step takes beside its solves, forward and backward: to make A(u) and b(u), such as by a network."""
    times = []
    for _ in range(1 + RUNS):
        u = sample.clone().requires_grad_()
        started = now(u)
        with torch.enable_grad():
            made = [step.rhs(u), *operator_of(step, u).tensors]
        made = [t for t in made if t.grad_fn is not None]
        if made:
            leaves = {leaf for t in made for leaf in torch_private.leaves_of(t)}
            torch.autograd.grad(made, list(leaves), [torch.ones_like(t) for t in made], retain_graph=True)
        times.append(now(u) - started)
    return median(times[1:])


def now(u: Tensor) -> float:
    """Seconds, when all work on the device of u is done."""
    accelerator = torch.accelerator.current_accelerator()
    if accelerator is not None and accelerator.type == u.device.type:
        torch.accelerator.synchronize(u.device)
    return time.perf_counter()
