"""The reports of an update's solves on the host, and what is counted of them."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from prdp_torch.solve import SolveInfo, SolveStatus


class Report(NamedTuple):
    """What a trainer reads of a `SolveInfo`: tensors of shape (batch,), or (batch, steps) of a rollout, on the CPU."""

    iterations: Tensor
    operator_applications: Tensor
    status: Tensor


def on_host(infos: Iterable[SolveInfo | None]) -> list[Report]:
    """The reports that there are. Each is one copy from its device, for which the host waits."""
    reports = []
    for info in infos:
        if info is None:
            continue
        report = Report(info.iterations, info.operator_applications, info.status)
        on_cpu = info.status.device.type == "cpu"
        reports.append(report if on_cpu else Report(*torch.stack(report).cpu()))
    return reports


def any_nonfinite(reports: Sequence[Report]) -> bool:
    """Whether a solver was given NaN or Inf."""
    return any(bool((report.status <= SolveStatus.NONFINITE_INPUT).any()) for report in reports)


def spent_on(reports: Sequence[Report], adjoints: Sequence[Report]) -> tuple[float, float, float]:
    """Iterations, operator applications and adjoint applications, per sample."""
    return (
        sum((_per_sample(report.iterations) for report in reports), 0.0),
        sum((_per_sample(report.operator_applications) for report in reports), 0.0),
        sum((_per_sample(report.operator_applications) for report in adjoints), 0.0),
    )


def _per_sample(counts: Tensor) -> float:
    """Summed over the steps."""
    return float(counts.double().mean(0).sum())
