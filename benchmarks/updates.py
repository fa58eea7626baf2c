"""An update of each scene that trains a network, with its solves and with none, on any device:
`python -m benchmarks.updates --device cuda`.

Where a solve is cheap, an update takes little more than the network's own. The updates are those of the trainer, whose
host reads the loss of each. The states are the scene's initial ones, which costs no trajectory. One JSON record a line:
the time of both, their ratio, and the residual that the solves leave.
"""

import argparse
import json
import statistics
import time
from collections.abc import Iterator
from itertools import count

import torch

from prdp_torch.experiments import datasets, network_task, scenes

SCENES = ("heat_1d", "heat_2d", "heat_3d", "burgers_1d", "burgers_2d", "navier_stokes", "kolmogorov")


class NoSolve:
    """A step that leaves the state as it is."""

    info = None

    def __call__(self, u: torch.Tensor) -> torch.Tensor:
        return u


def states_at_rest(scene) -> datasets.Data:
    """A batch of the scene's initial states, each as a trajectory that stays there."""
    some = datasets.reference(scene, 0)[:, :1]
    times = 1 + max(2, scene.executions, scene.data.valid_steps)
    still = some[torch.arange(scene.training.batch, device=some.device) % len(some)]
    still = still.expand(-1, times, *some.shape[2:])
    return datasets.of_scene(scene, (still, still[:1]))


def seconds_of_an_update(scene, steppers, data, rounds: int) -> float:
    """The median, after three that warm up."""
    task = network_task.make_task(scene, steppers, 0, None, data)

    def updates() -> Iterator[None]:
        for first in count(0, task.updates_per_interval):
            for _ in task.updates(first):
                yield

    readings, endless = [], updates()
    for _ in range(3 + rounds):
        started = time.perf_counter()
        next(endless)
        readings.append(time.perf_counter() - started)
    return statistics.median(readings[3:])


def run(device: torch.device, names=SCENES, rounds: int = 15) -> Iterator[dict]:
    """Yields a record for each scene."""
    for name in names:
        scene = scenes.placed(scenes.load(name), device)
        data = states_at_rest(scene)
        steppers = [scenes.make_stepper(scene) for _ in range(scene.executions)]
        whole = seconds_of_an_update(scene, steppers, data, rounds)
        alone = seconds_of_an_update(scene, [NoSolve()] * scene.executions, data, rounds)
        residual = max(float(stepper.info.residual.max()) for stepper in steppers)
        yield {
            "scene": name, "max_iter": scene.max_iter, "seconds": whole, "network": alone, "ratio": whole / alone,
            "residual": residual,
        }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.updates")
    parser.add_argument("--device", type=torch.device, default=torch.device("cuda"))
    parser.add_argument("--quick", action="store_true", help="one small scene, to see that all of it runs")
    options = parser.parse_args()
    for record in run(options.device, *((SCENES[:1], 1) if options.quick else ())):
        print(json.dumps(record), flush=True)


if __name__ == "__main__":
    main()
