"""`advise`: measure which solver an equation needs, and whether refining it is worth anything."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median

import torch
from torch import Tensor

from prdp_torch import _C, _check
from prdp_torch.advice_text import Advice, call_of, dtype_name, listed, milliseconds, percent, power
from prdp_torch.flow import Flow
from prdp_torch.operators.base import full_precision
from prdp_torch.solver_trials import (
    RUNS,
    TOLERANCES,
    Row,
    candidates,
    measure,
    measure_one_iteration,
    measure_with_start,
    now,
    seconds_of_parts,
)
from prdp_torch.solvers import Direct
from prdp_torch.stepper import Stepper
from prdp_torch.steppers import EquationStepper

WORTH_REFINING = 0.1  # of an update
WORTH_TELLING = 0.1  # of the seconds of a solve
WORTH_A_START = 0.1  # of the products of a solve
NOISE = 0.1  # of the seconds of a solve
MOST_ERROR = 0.1  # of u at the loosest tolerance: what a network is off by when a controller asks for that one


@dataclass
class Update:
    """What an update consists of beside one kind of solve."""

    network: float = 0.0  # seconds
    forwards: int = 1
    adjoints: int = 1
    notes: list[str] = field(default_factory=list)

    @property
    def whole(self) -> str:
        return "an update" if self.network or self.forwards > 1 else "a step"

    def physics(self, row: Row) -> float:
        adjoint = 0.0 if row.adjoint is None else row.adjoint.seconds
        return self.forwards * row.forward.seconds + self.adjoints * adjoint

    def share(self, physics: float) -> str:
        whole = physics + self.network
        return f"{percent(physics / whole)} of an update: {milliseconds(physics)} of {milliseconds(whole)}"

    def fastest(self, rows: Sequence[Row], rtol: float) -> Row | None:
        return min((row for row in rows if row.rtol == rtol and row.solved), key=self.physics, default=None)

    def choice(self, rows: Sequence[Row], rtol: float) -> Row | None:
        """The fastest, or the direct solver if that is as fast to within the noise: it has nothing to set."""
        best = self.fastest(rows, rtol)
        direct = self.fastest([row for row in rows if isinstance(row.solver, Direct)], rtol)
        if best is None or direct is None or self.physics(direct) > (1 + NOISE) * self.physics(best):
            return best
        return direct


def advise(
    step: Stepper,
    sample: Tensor,
    seconds: float = 5.0,
    dtypes: Sequence[torch.dtype] | None = None,
    network: torch.nn.Module | None = None,
) -> Advice:
    """Try the solvers on one step and recommend one. A step of `Flow` counts as a whole, with all its solves. Nothing
    is trained, and `step` stays as it is. The solvers are timed on the device of the sample; the notes name those that
    it refuses.

    Args:
        step: a `Stepper`, such as `Heat`, `Flow` or `ImplicitStep`. Its own budget is not used.
        sample: states (batch, channel, *shape) to step from, as many as a batch of the training has.
        seconds: the limit for each solver. The table says where it came before the tolerance.
        dtypes: those to try beside that of the sample, such as (torch.float64,). None tries the other one of float32
            and float64 for the built-in steps, and none for a step of your own: its functions may hold tensors that
            `step.to(dtype)` does not reach. Its batch is never changed.
        network: what is trained, called once for each step, as network(sample). The advice then says how much of an
            update the solves take, and how much of it refinement can save. It is not changed.

    Returns:
        An `Advice`. Its `rows` hold iterations, products with A, seconds and statuses to 1e-2 and 1e-5,
        forward and adjoint, and the error of u. Its `notes` name the solvers that the operator does not allow. Its
        `recommendation` is one choice with the reason for it.

    Raises:
        TypeError, ValueError: step and sample do not fit each other, or the network has nothing to train. This is
            checked before any measurement.

    Examples:
        >>> heat = prdp.Heat((64, 64), nu=1e-3, dt=1.0, solver=prdp.CG(1))
        >>> print(prdp.advise(heat, torch.randn(8, 1, 64, 64), network=torch.nn.Conv2d(1, 1, 3, padding=1)))
    """
    if not isinstance(step, Stepper):
        raise TypeError(f"advise: step must be a Stepper such as Heat or ImplicitStep, got {type(step).__name__}")
    if type(step).operator is Stepper.operator and not isinstance(step, Flow):
        raise TypeError(
            f"advise: a step of {type(step).__name__} is not one equation A(u) u_next = b(u), as it has no "
            "operator(u); time its steps with each solver instead"
        )
    sample = full_precision(_check.dense("advise", "sample", sample))
    if sample.dim() < 2 or sample.numel() == 0 or sample.dtype not in (torch.float32, torch.float64):
        raise ValueError(
            "advise: sample must be states (batch, channel, *shape) in float32 or float64, got "
            f"{tuple(sample.shape)} in {sample.dtype}"
        )
    if not sample.isfinite().all():
        raise ValueError("advise: sample holds NaN or Inf")
    others, seconds = _other_dtypes(step, sample, dtypes), checked_limit(seconds)
    update = Update() if network is None else Update(network=network_seconds(network, sample.detach(), seconds))
    return advise_on(step, sample.detach(), seconds, update, others)


def is_built_in(step: Stepper) -> bool:
    """Whether `step.to(dtype)` reaches all of it."""
    return isinstance(step, EquationStepper | Flow)


def network_seconds(network: torch.nn.Module, sample: Tensor, most: float) -> float:
    """One forward and one backward pass: the median, without the first; for about `most` seconds, at least twice."""
    if not isinstance(network, torch.nn.Module):
        raise TypeError(f"advise: network must be a torch.nn.Module, got {type(network).__name__}")
    network = copy.deepcopy(network)  # a forward pass may change its buffers
    trained = [p for p in network.parameters() if p.requires_grad]
    if not trained:
        raise ValueError("advise: network has no parameter that requires grad")
    times: list[float] = []
    deadline = now(sample) + most
    with torch.enable_grad():
        # The first call makes what the others find, which may take more than `most`.
        while len(times) < 2 or (len(times) <= RUNS and now(sample) < deadline):
            started = now(sample)
            out = network(sample)
            if not isinstance(out, Tensor) or not out.requires_grad:
                raise TypeError("advise: network(sample) must be a tensor that depends on the parameters")
            torch.autograd.grad(out, trained, torch.ones_like(out), allow_unused=True)
            times.append(now(sample) - started)
    return median(times[1:])


def _other_dtypes(step: Stepper, sample: Tensor, dtypes: Sequence[torch.dtype] | None) -> list[torch.dtype]:
    """The dtypes to try beside that of the sample, checked."""
    both = torch.float32, torch.float64
    if dtypes is None:
        dtypes = both if is_built_in(step) else ()
    if not isinstance(dtypes, (tuple, list)) or not set(dtypes) <= set(both):
        raise ValueError(f"advise: dtypes must hold torch.float32 and torch.float64 only, got {dtypes!r}")
    return [dtype for dtype in both if dtype in dtypes and dtype != sample.dtype]


def advise_on(
    step: Stepper, sample: Tensor, seconds: float, update: Update, other_dtypes: Sequence[torch.dtype]
) -> Advice:
    """Advise on a step that is a part of `update`, an `Update`."""
    rows, sentences = measure(step, sample, candidates(step), seconds)
    best = update.choice(rows, TOLERANCES[-1])
    where = f"; threads: {torch.get_num_threads()}" if sample.is_cpu else f" on {sample.device}"
    notes = [f"Batch of {len(sample)} in {dtype_name(sample.dtype)}{where}.", *update.notes, *sentences]
    notes += _misleading(rows)
    others = []
    for other in other_dtypes:
        try:
            trials = candidates(step) if best is None else [best.solver]
            others += measure(copy.deepcopy(step).to(other), sample.to(other), trials, seconds)[0]
        except (ValueError, TypeError, RuntimeError) as error:
            notes.append(f"{dtype_name(other)} was not tried: {_C.sentence(str(error))}.")
    twin = update.fastest(others, TOLERANCES[-1])
    if best is not None and twin is not None:
        ratio = update.physics(twin) / update.physics(best)
        names = dtype_name(twin.dtype), dtype_name(sample.dtype)
        notes.append(f"{best.name} in {names[0]} takes {ratio:.2f} times the seconds of {names[1]}.")
    at_rounding = best is not None and any(solve.status == "STAGNATED" for solve in best.solves)
    if best is not None and at_rounding:
        notes.append(
            f"At {power(TOLERANCES[-1])} the residual of {best.name} is the rounding of {dtype_name(best.dtype)}. "
            "The error of u may be far smaller, or larger where A is ill-conditioned: solve it in float64 once to see."
        )
    if (best is None or at_rounding) and not other_dtypes and not is_built_in(step):
        notes.append(
            "Only the dtype of the sample was tried, as functions of the step may hold tensors of it; dtypes=... tries "
            "others."
        )
    if best is not None and not is_built_in(step):
        notes += _beside_solves(seconds_of_parts(step, sample), best)
    if best is not None and not isinstance(best.solver, Direct) and not isinstance(step, Flow):
        notes.append(_start_gain(best, measure_with_start(step, sample, best)))
    words = _recommend(step, sample, rows, best, update) if best else _fallback(rows, twin, update, seconds)
    return Advice(rows + others, notes, words)


def _beside_solves(parts: float, best: Row) -> list[str]:
    """A sentence on what every row counts, though no solver changes it."""
    whole = sum(solve.seconds for solve in best.solves)
    if parts < WORTH_TELLING * whole:
        return []
    return [
        f"To make A(u) and b(u), and their gradients, takes {milliseconds(parts)} of the {milliseconds(whole)} of "
        f"{best.name}: the step's operator and rhs, which every row counts and no solver changes."
    ]


def _start_gain(zero: Row, state: Row) -> str:
    products = f"{state.forward.products} products to {power(zero.rtol)} in place of {zero.forward.products}"
    fewer = state.forward.products < (1 - WORTH_A_START) * zero.forward.products
    worth = fewer and state.forward.status != "MAX_ITER"
    advice = 'pass start="state"' if worth else "keep the start from zero"
    return f"From the state, the forward solve of {zero.name} takes {products}: {advice}."


def _recommend(step: Stepper, sample: Tensor, rows: Sequence[Row], best: Row, update: Update) -> str:
    """The recommendation where `best` is the fastest solver to the finest tolerance."""
    physics = update.physics(best)
    refined, least, cheapest = _cheapest(step, sample, rows, best, update)
    saving = max(0.0, 1 - least / physics) * physics / (physics + update.network)
    if isinstance(best.solver, Direct):
        chosen, choice = best, "Use the direct solver, Direct()"
    elif saving < WORTH_REFINING:
        converged = call_of(best.solver, 2 * _most_iterations(best), best.rtol)
        chosen, choice = best, f"Use converged solves with {converged}"
    else:
        chosen, choice = refined, f"Refine {refined.name} with a controller, up to K = {_most_iterations(refined)}"
    loosest, finest = (power(rtol) for rtol in TOLERANCES)
    cost = (
        f"physics is {update.share(physics)}"
        if update.network
        else f"{update.whole} takes {milliseconds(physics)} with its adjoint"
    )
    if chosen.name == best.name:
        fastest = "the fastest" if best is update.fastest(rows, best.rtol) else "as fast as any"
        why = f"it is {fastest} to {finest}, and {cost}"
    else:
        why = f"it is the fastest to {loosest}. With {best.name}, the fastest to {finest}, {cost}"
    most = f"{percent(saving)} of {update.whole}, as {cheapest} takes"
    return f"{choice}: {why}. {_what_refinement_saves(saving, f'{most} {milliseconds(least)}', best)}"


def _what_refinement_saves(saving: float, amount: str, best: Row) -> str:
    if saving >= WORTH_REFINING:
        return f"Refinement can save at most {amount}."
    if saving > 0.0:
        return f"Refinement has little to save: at most {amount}."
    if _most_iterations(best) == 1 and not isinstance(best.solver, Direct):
        return "Refinement has nothing to save: one iteration is enough."
    return f"Refinement has nothing to save: no solver is faster to {power(TOLERANCES[0])}."


def _cheapest(step: Stepper, sample: Tensor, rows: Sequence[Row], best: Row, update: Update) -> tuple[Row, float, str]:
    """What to refine, the least seconds that its solves can take, and these in words. It is another solver than the
    best if that is faster to the loosest tolerance by more than the noise."""
    loosest, finest = TOLERANCES
    solved = {(row.name, row.rtol): row for row in rows if row.solved}
    candidate = update.fastest([row for row in rows if not isinstance(row.solver, Direct) and is_useful(row)], loosest)
    if candidate is not None and candidate.name != best.name:
        reference = best if isinstance(best.solver, Direct) else solved.get((best.name, loosest), best)
        if update.physics(candidate) < (1 - NOISE) * update.physics(reference):
            refined = solved.get((candidate.name, finest), candidate)
            return refined, update.physics(candidate), f"{candidate.name} to {power(loosest)}"
    if isinstance(best.solver, Direct) or _most_iterations(best) == 1:
        return best, update.physics(best), ""
    return best, update.physics(measure_one_iteration(step, sample, best.solver)), "a single iteration"


def is_useful(row: Row) -> bool:
    return row.error is None or row.error <= MOST_ERROR


def _misleading(rows: Sequence[Row]) -> list[str]:
    """A sentence on the solvers whose residual says too much."""
    loosest = TOLERANCES[0]
    wrong = [row for row in rows if row.solved and row.rtol == loosest and not is_useful(row)]
    if not wrong:
        return []
    worst = max(row.error or 0.0 for row in wrong)
    return [
        f"At {power(loosest)}, {listed([row.name for row in wrong])} leave u off by up to {percent(worst)}: b is "
        "mostly what does not change u, such as values on the sides, or A is ill-conditioned. Solve for the change of "
        "u, or take a finer rtol; a controller cannot tell."
    ]


def _most_iterations(row: Row) -> int:
    return max(solve.iterations for solve in row.solves)


def _fallback(rows: Sequence[Row], twin: Row | None, update: Update, seconds: float) -> str:
    """The recommendation where no solver reaches the finest tolerance in the dtype of the sample."""
    loosest, finest = (power(rtol) for rtol in TOLERANCES)
    if twin is not None:
        return f"Use {dtype_name(twin.dtype)} with {twin.name}: no solver reaches {finest} in the dtype of the sample."
    best = update.fastest(rows, TOLERANCES[0])
    if best is not None:
        return (
            f"Use {best.name} with rtol={loosest}, the fastest to it: a search of {seconds:g} s found none "
            f"that reaches {finest}."
        )
    is_single = rows[0].dtype == torch.float32
    stalled = [row.name for row in rows if is_single and row.status in ("STAGNATED", "BREAKDOWN")]
    other = f"try float64, as {listed(stalled)} stop at the rounding of float32; or " if stalled else ""
    return (
        f"A search of {seconds:g} s found no solver that reaches {loosest}: {other}take a shorter time step or a "
        "smaller grid, or look for a mistake with prdp.check_operator."
    )


def checked_limit(seconds: float) -> float:
    """The limit for each solver, checked."""
    if not 0 < _check.real("advise", "seconds", seconds) < float("inf"):
        raise ValueError(f"advise: seconds must be a number > 0, got {seconds}")
    return float(seconds)
