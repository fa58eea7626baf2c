"""The Python trainer. One loop a kind of task; data, losses and metrics come from the library, the
network may be any `nn.Module`. `csrc/train` holds the same loops in C++."""

import time

import torch

from prdp_torch import _C
from prdp_torch.controller import LinearSchedule, PRDPController
from prdp_torch.networks import make_network
from prdp_torch.scenes import make_stepper


class Refinement:
    """How a training chooses K: `label` for the records, `attach` to make the controller."""

    def __init__(self, label, attach, direct=False):
        self.label = label
        self.attach = attach
        self.direct = direct

    @classmethod
    def prdp(cls, scene, growth=None):
        settings = dict(scene.prdp)
        if growth is not None:
            settings["growth"] = growth
        label = "prdp" if growth is None else f"prdp_growth_{growth:g}"
        return cls(label, lambda steppers: PRDPController(steppers, **settings))

    @classmethod
    def constant(cls, k):
        return cls.schedule(k, 0, k, label=f"constant_{k}")

    @classmethod
    def schedule(cls, start, step, maximum, label=None):
        return cls(
            label or f"schedule_{start}_{step}",
            lambda steppers: LinearSchedule(steppers, initial=start, increment=step, maximum=maximum),
        )

    @classmethod
    def exact(cls):
        return cls("direct", lambda steppers: LinearSchedule(steppers, initial=1, increment=0, maximum=1), direct=True)


class Tally:
    """Adds up what the solves of an interval cost."""

    def __init__(self):
        self.intervals = {name: [] for name in ("max_iter", "budget", "iterations", "operator_applications", "seconds")}

    def begin(self, k):
        self._k, self._updates, self._iterations, self._applications = k, 0, 0.0, 0.0
        self._started = time.perf_counter()

    def add(self, stepper):
        """Count the update that just went through this stepper, per sample of the batch."""
        self._updates += 1
        self._iterations += float(stepper.info.iterations.double().mean())
        self._applications += float(stepper.info.operator_applications.double().mean())
        adjoint = stepper.adjoint_info
        if adjoint is not None:
            self._applications += float(adjoint.operator_applications.double().mean())

    def end(self):
        row = (
            self._k,
            self._k * self._updates,
            self._iterations,
            self._applications,
            time.perf_counter() - self._started,
        )
        for name, value in zip(self.intervals, row, strict=True):
            self.intervals[name].append(value)


def train(scene, refinement, seed=0, network=None, on_interval=None):
    """Train the scene once. Returns the curves as a dict of lists, one entry an interval (an epoch,
    or an update of the task "parameters"); "metric" starts before the first interval.

    Args:
        scene: from `prdp_torch.scenes.load`.
        refinement: a `Refinement`.
        seed: of the network's weights and of the shuffling; the data stay the same.
        network: any module from (batch, 1, *shape) to the same shape; the scene's own where None.
        on_interval: called after each interval with (how many are done, the metric, K).
    """
    loop = _train_emulator if scene.task == "emulator" else _train_parameters
    return loop(scene, refinement, seed, network, on_interval or (lambda *report: None))


def _train_emulator(scene, refinement, seed, network, on_interval):
    data = _C.make_dataset(scene)
    network = make_network(scene, seed) if network is None else network
    stepper = make_stepper(scene, refinement.direct)
    controller = refinement.attach([stepper])
    optimiser = torch.optim.Adam(network.parameters(), lr=scene.learning_rate(0), fused=True)
    generator = torch.Generator().manual_seed(seed)

    def validate():
        with torch.no_grad():
            return float(_C.normalised_mse(network(network(data.valid_start)), data.valid_end))

    update_loss, metrics, tally = [], [validate()], Tally()
    controller.step(metrics[-1])
    for epoch in range(scene.training.epochs):
        tally.begin(stepper.max_iter)
        for batch in torch.randperm(len(data.train_start), generator=generator).split(scene.training.batch):
            for group in optimiser.param_groups:
                group["lr"] = scene.learning_rate(len(update_loss))
            optimiser.zero_grad()
            u2 = stepper(network(data.train_start[batch]))
            loss = _C.loss(scene.training.loss, u2, data.train_end[batch])
            loss.backward()
            optimiser.step()
            update_loss.append(float(loss.detach()))
            tally.add(stepper)
        tally.end()
        metrics.append(validate())
        controller.step(metrics[-1])
        on_interval(epoch + 1, metrics[-1], stepper.max_iter)
    return {"update_loss": update_loss, "metric": metrics, **tally.intervals}


def _train_parameters(scene, refinement, seed, network, on_interval):
    problem = _C.make_parameter_problem(scene)
    stepper = make_stepper(scene, refinement.direct)
    controller = refinement.attach([stepper])
    theta = problem.start.clone().requires_grad_()
    update_loss, tally = [], Tally()
    metrics = [float(_C.relative_error(theta.detach(), problem.reference))]
    controller.step(metrics[-1])
    for update in range(scene.training.updates):
        tally.begin(stepper.max_iter)
        u = stepper((theta @ problem.modes)[None, None])
        loss = _C.half_mse(u, problem.solution)
        (gradient,) = torch.autograd.grad(loss, theta)
        with torch.no_grad():
            theta -= scene.learning_rate(update) * gradient
        update_loss.append(float(loss.detach()))
        tally.add(stepper)
        tally.end()
        metrics.append(float(_C.relative_error(theta.detach(), problem.reference)))
        controller.step(metrics[-1])
        on_interval(update + 1, metrics[-1], stepper.max_iter)
    return {"update_loss": update_loss, "metric": metrics, **tally.intervals}
