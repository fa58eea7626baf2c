"""The tasks "emulator" and "corrector": a network in place of the equation, or on top of a coarse step."""

import math
from collections.abc import Callable, Iterator
from typing import TypeAlias

import torch
from torch import Tensor

from prdp_torch import data_parallel, fields
from prdp_torch.experiments import _C, datasets
from prdp_torch.experiments.checkpoint import load_optimiser, make_optimiser, state_of
from prdp_torch.experiments.networks import make_network
from prdp_torch.experiments.scenes import make_stepper
from prdp_torch.experiments.task import Task
from prdp_torch.solve import detach_failed
from prdp_torch.stepper import Stepper

Data: TypeAlias = datasets.Data | _C.Dataset
Loss: TypeAlias = Callable[[Tensor], Tensor]
"""Of the numbers of a batch's samples."""


def make_task(scene: _C.Scene, steppers: list[Stepper], seed: int, network: torch.nn.Module | None, data: Data) -> Task:
    """An interval is an epoch, the metric that of validation."""
    train = _TrainingSamples(scene, data)
    data_parallel.check_batches(train.count, scene.training.batch)
    if network is None:
        network = make_network(scene, seed).to(scene.device)
    else:
        if isinstance(network, torch.nn.Module):
            network.to(scene.device)
        datasets.check_network(scene, network, data.train_start[:1])
    objective = _emulator if scene.task == "emulator" else _corrector
    loss_of = data_parallel.shared_loss(network, objective(scene, steppers, train, network), scene.device)
    optimiser = make_optimiser(scene, network.parameters())
    generator = torch.Generator().manual_seed(seed)

    def updates(first: int) -> Iterator[tuple[float, Tensor | None]]:
        train.begin(first)
        order = torch.randperm(train.count, generator=generator).to(scene.device)
        for number, batch in enumerate(order.split(scene.training.batch), first):
            for group in optimiser.param_groups:
                group["lr"] = scene.learning_rate(number)
            optimiser.zero_grad()
            loss, part = loss_of(batch)
            part.backward()
            optimiser.step()
            yield float(loss.detach()), data_parallel.share(batch)

    def state() -> dict[str, Tensor]:
        weights = {f"network.{name}": value for name, value in network.state_dict().items()}
        return {**weights, **state_of(optimiser), "shuffling": generator.get_state()}

    def load(saved: _C.Saved, updates: int) -> None:
        trained = load_optimiser(saved, optimiser, updates)
        parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
        finite = {id(parameters[i]) for i in trained}  # a buffer, such as a mask, may hold Inf
        network.load_state_dict(
            {
                name: saved.take(f"network.{name}", value, finite=id(value) in finite)
                for name, value in network.state_dict(keep_vars=True).items()
            }
        )
        saved.restore("shuffling", generator)

    # The metric is a mean of squares, relative to the reference, after so many steps; their errors add up.
    def of_a_step(metric: float) -> float:
        return math.sqrt(metric) / scene.data.valid_steps

    return Task(updates, _metric(scene, data, network), of_a_step, state, load, train.updates_per_epoch)


class _TrainingSamples:
    """Start, end and the states between of the training samples: the same in every epoch, or those of `data.fresh`."""

    def __init__(self, scene: _C.Scene, data: Data) -> None:
        self.count = len(data.train_start)
        self.updates_per_epoch = math.ceil(self.count / scene.training.batch)
        self._fresh = _C.FreshData(scene, data) if scene.data.fresh and isinstance(data, _C.Dataset) else None
        self._take(data)

    def begin(self, update: int) -> None:
        """Take the samples of the epoch that begins with this update."""
        if self._fresh is not None:
            self._take(self._fresh.epoch(update // self.updates_per_epoch))

    def _take(self, data: Data) -> None:
        self.start, self.between, self.end = data.train_start, data.train_between, data.train_end


def _metric(scene: _C.Scene, data: Data, network: torch.nn.Module) -> Callable[[], float]:
    step = propagator(scene, network)
    start, end = data_parallel.share(data.valid_start), data_parallel.share(data.valid_end)

    def metric() -> float:
        mine = math.nan  # of a process without a sample
        if len(start):
            with datasets.evaluating(network):
                mine = error(scene, fields.rollout(step, start, scene.data.valid_steps)[:, -1], end)
        return data_parallel.mean([mine], len(start))[0]

    return metric


def _emulator(scene: _C.Scene, steppers: list[Stepper], train: _TrainingSamples, network: torch.nn.Module) -> Loss:
    """The loss of a batch: the network in place of the equation."""
    (stepper,) = steppers

    def loss(batch: Tensor) -> Tensor:
        u2 = stepper(network(train.start[batch]))
        return _C.loss(scene.training.loss, u2, train.end[batch])

    return loss


def corrected(stepper: Stepper, network: Callable[[Tensor], Tensor], u: Tensor) -> Tensor:
    """Make a step of the task "corrector": a step of the coarse solver from u, with the network on top. The mean of
    its pressure is removed in between."""
    coarse = _C.without_mean_pressure(stepper(u))
    return coarse + network(coarse)


def _corrector(scene: _C.Scene, steppers: list[Stepper], train: _TrainingSamples, network: torch.nn.Module) -> Loss:
    """The loss of a batch: the network on top of coarse steps in a row."""

    def loss(batch: Tensor) -> Tensor:
        u, sum_of_steps = train.start[batch], torch.zeros(())
        worst: Tensor | None = None
        for number, stepper in enumerate(steppers):
            seen = u = corrected(stepper, network, u)
            if scene.on_failure == "zero_grad" and stepper.info:
                # The network's share is no better than the coarse steps below it.
                worst = stepper.info.status if worst is None else torch.minimum(worst, stepper.info.status)
                seen = detach_failed(u, stepper.info._replace(status=worst))
            reference = train.between[batch, number] if number + 1 < len(steppers) else train.end[batch]
            sum_of_steps = sum_of_steps + _C.loss(scene.training.loss, seen, reference)
        return sum_of_steps

    return loss


def propagator(scene: _C.Scene, network: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """Return a trained network as a function that makes one time step. This is the network itself; for the task
    "corrector" it is a converged step of the coarse solver, corrected by the network."""
    if scene.task == "emulator":
        return network
    converged = make_stepper(scene, max_iter=scene.data.valid_max_iter)
    return lambda u: corrected(converged, network, u)


def error(scene: _C.Scene, u: Tensor, reference: Tensor) -> float:
    """Return the validation error of states u: the mean over the samples of (‖u - reference‖ / ‖reference‖)². For a
    corrector only the velocity along x counts."""
    of = slice(0, 1) if scene.task == "corrector" else slice(None)
    return float(_C.normalised_mse(u[:, of], reference[:, of]))
