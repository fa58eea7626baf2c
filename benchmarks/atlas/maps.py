"""The maps of the atlas: which question each answers, how it is measured, and how it is drawn."""

import time
from collections.abc import Callable
from typing import NamedTuple

import torch

from benchmarks.atlas import coarse_grids, gradients, problems, solves
from prdp_torch.experiments import charts, records


class Map(NamedTuple):
    """One question of the atlas."""

    question: str
    measure: Callable
    """quick → the data and the "answer" in words."""
    picture: str
    """The name of a function of `pictures`, which takes the question and the data."""
    arguments: tuple = ()
    """Where that function makes the drawing function: its arguments."""

    def draw(self, data):
        from benchmarks.atlas import pictures  # matplotlib, only now

        function = getattr(pictures, self.picture)
        return (function(*self.arguments) if self.arguments else function)(self.question, data)


CFL = "CFL number, dt max|u|/dx"

MAPS = {
    "stiffness": Map(
        "How many products with A does a heat step need?", solves.stiffness, "cost", ("nu dt/dx² (heat in 1D, N = 64)",)
    ),
    "grid_size": Map("How does the work of Poisson in 2D grow with the grid?", solves.grid_size, "grid_size"),
    "float32_floor": Map("From which grid on can float32 not meet 1e-5?", solves.float32_floor, "floor"),
    "contrast": Map(
        "From which contrast does CG need a preconditioner?",
        solves.contrast,
        "cost",
        ("contrast of the diffusivity, max κ/min κ (random from cell to cell, 32²)",),
    ),
    "multigrid_contrast": Map(
        "Does multigrid mind a contrast?",
        coarse_grids.contrast,
        "cost",
        ("contrast of a smooth diffusivity, max κ/min κ (63²)",),
    ),
    "multigrid_anisotropy": Map(
        "Does multigrid mind long cells?",
        coarse_grids.anisotropy,
        "cost",
        ("length of a cell over its height (63²)",),
    ),
    "multigrid_sizes": Map("Does multigrid mind the size of the grid?", coarse_grids.sizes, "grid_size"),
    "multigrid_winds": Map(
        "Does multigrid mind winds?",
        coarse_grids.vortices,
        "cost",
        ("cell Péclet number, max|w| dx/nu, of vortices (64²)",),
    ),
    "multigrid_rough_winds": Map(
        "Does multigrid mind winds that turn from cell to cell?",
        coarse_grids.rough_winds,
        "cost",
        ("cell Péclet number, max|w| dx/nu, of white noise (64²)",),
    ),
    "burgers_solvers": Map(
        "Which solver takes a Burgers step?",
        solves.burgers_solvers,
        "shares",
        (f"{CFL} (N = 64, random states, 3,000 products at most)", ""),
    ),
    "burgers_amplitude": Map(
        "Which amplitude of a Burgers state can each solver take?",
        solves.burgers_amplitude,
        "shares",
        ("cell Péclet number, max|u| dx/nu (N = 64, nu dt/dx² = 10, 3,000 products at most)", ""),
    ),
    "burgers_restart": Map(
        "How small a restart can Burgers take?",
        solves.burgers_restart,
        "shares",
        (f"{CFL} (N = 64, 3,000 products at most)", "restart m of GMRES(m)"),
    ),
    "flow_solvers": Map(
        "Which solver takes a Navier–Stokes step?",
        solves.flow_solvers,
        "shares",
        (f"{CFL} (16², 4,000 products at most)", ""),
    ),
    "flow_grid": Map("How does the work of a Navier–Stokes step grow with the grid?", solves.flow_grid, "grid_size"),
    "hyperdiffusion": Map(
        "Where does Jacobi diverge?",
        solves.hyperdiffusion,
        "cost",
        ("nu dt/dx⁴ of a step of u_t = -nu u_xxxx (N = 32)", (0.25, "ρ(Jacobi) = 1")),
    ),
    "known_matrices": Map("What does each method say of hard small matrices?", solves.known_matrices, "statuses"),
    "primal_adjoint": Map(
        "Can the solve converge where its adjoint does not?", solves.primal_adjoint, "primal_adjoint"
    ),
    "implicit_unrolled": Map(
        "Is the implicit or the unrolled gradient closer after K iterations?", gradients.implicit_unrolled, "modes"
    ),
    "float32_gradient": Map("Does float32 spoil the gradient?", gradients.float32_gradient, "single"),
    "few_iterations": Map("How few iterations still train?", gradients.few_iterations, "few"),
}


def run(folder, names=(), quick=False, show=lambda name, answer, seconds: None):
    """Measure and draw maps, all of them by default, on one thread: NAME.json and NAME.png in the folder.

    Args:
        folder: where to write; it exists.
        names: of MAPS.
        quick: a few points of each map, to see that it runs.
        show: called after each map with its name, the answer and the seconds that it took.

    Raises:
        ValueError: an unknown name, before any work.
    """
    for name in names:
        if name not in MAPS:
            raise ValueError(f"atlas: unknown map '{name}'; allowed: {', '.join(MAPS)}")
    threads, environment = torch.get_num_threads(), records.environment()
    torch.set_num_threads(1)
    try:
        for name in names or MAPS:
            chosen, started = MAPS[name], time.perf_counter()
            data = chosen.measure(quick)
            seconds = time.perf_counter() - started
            about = {"map": name, "question": chosen.question, "answer": data["answer"], "quick": quick}
            records.write(folder / f"{name}.json", {**about, "seed": problems.SEED, "seconds": round(seconds, 1),
                                                     **environment, "data": data})  # fmt: skip
            charts.write_png(chosen.draw(data), folder / f"{name}.png", dpi=110)
            show(name, data["answer"], seconds)
    finally:
        torch.set_num_threads(threads)
