"""The tasks of benchmarks/mosaic: fields, references, the drag, conduction, and the record. Needs no other library."""

import json

import numpy as np
import pytest

from benchmarks.mosaic import case as cases_
from benchmarks.mosaic import charts, differences, fields, optimise, reference, runner, solvers, tables, tasks
from benchmarks.mosaic.solvers.ours_conduction import Ours as Volumes
from benchmarks.mosaic.tasks import forward, gradient
from benchmarks.mosaic.tasks.conduction import Plate
from benchmarks.mosaic.tasks.design import Cylinder
from docs import flow_tables

LENGTH = 2 * np.pi
GRIDS = (fields.low_faces, fields.high_faces, fields.corners)


def gradient_of(function, position, h=1e-5):
    """gradient_of(f, x)[c][a]: the derivative of component c along axis a."""
    dim = len(position)
    moved = np.eye(dim) * h
    ends = [(function(*(position + moved[a])), function(*(position - moved[a]))) for a in range(dim)]
    return [[(ends[a][0][c] - ends[a][1][c]) / (2 * h) for a in range(dim)] for c in range(dim)]


@pytest.mark.parametrize(
    "velocity, dim",
    [(fields.taylor_green, 2), (fields.taylor_green_3d, 3), (fields.beltrami, 3),
     (fields.RandomField(2, 1), 2), (fields.RandomField(3, 1), 3)],
)  # fmt: skip
def test_the_fields_have_no_divergence(velocity, dim):
    for position in np.random.default_rng(0).uniform(0, LENGTH, (5, dim)):
        slopes = gradient_of(velocity, position)
        assert abs(sum(slopes[c][c] for c in range(dim))) < 1e-8
        assert max(abs(slopes[c][a]) for c in range(dim) for a in range(dim)) > 1e-2


def test_component_0_is_along_the_last_axis():
    u = fields.sample(lambda x, y: (x, 10 * y), (2, 4), 4.0, fields.low_faces(2))
    np.testing.assert_array_equal(u[0], [[0, 1, 2, 3]] * 2)
    np.testing.assert_array_equal(u[1], [[0] * 4, [20] * 4])
    u = fields.sample(lambda x, y: (x, 10 * y), (2, 4), 4.0, fields.high_faces(2))
    np.testing.assert_array_equal(u[0][0], [1, 2, 3, 4])
    np.testing.assert_array_equal(u[1][:, 0], [20, 40])


def test_the_divergence_of_faces_is_their_difference():
    u = np.random.default_rng(0).standard_normal((2, 6, 6))
    h = LENGTH / 6
    low = (np.roll(u[0], -1, 1) - u[0] + np.roll(u[1], -1, 0) - u[1]) / h
    high = (u[0] - np.roll(u[0], 1, 1) + u[1] - np.roll(u[1], 1, 0)) / h
    np.testing.assert_allclose(fields.divergence(u, LENGTH, fields.low_faces(2)), low, atol=1e-13)
    np.testing.assert_allclose(fields.divergence(u, LENGTH, fields.high_faces(2)), high, atol=1e-13)


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("grid", GRIDS, ids=lambda grid: grid.__name__)
def test_a_projected_state_has_no_divergence_and_stays(grid, dim):
    offsets = grid(dim)
    u = fields.project(np.random.default_rng(0).standard_normal((dim, *(6,) * dim)), LENGTH, offsets)
    assert np.abs(fields.divergence(u, LENGTH, offsets)).max() < 1e-12
    np.testing.assert_allclose(fields.project(u, LENGTH, offsets), u, atol=1e-13)


def test_the_random_field_has_its_speed_and_its_seed():
    u = fields.sample(fields.RandomField(2, 0, speed=0.3), (32, 32), LENGTH, fields.corners(2))
    assert np.sqrt((u**2).sum(0)).max() == pytest.approx(0.3)
    again, other = (fields.sample(fields.RandomField(2, s), (32, 32), LENGTH, fields.corners(2)) for s in (0, 1))
    assert np.array_equal(u, again) and not np.allclose(u, other)


@pytest.mark.parametrize("velocity, dim, rate", [(fields.taylor_green, 2, 2), (fields.beltrami, 3, 1)])
def test_the_reference_decays_as_it_should(velocity, dim, rate):
    nu, time, offsets = 0.05, 0.5, fields.low_faces(dim)
    found = fields.sample(reference.solve(velocity, dim, nu, time, n=12, steps=20), (8,) * dim, LENGTH, offsets)
    exact = np.exp(-rate * nu * time) * fields.sample(velocity, (8,) * dim, LENGTH, offsets)
    assert fields.relative_error(found, exact) < 1e-12


