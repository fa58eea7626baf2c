"""What trained networks do: the arrays behind the pictures, their files, and what --resume makes of them."""

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from helpers import dense_burgers, dense_heat, written
from PIL import Image
from test_corrector import cache, tiny  # noqa: F401, cache is a fixture of every test here

import prdp_torch as prdp
from prdp_torch import fields
from prdp_torch.experiments import _C, compare, report, scenes, trajectories, trajectory_charts
from prdp_torch.experiments.networks import make_network

PRDP = [sys.executable, "-m", "prdp_torch"]
DOUBLE = ('"float32"', '"float64"')


def heat(tmp_path, *changes):
    short = (("epochs = 100", "epochs = 2"), ("constant = [1, 2, 3, 5, 7, 10, 15, 25]", "constant = [25]"))
    return scenes.load(written(tmp_path, *short, ("growth = 1.5", ""), DOUBLE, *changes))


def flow(tmp_path, *changes):
    return scenes.load(tiny(tmp_path, DOUBLE, ("epochs = 5", "epochs = 1"), *changes))


def trained(scene, folder, seeds=1, resume=False):
    rows = compare.run(scene, seeds, folder, resume)
    return rows, trajectories.collect(scene, rows, folder)


def random_flow(ny, nx, samples, seed):
    """As flow_data.h says, in torch."""
    noise = torch.randn(samples, 2, ny, nx, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    ky, kx = (torch.arange(n, dtype=torch.float64) for n in (ny, nx // 2 + 1))
    waves = (2 * ny * torch.sin(math.pi / ny * ky)[:, None]) ** 2 + (2 * nx * torch.sin(math.pi / nx * kx)) ** 2
    u = torch.fft.irfft2(torch.fft.rfft2(noise) / (1 + 3e-3 * waves), s=(ny, nx))
    u = u - u.mean((-2, -1), keepdim=True)
    u = fields.project(u / u.square().mean((-2, -1), keepdim=True).sqrt())
    return torch.cat([u, torch.zeros(samples, 1, ny, nx, dtype=torch.float64)], dim=1)


def test_the_reference_of_heat_is_that_of_a_dense_solve(tmp_path):
    scene = heat(tmp_path)
    reference = _C.validation_trajectories(scene, 8)
    assert reference.shape == (5, 9, 1, 30) and torch.equal(reference[:, 0], _C.make_dataset(scene).valid_start)
    expected = reference[:, 0, 0].numpy()
    for n in range(9):
        np.testing.assert_allclose(reference[:, n, 0], expected, rtol=0, atol=1e-11)
        expected = np.linalg.solve(dense_heat((30,)), expected.T).T


def test_the_reference_of_burgers_is_that_of_a_dense_solve(tmp_path):
    scene = scenes.load(written(tmp_path, ("shape = [256]", "shape = [40]"), DOUBLE, scene="burgers_1d"))
    reference = _C.validation_trajectories(scene, 6)
    expected = reference[0, 0].numpy()
    for n in range(7):
        np.testing.assert_allclose(reference[0, n], expected, rtol=0, atol=1e-10)
        expected = np.linalg.solve(dense_burgers(expected, 1e-3, 1e-2), expected.ravel())[None]


def test_the_reference_of_a_flow_is_the_fine_one_down_sampled(tmp_path):
    reports = []
    reference = _C.validation_trajectories(flow(tmp_path), 7, lambda *report: reports.append(report))
    assert reports == [(2 * n, 14) for n in range(1, 8)]
    exact = prdp.NavierStokes([17, 17], 1e-4, 0.1, prdp.Direct())
    fine = fields.rollout(exact, random_flow(17, 17, 8 + 2, seed=0)[8:], 7)
    expected = torch.stack([fields.downsample(state) for state in fine.unbind(1)], dim=1)
    torch.testing.assert_close(reference, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("steps, make", [(-1, heat), (1, lambda _: scenes.load("poisson_1p"))])
def test_no_reference_of_a_task_without_samples_or_of_fewer_than_no_steps(tmp_path, steps, make):
    with pytest.raises(ValueError, match="validation_trajectories: "):
        _C.validation_trajectories(make(tmp_path), steps)


@pytest.mark.parametrize("make, metric", [(heat, 2), (flow, 5)])
def test_the_error_at_the_step_of_the_metric_is_the_recorded_metric(tmp_path, make, metric):
    rows, shown = trained(make(tmp_path), tmp_path, seeds=2)
    recorded = {row.title: row.final() for row in rows}
    courses = [course for course in shown.courses if course.kind != "coarse"]
    assert [course.kind for course in courses] == ["converged", "auto", "prdp"] and not shown.missing
    for course in courses:
        assert course.errors.shape == (2, 4 * metric)
        np.testing.assert_allclose(course.errors[:, metric - 1], recorded[course.title], rtol=1e-9)


def test_corrected_and_coarse_solver_are_told_apart(tmp_path):
    """Both against exact steps, written out here."""
    scene = flow(tmp_path, ("rtol = 1e-5", "rtol = 1e-12"), ("valid_max_iter = 120", "valid_max_iter = 400"))
    _, shown = trained(scene, tmp_path)
    coarse, converged, *_ = shown.courses
    exact = prdp.NavierStokes([8, 8], 1e-4, 0.1, prdp.Direct())
    torch.testing.assert_close(coarse.states, fields.rollout(exact, shown.reference[:, 0], 20), rtol=0, atol=1e-8)
    network = make_network(scene, 0)
    network.load_state_dict(torch.load(tmp_path / "converged/seed_0.pt"))

    def corrected(u):
        with torch.no_grad():
            return exact(u) + network(exact(u))

    expected = fields.rollout(corrected, shown.reference[:, 0], 3)
    torch.testing.assert_close(converged.states[:, :4], expected, rtol=0, atol=1e-8)
    u, reference = coarse.states[:, 9, 0].flatten(1), shown.reference[:, 9, 0].flatten(1)
    assert coarse.errors[0, 8] == pytest.approx(
        float(((u - reference).norm(dim=1) / reference.norm(dim=1)).square().mean())
    )


def test_resume_reads_the_weights_instead_of_training_again(tmp_path, monkeypatch):
    scene = heat(tmp_path)
    _, first = trained(scene, tmp_path)
    monkeypatch.setattr(compare, "train", lambda *_: pytest.fail("trained again"))
    _, again = trained(scene, tmp_path, resume=True)
    for before, after in zip(first.courses, again.courses, strict=True):
        assert torch.equal(before.states, after.states) and np.array_equal(before.errors, after.errors)


def test_trainings_without_weights_or_that_diverged_are_left_out_and_named(tmp_path):
    scene = heat(tmp_path)
    rows, _ = trained(scene, tmp_path)
    (tmp_path / "prdp/seed_0.pt").unlink()  # as records of the C++ trainer, or of an older version
    shown = trajectories.collect(scene, rows, tmp_path)
    assert [course.kind for course in shown.courses] == ["converged", "auto"] and shown.missing == ["PRDP"]
    drawn = trajectory_charts.pictures(scene, shown)
    assert len(drawn) == 2 and all("Left out, for want of weights: PRDP." in caption for _, _, caption in drawn)
    (tmp_path / "auto/seed_0.pt").unlink()
    next(row for row in rows if row.kind == "converged").curves[0]["diverged"] = "interval 1: the loss is nan"
    assert trajectories.collect(scene, rows, tmp_path) is None
    assert trajectories.collect(scenes.load("poisson_1p"), [], tmp_path) is None


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(path.read_bytes()[:300]),
        lambda path: path.write_text(""),
        lambda path: torch.save({"other": torch.ones(2)}, path),
        lambda path: torch.save({k: v + 1 for k, v in torch.load(path).items()}, path),
    ],
)
def test_weights_that_do_not_fit_are_refused_with_the_remedy(tmp_path, damage):
    scene = heat(tmp_path)
    rows, _ = trained(scene, tmp_path)
    path = tmp_path / "prdp/seed_0.pt"
    damage(path)
    with pytest.raises(ValueError, match=f"weights: '{path}' is damaged or not of the record beside it; delete both"):
        trajectories.collect(scene, rows, tmp_path)


def images(figure):
    return [axes.get_images()[0] for axes in figure.axes if axes.get_images()]


def test_space_time_shows_the_first_sample_and_the_differences(tmp_path):
    scene = heat(tmp_path)
    _, shown = trained(scene, tmp_path)
    runs = (shown.reference, *(course.states for course in shown.courses))
    u, converged, by_auto, by_prdp = (states[0, :, 0].numpy() for states in runs)
    drawn = images(trajectory_charts.space_time(scene, shown))
    wanted = [u, converged, by_auto, by_prdp, by_prdp - converged, converged - u, by_auto - u, by_prdp - u]
    for image, expected in zip(drawn, wanted, strict=True):
        np.testing.assert_array_equal(image.get_array(), expected)
        # A pixel's centre is its unknown's place and its step.
        np.testing.assert_allclose(image.get_extent(), [0.5 / 31, 30.5 / 31, -0.5, 8.5])
    assert len({image.get_clim() for image in drawn[:4]}) == 1 == len({image.get_clim() for image in drawn[4:]})


def test_snapshots_show_the_vorticity_each_time_in_the_scale_of_the_reference(tmp_path):
    scene = flow(tmp_path)
    _, shown = trained(scene, tmp_path)
    drawn = images(trajectory_charts.snapshots(scene, shown))
    panels = np.array(drawn, dtype=object).reshape(5, 4)
    for run, line in zip([shown.reference, *(course.states for course in shown.courses)], panels, strict=True):
        for u, image, above in zip(run[0, [2, 5, 10, 20]].numpy(), line, panels[0], strict=True):
            vorticity = 8 * ((u[1] - np.roll(u[1], 1, 1)) - (u[0] - np.roll(u[0], 1, 0)))
            np.testing.assert_allclose(image.get_array(), vorticity, rtol=0, atol=1e-12)
            assert image.get_clim()[1] == -image.get_clim()[0] == pytest.approx(np.abs(above.get_array()).max())
            assert image.origin == "lower"


def test_a_run_that_blows_up_does_not_take_the_pictures_along(tmp_path):
    scene = flow(tmp_path)
    _, shown = trained(scene, tmp_path)
    shown.courses[2].states[:, 12:] = math.nan
    shown.courses[2].errors[:, 11:] = math.inf
    for name, figure, _ in trajectory_charts.pictures(scene, shown):
        figure.savefig(tmp_path / f"{name}.png")
    trajectory_charts.animate(scene, shown, tmp_path / "a.gif")


@pytest.mark.parametrize(
    "shape, names", [("[6, 5]", ["error_over_time", "snapshots"]), ("[4, 5, 3]", ["error_over_time"])]
)
def test_emulators_of_more_dimensions_have_pictures_too(tmp_path, shape, names):
    scene = heat(tmp_path, ("shape = [30]", f"shape = {shape}"))
    rows, shown = trained(scene, tmp_path)
    assert [name for name, _, _ in trajectory_charts.pictures(scene, shown)] == names
    report.write(scene, rows, compare.summarise(scene, rows), shown, tmp_path)
    assert (tmp_path / "trajectories.gif").exists() == ("snapshots" in names)


def test_the_report_holds_the_pictures_also_after_resume(tmp_path):
    command = [*PRDP, "compare", tiny(tmp_path), "--intervals", "1"]
    for options in ([], ["--resume"]):
        done = subprocess.run([*command, *options], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        folder = tmp_path / "runs/tiny"
        html = (folder / "report.html").read_text()
        assert "What the trained networks do" in html and html.count("data:image/svg+xml") == 6
        assert html.count('src="data:image/gif;base64,') == 1
        assert all((folder / f"{name}.png").stat().st_size > 10_000 for name in ("error_over_time", "snapshots"))
        with Image.open(folder / "trajectories.gif") as animation:
            assert animation.n_frames == 21 and animation.width >= 600
        assert (folder / "trajectories.gif").stat().st_size < 2_000_000
        for path in (folder / "report.html", folder / "snapshots.png", folder / "trajectories.gif"):
            path.unlink()


def test_making_data_is_shown_as_a_bar_and_reading_them_is_not(tmp_path):
    command = [*PRDP, "train", tiny(tmp_path), "--prdp", "--intervals", "1"]
    made, read = (subprocess.run(command, cwd=tmp_path, capture_output=True, text=True) for _ in range(2))
    assert made.returncode == 0 == read.returncode
    assert made.stdout.count("data, steps") == 1 and "26/26" in made.stdout
    assert "data" not in read.stdout and made.stderr == ""
    assert read.stderr.startswith("prdp: replaces when it ends: ") and read.stderr.count("\n") == 1


def test_a_reference_shorter_than_the_pictures_want_is_shown_as_far_as_it_goes():
    """As from a data file that ends soon after the step of the metric."""
    scene = scenes.load("heat_2d")
    states = torch.rand(2, scene.data.valid_steps + 1, 1, *scene.physics.shape)
    short = trajectories.Trajectories(states, [trajectories.Course("auto", "auto", states, np.ones((1, 2)))], [])
    figure = trajectory_charts.snapshots(scene, short)
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles[-1] == f"t = {scene.data.valid_steps}"
