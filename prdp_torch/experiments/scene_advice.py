"""`prdp advise SCENE`: what `prdp_torch.advise` measures for a step, with the scene's network beside it."""

import torch

from prdp_torch.advice import Update, advise_on, checked_limit, network_seconds
from prdp_torch.advice_text import Advice, milliseconds
from prdp_torch.experiments import _C, datasets, field_task
from prdp_torch.experiments.networks import make_network
from prdp_torch.experiments.scenes import make_solver, make_stepper
from prdp_torch.implicit_step import ImplicitStep
from prdp_torch.solver_trials import RUNS, run, trial_of


def advise_scene(scene: _C.Scene, seconds: float = 5.0) -> Advice:
    """Advise on a scene from `prdp_torch.experiments.scenes.load`, as `advise` does on a step.

    It uses a batch of the scene's initial states, and times a forward and backward pass of its untrained network. The
    step of a scene that finds a field has the field that is to be found."""
    _C.find_device(str(scene.device))
    seconds, step, update = checked_limit(seconds), make_stepper(scene), Update()
    if scene.task == "field":
        assert isinstance(step, ImplicitStep)
        steps = 1 if scene.physics.equation == "darcy" else scene.field.steps
        sample, update = field_task.take_reference(scene, step), Update(0.0, steps, steps)
        update.notes.append("The field is the one that is to be found.")
        if steps > 1:
            update.notes.append(
                f"An update makes {steps} steps with one A, whose factors or grids count {steps} times."
            )
    elif scene.task == "parameters":
        problem = _C.make_parameter_problem(scene)
        sample = (problem.start @ problem.modes)[None, None]
    else:
        states = datasets.reference(scene, 0)[:, 0]
        sample = states[torch.arange(scene.training.batch, device=scene.device) % len(states)]
        network = make_network(scene, 0).to(scene.device)
        # A corrector's first solve starts from data, which need no gradient.
        adjoints = 0 if scene.backward == "none" else 1
        update = Update(scene.executions * network_seconds(network, sample, seconds), scene.executions, adjoints)
    other = torch.float64 if sample.dtype == torch.float32 else torch.float32
    trial, solver = trial_of(step, sample), make_solver(scene, scene.max_iter)
    run(trial, solver)  # to warm up
    physics = update.physics(run(trial, solver, RUNS))
    update.notes.append(
        f"As the scene sets it, with {scene.method}, K = {scene.max_iter}, {scene.backward}, physics is "
        f"{update.share(physics)}."
    )
    if update.network > physics and scene.dtype == torch.float32:
        with torch.autocast(sample.device.type, torch.bfloat16):
            low = scene.executions * network_seconds(network, sample, seconds)
        update.notes.append(
            f"The network is the larger part, {milliseconds(update.network)}; in bfloat16 autocast it takes "
            f"{milliseconds(low)}, {low / update.network:.2g} times that."
        )
    # The tensors of a field's step are made by the task.
    return advise_on(step, sample, seconds, update, [] if scene.task == "field" else [other])
