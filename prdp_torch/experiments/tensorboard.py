"""`TensorBoard`: the curves of a training as TensorBoard shows them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from prdp_torch.experiments.training import Interval


class TensorBoard:
    """Write each interval of a training to a folder for TensorBoard. A callback of `training.train`.

    Args:
        folder: for the event files; each training needs its own.

    Raises:
        ImportError: the package tensorboard is not installed.

    Examples:
        >>> training.train(scene, refinement, callbacks=[TensorBoard("runs/heat_1d/tensorboard")])
    """

    def __init__(self, folder: str | Path) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise ImportError("TensorBoard: the package tensorboard is missing; pip install tensorboard") from None
        # A training that is repeated or resumed writes its first interval again: what lay there before is hidden.
        self._writer = SummaryWriter(str(folder), purge_step=0)

    def __call__(self, interval: Interval) -> None:
        values = {
            "training/loss": interval.loss,
            "training/metric": interval.metric,
            "training/error": interval.error,
            "training/seconds": interval.seconds,
            "solver/max_iter": interval.max_iter,
            "solver/rtol": interval.rtol,
            "solver/iterations": interval.iterations,
            "solver/products": interval.operator_applications,
            "solver/adjoint_products": interval.adjoint_applications,
            "solver/failed": interval.failed,
        }
        for name, value in values.items():
            self._writer.add_scalar(name, value, interval.number)
        self._writer.flush()
