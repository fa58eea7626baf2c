"""The failure atlas: small maps against outcomes that are known, its records, and what the docs say of them."""

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import atlas
from benchmarks.atlas import coarse_grids, gradients, solves

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs" / "stability"


def test_jacobi_fails_where_its_spectral_radius_exceeds_one():
    """It is 10 c/(1 + 6 c) for 1 + c Δ² on a periodic grid."""
    data = solves.hyperdiffusion(quick=True)
    for c, products in zip(data["x"], data["lines"]["Jacobi"], strict=True):
        assert (products is not None) == (10 * c / (1 + 6 * c) < 1)
    assert all(data["lines"]["CG"]) and all(data["lines"]["GMRES(10)"]) and data["last"] == 0.24
    assert "DIVERGED at 1" in data["answer"]


def test_jacobi_takes_what_its_spectral_radius_says():
    """2 r cos(π/(N + 1))/(1 + 2 r) for heat with r = nu dt/dx²; and CG at most as many as unknowns."""
    data = solves.stiffness(quick=True)
    for ratio, products in zip(data["x"], data["lines"]["Jacobi"], strict=True):
        radius = 2 * ratio * math.cos(math.pi / 65) / (1 + 2 * ratio)
        if ratio > 10:
            assert products == pytest.approx(math.log(1e-5) / math.log(radius), rel=0.4)
    assert max(data["lines"]["CG"]) <= 64 + 1
    assert data["lines"]["Jacobi"] == sorted(data["lines"]["Jacobi"])


def test_matrices_with_known_outcomes():
    data = solves.known_matrices(quick=True)
    found = {
        row: dict(zip(data["x"], status, strict=True)) for row, status in zip(data["rows"], data["status"], strict=True)
    }
    swap = found["swap [[0, 1], [1, 0]]"]
    assert swap["Jacobi"] == "ZERO_DIAGONAL"
    assert swap["CG"] == swap["SteepestDescent"] == swap["BiCGStab"] == "BREAKDOWN"  # r·A r = 0
    assert (
        swap["GMRES(1)"] == "STAGNATED" and swap["GMRES(2)"] == "CONVERGED_BREAKDOWN" and swap["Direct"] == "CONVERGED"
    )
    assert found["cyclic shift of 8"]["GMRES(2)"] == "STAGNATED"
    strong = found["0.1 I + 0.9 · ones(3)"]  # ρ(Jacobi) = 1.8, and positive definite
    assert strong["Jacobi"] == "DIVERGED" and strong["CG"] == strong["SteepestDescent"] == "CONVERGED"
    assert found["1 + Δ² (periodic)"]["Jacobi"] == "DIVERGED"  # ρ = 10/7
    assert found["periodic Laplacian, b mean-free"]["Jacobi"] == "MAX_ITER"  # it has the eigenvalue -1
    assert set(found["singular, b outside"].values()) == {"MAX_ITER", "BREAKDOWN"}
    assert found["Burgers, CFL 100"]["Jacobi"] == "CONVERGED"  # an M-matrix


def test_jacobi_takes_every_burgers_step_and_no_flow():
    data = solves.burgers_solvers(quick=True)
    shares = dict(zip(data["rows"], data["share"], strict=True))
    assert shares["Jacobi"] == [1.0] * 3 == shares["GMRES(64)"] and shares["CG"][-1] == 0.0
    assert shares["BiCGStab"] == [1.0] * 3
    data = solves.flow_solvers(quick=True)
    status = dict(zip(data["rows"], data["status"], strict=True))
    assert set(status["Jacobi"]) == {"ZERO_DIAGONAL"} and set(status["GMRES(50)"]) == {"CONVERGED"}


def test_cg_takes_burgers_steps_that_are_almost_heat():
    """At a small amplitude A is symmetric but for as much; at a large one it is not."""
    data = solves.burgers_amplitude(quick=True)
    shares = dict(zip(data["rows"], data["share"], strict=True))
    assert shares["CG"][0] == 1.0 and shares["CG"][-1] == 0.0 and data["last"] == data["x"][0] == 0.01
    assert shares["Jacobi"] == shares["BiCGStab"] == [1.0] * 3


