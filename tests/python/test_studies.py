"""The studies of docs/appendix/study_*.md train what they say."""

import tomllib

import pytest
import torch

from benchmarks.studies import ratios, unroll, updates
from benchmarks.studies.trainings import REFINEMENTS, PRDPOnLoss, variant
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train


def test_prdp_on_the_loss_hears_the_mean_loss_of_each_epoch():
    scene = variant("heat_1d", {"data.train": 50, "training.epochs": 3})
    refinement = PRDPOnLoss(scene)
    curves = train(scene, refinement, callbacks=refinement.callbacks())
    losses = torch.tensor(curves["update_loss"]).view(3, 2).mean(1)
    heard = [call.metric for call in refinement._controller.history]
    assert heard == pytest.approx(losses.tolist(), rel=1e-6)


@pytest.mark.parametrize("how", ratios.WAYS[1:])
def test_a_way_of_following_the_error_is_what_its_name_says(how):
    ratio, adjoint_ratio, *start = how.split(", ")
    scene = variant("heat_1d", {"data.train": 50, "training.epochs": 3})
    seen = []

    def keep(steppers):
        controller = refinement.attach(steppers)
        seen.append((steppers[0].start, controller.settings["ratio"], controller.settings["adjoint_ratio"]))
        return controller

    refinement = REFINEMENTS[how](scene)
    curves = train(scene, Refinement("seen", keep, watches_error=refinement.watches_error))
    assert seen == [("state" if start else "zero", float(ratio), float(adjoint_ratio))]
    errors = [min([1.0, *curves["error"][: n + 1]]) for n in range(3)]
    assert curves["rtol"] == pytest.approx([float(ratio) * error for error in errors], rel=1e-6)


def test_one_unrolled_step_needs_no_gradient_through_the_solver():
    exact, none = (unroll.train("burgers_1d", 1, gradient, 0, 3) for gradient in ("exact", "none"))
    assert exact["errors"] == none["errors"]
    assert exact["adjoint_products"] == none["adjoint_products"] == 0


def test_two_unrolled_steps_tell_the_gradients_apart():
    exact, few, none = (unroll.train("burgers_1d", 2, gradient, 0, 3) for gradient in unroll.GRADIENTS)
    assert len({tuple(row["errors"]) for row in (exact, few, none)}) == 3
    assert exact["adjoint_products"] > few["adjoint_products"] > none["adjoint_products"] == 0


@pytest.mark.parametrize("epochs", updates.EPOCHS)
def test_a_longer_training_lowers_its_learning_rate_over_all_updates(epochs):
    scene = variant("navier_stokes", updates.changes_for(epochs))
    all_of_them = epochs * scene.data.train // scene.training.batch
    assert scene.training.intervals == epochs
    assert tomllib.loads(scene.text)["training"]["cosine_updates"] == all_of_them