def test_the_reference_solves_the_equation():
    """At t = 0: the rate of change, made free of divergence, is that of the finite differences."""
    field, dim, n, dt, nu = fields.RandomField(2, 0), 2, 64, 1e-4, 0.02
    corners = fields.corners(dim)
    before, after = (fields.sample(reference.solve(field, dim, nu, t, n, 1), (n, n), LENGTH, corners) for t in (0, dt))
    u, h = before, LENGTH / n

    def along(c, a):
        return (np.roll(u[c], -1, 1 - a) - np.roll(u[c], 1, 1 - a)) / (2 * h)

    laplacian = [sum(np.roll(u[c], s, a) - u[c] for s in (-1, 1) for a in (0, 1)) / h**2 for c in (0, 1)]
    rate = np.stack([nu * laplacian[c] - u[0] * along(c, 0) - u[1] * along(c, 1) for c in (0, 1)])
    expected = fields.project(rate, LENGTH, corners)
    assert fields.relative_error((after - before) / dt, expected) < 0.02  # second-order differences


def test_the_drag_of_known_fields():
    cylinder = Cylinder(n=32)
    solid, h = cylinder.solid(), 1 / 32
    assert solid.sum() == 12 and np.array_equal(solid, solid[::-1]) and np.array_equal(solid, solid[:, ::-1])
    x = (np.arange(32) + 0.5) / 32 + np.zeros((32, 1))
    # p = -x pushes with the volume between the fluid cells on both sides: 3, 5, 5 and 3 cells apart
    assert cylinder.drag(np.zeros((32, 32)), -x) == pytest.approx((3 + 5 + 5 + 3) * h * h)
    assert cylinder.drag(-x, np.zeros((32, 32))) == pytest.approx(-cylinder.nu * 16 * h)
    assert cylinder.drag(np.ones((32, 32)), np.ones((32, 32))) == pytest.approx(0.0)


@pytest.mark.parametrize("grid", GRIDS[:2], ids=lambda grid: grid.__name__)
def test_the_flow_around_the_cylinder_starts_at_rest_on_its_faces(grid):
    cylinder = Cylinder(n=32)
    u, _ = cylinder.start(grid(2))
    assert (u == 0).sum() == 12 + 4 and set(np.unique(u)) == {0.0, 0.5}
    cells = np.flatnonzero(cylinder.solid()[16])
    low, high = (cells[0], cells[-1] + 1) if grid is fields.low_faces else (cells[0] - 1, cells[-1])
    np.testing.assert_array_equal(np.flatnonzero(u[16] == 0), np.arange(low, high + 1))


def test_conduction_reaches_the_closed_forms_and_its_gradient_the_differences():
    plate = Plate(8)
    volumes = Volumes(plate)
    uniform = np.full((4, 8), 0.5)
    assert volumes.compliance(uniform)[0] == pytest.approx(2 / plate.conductivity(0.5), rel=1e-9)
    assert volumes.compliance(plate.layered())[0] == pytest.approx(plate.layered_compliance(), rel=1e-9)
    rho = plate.random()
    compared = differences.compare(volumes.forward, rho, volumes.compliance(rho)[1], directions=5)
    assert compared["finite"] and compared["cosine"] > 0.999999 and compared["median_error"] < 1e-6
    wrong = differences.compare(volumes.forward, rho, 1.01 * volumes.compliance(rho)[1], directions=5)
    assert wrong["median_error"] == pytest.approx(0.01, rel=0.1)  # the best of the steps
    assert differences.compare(volumes.forward, rho, np.full_like(rho, np.nan), directions=5) == {"finite": False}


def test_this_library_runs_the_tasks():
    flow = solvers.load(solvers.FLOWS, "ours")
    exact = forward.run(flow, {"field": "taylor_green", "n": 32, "nu": 0.05, "dt": 0.01, "steps": 10})
    assert exact["error"] < 1e-2 and exact["divergence"] < 1e-4
    compared = gradient.run(flow, {"dim": 2, "n": 8, "steps": 3})
    assert compared["cosine"] > 0.99999 and compared["median_error"] < 1e-4
    cylinder = Cylinder(n=32, steps=6)
    mean_drag, flat = flow(cylinder.box()).mean_drag(cylinder), np.full(32, cylinder.speed)
    direction = np.random.default_rng(0).standard_normal(32)
    slope = (mean_drag(flat + 0.03 * direction)[0] - mean_drag(flat - 0.03 * direction)[0]) / 0.06
    assert mean_drag(flat)[1] @ direction == pytest.approx(slope, rel=1e-2)


def test_adam_walks_by_its_learning_rate():
    point, values = optimise.adam(lambda x: (float((x**2).sum()), 2 * x), np.ones(3), 2, 0.1)
    np.testing.assert_allclose(point, 0.8, atol=2e-3)
    assert values == pytest.approx([3.0, 3 * 0.9**2])