def test_a_finer_grid_takes_more_products_of_a_flow_but_few_with_its_preconditioner():
    lines = solves.flow_grid(quick=True)["lines"]
    assert lines["GMRES(8)"][1] > 1.5 * lines["GMRES(8)"][0]
    # BiCGStab breaks down on some of these states: s·A s vanishes where s is a pressure alone.
    assert (lines["BiCGStab"][1] or math.inf) > 1.5 * lines["BiCGStab"][0]
    assert lines["GMRES(8), multigrid"][1] <= lines["GMRES(8)"][1] / 3


def test_the_diagonal_is_no_help_where_it_is_constant():
    lines = solves.contrast(quick=True)["lines"]
    plain, scaled = lines["CG"], lines['CG, preconditioner="diagonal"']
    assert plain[0] == scaled[0] and plain[-1] > 2 * scaled[-1]


def test_float32_has_a_floor_and_float64_none_here():
    data = solves.float32_floor(quick=True)
    assert data["x"] == [16, 512] and data["first"] == {"CG": 512, "Direct": 512}
    assert max(data["lines"]["CG, float64"] + data["lines"]["Direct, float64"]) < 1e-10


def test_an_eigenvector_is_solved_at_once_and_its_adjoint_is_not():
    data = solves.primal_adjoint(quick=True)
    assert data["lines"]["primal"][0] < 1e-12 and data["lines"]["adjoint"][-1] > 1e-2
    assert all(sum(shares) == pytest.approx(1.0) for shares in data["outcomes"].values())
    assert data["outcomes"]["Jacobi"] == [1.0, 0.0, 0.0, 0.0]


def test_the_modes_agree_for_b_with_jacobi_on_heat():
    """Without a derivative of A, both are the same K iterations with Aᵀ."""
    lines = gradients.implicit_unrolled(quick=True)["panels"]["heat, Jacobi"]["lines"]
    assert lines["implicit"] == pytest.approx(lines["unrolled"], rel=1e-10)
    assert lines["implicit"] == sorted(lines["implicit"], reverse=True)


def test_the_command_writes_a_picture_and_a_record_for_each_map(tmp_path):
    command = [sys.executable, "-m", "benchmarks.atlas", "--quick", "--out", tmp_path]
    names = ["hyperdiffusion", "burgers_restart", "known_matrices"]
    done = subprocess.run([*command, *names], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    for name in names:
        record = json.loads((tmp_path / f"{name}.json").read_text())
        assert record["quick"] and record["seed"] == 0 and record["question"] == atlas.MAPS[name].question
        assert {"command", "commit", "machine", "versions", "data"} <= record.keys() and record["answer"] in done.stdout
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    wrong = subprocess.run([*command, "moon"], capture_output=True, text=True, cwd=ROOT)
    assert wrong.returncode == 2 and "atlas: unknown map 'moon'; allowed: stiffness, " in wrong.stderr


@pytest.mark.parametrize("name", atlas.MAPS)
def test_the_docs_show_every_map_with_its_measured_answer(name, tmp_path):
    record = json.loads((DOCS / f"{name}.json").read_text())
    assert not record["quick"] and record["commit"] and record["command"]
    text = (ROOT / "docs" / "appendix" / "atlas.md").read_text()
    assert f"![{record['question']}](../stability/{name}.png)" in text and f"*{record['answer']}*" in text
    atlas.MAPS[name].draw(record["data"]).savefig(tmp_path / "again.png", dpi=20)


def test_the_whole_atlas_takes_less_than_ten_minutes():
    assert sum(json.loads((DOCS / f"{name}.json").read_text())["seconds"] for name in atlas.MAPS) < 600


@pytest.mark.parametrize("measure", [coarse_grids.contrast, coarse_grids.anisotropy, coarse_grids.sizes])
def test_multigrid_takes_as_many_products_at_every_distance_from_trouble(measure):
    found = measure(quick=True)["lines"]
    assert max(found['CG, preconditioner="multigrid"']) <= 8 and max(found["Multigrid"]) <= 12
    assert max(found["CG"]) > 100


def test_winds_slow_cycles_down_but_less_than_methods_without_them():
    found = coarse_grids.vortices(quick=True)["lines"]
    assert found['BiCGStab, preconditioner="multigrid"'][0] <= 8
    assert found['BiCGStab, preconditioner="multigrid"'][-1] < found["BiCGStab"][-1] / 10
