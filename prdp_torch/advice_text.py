"""How an advice reads: its table, and the numbers, names and calls in its sentences."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from prdp_torch.solver_trials import Row, preconditioner_of
from prdp_torch.solvers import GMRES, Solver


@dataclass
class Advice:
    """What `advise` found. `str(advice)` is the table, the notes and the recommendation."""

    rows: list[Row]
    notes: list[str]
    recommendation: str

    def table(self) -> str:
        """The rows as lines of aligned text; the error is that of u."""
        lines: list[tuple[str, ...]] = [("solver", "rtol", "products", "ms", "adjoint", "ms", "error", "status")]
        for before, row in zip([None, *self.rows], self.rows, strict=False):
            if before is not None and before.dtype != row.dtype:
                lines.append((f"in {dtype_name(row.dtype)}:", *[""] * (len(lines[0]) - 1)))
            costs = ["", ""] * 2
            for i, solve in enumerate(row.solves):
                costs[2 * i : 2 * i + 2] = str(solve.products), _short(1e3 * solve.seconds)
            error = "" if row.error is None else power(row.error) if row.error else "0"
            status = "time limit" if row.may_go_on else row.status
            lines.append((row.name, power(row.rtol), *costs, error, status))
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        align = (str.ljust,) * 2 + (str.rjust,) * 5 + (str.ljust,)
        lines.insert(1, tuple("─" * width for width in widths))
        cells = ([put(cell, width) for put, cell, width in zip(align, line, widths, strict=True)] for line in lines)
        return "\n".join("  ".join(line).rstrip() for line in cells)

    def words(self) -> str:
        """What stands below the table."""
        return "\n".join([*self.notes, "", self.recommendation])

    def __str__(self) -> str:
        return f"{self.table()}\n\n{self.words()}"


def listed(names: Sequence[str]) -> str:
    """ "A", "A and B", "A, B and C"."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def call_of(solver: Solver, max_iter: int, rtol: float) -> str:
    extra = f", restart={solver.restart}" if isinstance(solver, GMRES) else ""
    if preconditioner_of(solver) is not None:
        extra += f", preconditioner={solver.preconditioner!r}"
    return f"{type(solver).__name__}(max_iter={max_iter}, rtol={power(rtol)}{extra})"


def dtype_name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _short(ms: float) -> str:
    return f"{ms:.3g}" if ms < 1000 else f"{ms:.0f}"


def milliseconds(seconds: float) -> str:
    return f"{_short(1e3 * seconds)} ms"


def percent(share: float) -> str:
    return f"{share:.1%}" if share < 0.01 else f"{share:.0%}"


def power(rtol: float) -> str:
    return f"{rtol:.0e}".replace("e-0", "e-")