def test_a_record_holds_what_was_run_and_is_taken_up_again(tmp_path, monkeypatch):
    runs = []

    def in_a_process(task, name, case, limit):
        runs.append((name, case["steps"]))
        if name == "exponax":
            return {"unavailable": "exponax is not installed"}
        return {"failed": "took more than 1 s"} if name == "phiflow" else {"result": {"finite": True, "norm": 1.0}}

    monkeypatch.setattr(runner, "in_a_process", in_a_process)
    environment = {"commit": "abc", "command": "python -m benchmarks.mosaic horizon"}
    names = ["jax_cfd", "phiflow", "exponax", "torch_fem"]
    for _ in range(2):
        rows = runner.run("horizon", names, tmp_path, environment, True, False, 1.0, lambda text: None)
    assert runs == 2 * [("jax_cfd", 40), ("phiflow", 40), ("exponax", 40)] + 2 * [("exponax", 40)]
    record = json.loads((tmp_path / "horizon.json").read_text())
    assert record["seed"] == 0 and record["quick"] and record["commit"] == "abc" and record["rows"] == rows
    assert rows[0] == {"solver": "jax_cfd", "case": {"dim": 2, "n": 16, "steps": 40}, "commit": "abc",
                       "result": {"finite": True, "norm": 1.0}}  # fmt: skip
    runner.run("horizon", ["jax_cfd"], tmp_path, environment, True, True, 1.0, lambda text: None)
    assert runs[-2:] == 2 * [("jax_cfd", 40)]


def test_a_case_says_why_it_has_no_result(monkeypatch):
    class Solver:
        CANNOT = {"design": "it knows no obstacles"}  # noqa: RUF012

        def __init__(self, box):
            raise ValueError("too\nmuch")

    monkeypatch.setattr(solvers, "load", lambda family, name: Solver)
    case = tasks_case("design")
    assert cases_.answer("design", "jax_cfd", case) == {"cannot": "it knows no obstacles"}
    assert cases_.answer("cost", "jax_cfd", tasks_case("cost")) == {"failed": "ValueError: too"}
    monkeypatch.undo()
    monkeypatch.setitem(solvers.FLOWS, "nothing", solvers.Entry("nothing", "Nothing", "no_such_package", "nothing"))
    assert cases_.answer("cost", "nothing", case) == {"unavailable": "no_such_package is not installed"}


def tasks_case(task):
    return runner.family(task)[0].cases(True)[0]


MADE_UP = {  # a result per task, as its `run` returns it
    "forward": {"error": 1e-3, "divergence": 1e-7, "energy": 1.0},
    "cost": {f"{part}_{key}": 2.5 for part in ("forward", "gradient")
             for key in ("seconds", "median_seconds", "compile_seconds", "bytes")},
    "gradient": {"finite": True, "step": 1e-4, "cosine": 1.0, "median_error": 1e-9, "errors": [1e-9]},
    "horizon": {"finite": True, "norm": 1.0},
    "design": {"drags": [0.02, 0.01], "losses": [0.02, 0.01], "profile": [0.5, 0.5]},
    "recovery": {"losses": [1e-3, 1e-6], "error": 1e-2},
    "conduction": {"uniform": 1e-15, "layered": 1e-15, "finite": True, "cosine": 1.0, "median_error": 1e-9,
                   "losses": [1e-6], "error": 0.1, "forward_seconds": 1.0, "gradient_seconds": 2.0,
                   "forward_bytes": 1e6, "gradient_bytes": 2e6},
}  # fmt: skip


@pytest.mark.parametrize("task", tasks.NAMES)
def test_every_task_has_its_tables_and_charts(task):
    module, family = runner.family(task)
    first, second, third, last = *list(family)[:3], list(family)[-1]
    rows = []
    for case in module.cases(False):
        rows.append({"solver": first, "case": case, "result": MADE_UP[task]})
        rows.append({"solver": second, "case": case, "cannot": "it knows no obstacles"})
        rows.append({"solver": third, "case": case, "failed": "took more than 1 s"})
        rows.append({"solver": last, "case": case, "unavailable": "it is not installed"})
    found = tables.of(task, rows)
    *of_task, reasons = found.values()
    assert all(family[first].label in table and "|" in table for table in of_task)
    said = [reasons.count(why) for why in ("it knows no obstacles", "took more than 1 s", "it is not installed")]
    assert said == [1, 1, 1]
    drawn = charts.of(task, rows)
    assert bool(drawn) == (task not in ("forward", "horizon"))
    assert json.dumps(module.cases(False)) and len(module.cases(True)) < len(module.cases(False)) + (task == "design")


def test_a_page_gets_its_tables_from_the_records(tmp_path, monkeypatch):
    case = tasks_case("cost")
    rows = [{"solver": "ours", "case": case, "result": MADE_UP["cost"]}]
    (tmp_path / "cost.json").write_text(json.dumps({"rows": rows}))
    monkeypatch.setattr(flow_tables, "RECORDS", tmp_path)
    place = "<!-- docs/flow_tables.py writes cost, 2D: seconds, forward and gradient -->\nold\n<!-- end -->\n"
    page = flow_tables.with_tables(f"before\n{place}after\n")
    assert (
        "old" not in page
        and "| prdp_torch, CG and multigrid | 2.5 s |" in page
        and page == flow_tables.with_tables(page)
    )
