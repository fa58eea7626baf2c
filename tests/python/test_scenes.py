"""Scene files: what they say is read, and what is wrong in them is said with file and line."""

import pytest
import torch

from prdp_torch import _C, scenes
from prdp_torch.networks import MLP, make_network


def written(tmp_path, *changes, scene="heat_1d"):
    """A copy of a scene with replacements."""
    text = scenes.available()[scene].read_text()
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    path = tmp_path / "changed.toml"
    path.write_text(text)
    return str(path)


def line_of(path, text):
    with open(path) as file:
        return next(number for number, line in enumerate(file, 1) if text in line)


def test_the_projects_scenes_hold_the_papers_settings():
    heat = scenes.load("heat_1d")
    assert (heat.method, heat.max_iter, heat.rtol, heat.backward) == ("jacobi", 25, 1e-5, "implicit")
    assert (heat.physics.shape, heat.physics.nu, heat.physics.dt) == ([30], 1e-3, 1.0)
    assert (heat.data.train, heat.data.valid, heat.training.batch, heat.training.intervals) == (200, 5, 25, 100)
    assert heat.prdp == {
        "tau_step": 0.98, "tau_stop": 0.9, "delta": 3, "window": 8, "initial": 1, "increment": 1,
        "maximum": None, "growth": 1.0,
    }  # fmt: skip
    one, three = scenes.load("poisson_1p"), scenes.load("poisson_3p")
    assert (one.max_iter, one.training.intervals, one.learning_rate(100)) == (600, 170, 275.0)
    assert (three.max_iter, three.training.intervals, three.learning_rate(0)) == (450, 750, 3500.0)
    assert (one.prdp["tau_step"], one.prdp["tau_stop"], one.prdp["initial"], one.prdp["increment"]) == (
        0.92,
        0.98,
        25,
        10,
    )
    steepest = scenes.load("poisson_3p_sd")
    assert (steepest.method, steepest.max_iter, steepest.training.intervals) == ("steepest_descent", 240, 800)


@pytest.mark.parametrize(
    "before, after, where, message",
    [
        ("rtol = 1e-5", "tol = 1e-5", "[solver]", "solver.rtol: missing; the table holds: backward, max_iter"),
        ("rtol = 1e-5", "rtol = 1e-5\nm = 3", "m = 3", "unknown name 'solver.m'; allowed: backward, max_iter, meth"),
        ('method = "jacobi"', 'method = "x"', "method", "solver.method: unknown name 'x'; allowed: jacobi, steepest"),
        ("nu = 1e-3", "nu = -1.0", "nu =", "physics.nu: must be >= 0, got -1"),
        ("dt = 1.0", "dt = 0", "dt =", "physics.dt: must be > 0, got 0"),
        ("max_iter = 25", "max_iter = -1", "max_iter", "solver.max_iter: must be >= 0, got -1"),
        ("max_iter = 25", "max_iter = 2.5", "max_iter", "solver.max_iter: expected a whole number"),
        ("shape = [30]", "shape = 30", "shape", "physics.shape: expected a list of whole numbers"),
        ("shape = [30]", "shape = [3, 3, 3, 3]", "shape", "physics.shape: expected 1 to 3 extents"),
        ("learning_rate = 1e-3", "learning_rate = nan", "learning_rate", "training.learning_rate: must be finite"),
        ('loss = "nmse"', 'loss = "l1"', "loss =", "training.loss: unknown name 'l1'; allowed: nmse, mse"),
        ("delta = 3", "delta = 1", "delta", "prdp.delta: must be >= 2, got 1"),
        ('dtype = "float32"', 'dtype = "half"', "dtype", "dtype: unknown name 'half'; allowed: float32, float64"),
        ('"implicit"', '"none"', "backward", "solver.backward: unknown name 'none'; allowed: implicit, unrolled"),
        ("[network]", "[networks]", "title", "network: missing; the table holds:"),
        ("[physics]", "[physics", "[physics", "Error while parsing"),
    ],
)  # fmt: skip
def test_mistakes_are_named_with_file_and_line(tmp_path, before, after, where, message):
    path = written(tmp_path, (before, after))
    with pytest.raises(ValueError) as error:
        _C.read_scene(path)
    text = str(error.value)
    assert message in text and text.startswith(path + ":")
    number = int(text.removeprefix(path + ":").split(":")[0])
    # A missing table has no line of its own: the file's first table stands for it.
    assert number == line_of(path, where) or where == "title"


def test_missing_files_and_unknown_scenes():
    with pytest.raises(ValueError, match=r"scene: cannot read 'nowhere.toml'"):
        scenes.load("nowhere.toml")
    with pytest.raises(ValueError, match="no scene 'heat1d'; available: heat_1d, poisson_1p"):
        scenes.load("heat1d")


def test_data_is_the_same_at_every_call_and_in_every_precision(tmp_path):
    scene = scenes.load("heat_1d")
    once, again = _C.make_dataset(scene), _C.make_dataset(scene)
    assert torch.equal(once.train_start, again.train_start) and torch.equal(once.valid_end, again.valid_end)
    double = _C.make_dataset(_C.read_scene(written(tmp_path, ('"float32"', '"float64"'))))
    assert torch.equal(double.train_start.float(), once.train_start)
    other = _C.make_dataset(_C.read_scene(written(tmp_path, ("seed = 0", "seed = 1"))))
    assert not torch.equal(other.train_start, once.train_start)


def test_the_network_has_the_papers_size_and_depends_on_its_seed_alone():
    scene = scenes.load("heat_1d")
    torch.manual_seed(123)
    before = torch.get_rng_state()
    first, again, other = make_network(scene, 0), make_network(scene, 0), make_network(scene, 1)
    assert torch.equal(torch.get_rng_state(), before)
    assert sum(p.numel() for p in first.parameters()) == 12254
    assert [n for n, _ in first.named_parameters()][:2] == ["layers.0.weight", "layers.0.bias"]
    for p, q, r in zip(first.parameters(), again.parameters(), other.parameters(), strict=True):
        assert torch.equal(p, q) and not torch.equal(p, r)
    assert MLP(12, [5])(torch.zeros(2, 1, 3, 4)).shape == (2, 1, 3, 4)
