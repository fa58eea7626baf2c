"""The command `prdp`: scenes, trainings, comparisons, advice and data."""

import contextlib
import functools
import sys
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import IO, Annotated, Any, cast

import torch
import typer
from rich.progress import TaskID

from prdp_torch import data_parallel
from prdp_torch._C import VERSION, sentence
from prdp_torch.experiments import _C, array_files, datasets, records, report, scene_advice, trajectories
from prdp_torch.experiments import compare as comparison
from prdp_torch.experiments import scenes as scene_files
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.tensorboard import TensorBoard
from prdp_torch.experiments.terminal import Output, console, counted_bar, print_table, progress_bars
from prdp_torch.experiments.training import Callback, Interval

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Train through PDE solves that stop early, and see what it saves.",
)
SceneName = Annotated[str, typer.Argument(metavar="SCENE", help="Name (see `prdp scenes`) or path of a .toml file.")]
COUNT: dict[str, Any] = {"min": 1, "max": _C.MOST_COUNTED}
Seeds = Annotated[int | None, typer.Option(**COUNT, help="How many seeds, counted from 0.")]
Resume = Annotated[bool, typer.Option("--resume", help="Keep finished trainings, go on from checkpoints.")]
Backward = Annotated[str | None, typer.Option(help="implicit, unrolled or (corrector) none, in place of the scene's.")]
Intervals = Annotated[int | None, typer.Option(**COUNT, help="Epochs (or updates) in place of the scene's.")]
Device = Annotated[str | None, typer.Option(metavar="NAME", help="cpu, cuda or cuda:N, in place of the scene's.")]


def _folder(default: str) -> Any:
    return typer.Option(help=f"Folder for the results; default {default}.")


def print_versions(asked: bool) -> None:
    if asked:
        print(f"prdp_torch {VERSION}, torch {torch.__version__}")
        raise typer.Exit


Version = Annotated[bool, typer.Option("--version", is_eager=True, callback=print_versions, help="Print the versions.")]


@app.callback()
def _about(version: Version = False) -> None:
    pass  # the option has done it


def command(function: Callable[..., None]) -> Callable[..., None]:
    """A command whose user's errors are one line and exit 2; Ctrl-C exits 130."""

    @functools.wraps(function)
    def guarded(*args: Any, **kwargs: Any) -> None:
        try:
            if data_parallel.launched() > 1 and function.__name__ != "train":
                raise ValueError(f"{function.__name__}: runs in a single process; only train is split by torchrun")
            with data_parallel.joined(), warnings.catch_warnings():
                warnings.showwarning = lambda message, *_: print(f"prdp: warning: {message}", file=sys.stderr)
                function(*args, **kwargs)
        except KeyboardInterrupt:
            kept = "--resume keeps finished trainings and goes on from the last checkpoint"
            print(f"prdp: interrupted; {kept}", file=sys.stderr)
            raise typer.Exit(130) from None
        except (typer.Exit, typer.Abort):  # both are RuntimeErrors, which the next clause would take
            raise
        except (ValueError, TypeError, OSError, ImportError, RuntimeError, OverflowError, MemoryError) as error:
            words = "std::bad_alloc" if isinstance(error, MemoryError) else str(error)
            print(f"prdp: {sentence(words)}{_place(error)}", file=sys.stderr)
            raise typer.Exit(2) from None

    return app.command(name=function.__name__)(guarded)


def _place(error: BaseException) -> str:
    """The line of the user's own file that raised it or led to it, as of a network; empty where there is none."""
    others = str(Path(__file__).parents[1]), sys.prefix, sys.base_prefix, "<"
    own = [f for f in traceback.extract_tb(error.__traceback__) if not f.filename.startswith(others)]
    return f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""


@command
def scenes() -> None:
    """List the scenes that come with the project."""
    known = scene_files.available()
    for name, path in known.items():
        print(f"{name:{max(map(len, known))}}  {scene_files.load(path).title}")


@command
def train(
    scene: SceneName,
    auto: Annotated[
        bool, typer.Option("--auto", help="A tolerance tied to the error; nothing to choose; the default.")
    ] = False,
    prdp: Annotated[bool, typer.Option("--prdp", help="PRDP with the scene's settings.")] = False,
    constant: Annotated[int | None, typer.Option(**COUNT, metavar="K", help="Constant K.")] = None,
    schedule: Annotated[str | None, typer.Option(metavar="START:STEP", help="K grows by STEP an interval.")] = None,
    direct: Annotated[bool, typer.Option("--direct", help="The exact solver.")] = False,
    seeds: Seeds = None,
    out: Annotated[Path | None, _folder("runs/SCENE-train")] = None,
    resume: Resume = False,
    backward: Backward = None,
    intervals: Intervals = None,
    device: Device = None,
    tensorboard: Annotated[bool, typer.Option("--tensorboard", help="Also write the curves for TensorBoard.")] = False,
) -> None:
    """Train a scene with one way of choosing K, over seeds; write a record each.

    Exit 1 if one diverges: a number is not finite, or the relative error ends above 10 and above ten times its
    first value.
    """
    loaded = _load(scene, device, backward, intervals)
    refinement = _refinement(loaded, auto, prdp, constant, schedule, direct)
    folder = records.prepare_folder(out or Path("runs") / f"{loaded.name}-train")
    environment = records.environment(loaded.device)
    diverged: dict[int, str] = {}
    warned: dict[int, str] = {}
    with records.alone_in([folder / refinement.label]), progress_bars() as progress:
        comparison.refuse_to_lose(loaded, [refinement.label], seeds or 1, folder, environment, resume)
        for seed in range(seeds or 1):
            task = progress.add_task(f"seed {seed}", total=loaded.training.intervals, note="")

            def show(interval: Interval, task: TaskID = task) -> None:
                budget = f"rtol {interval.rtol:.1e}" if refinement.watches_error else f"K {interval.max_iter}"
                note = f"metric {interval.metric:.3e}  {budget}"
                progress.update(task, completed=interval.number, note=note)

            callbacks: list[Callback] = [show]
            if tensorboard and data_parallel.is_first():
                callbacks.append(TensorBoard(folder / refinement.label / f"seed_{seed}.tensorboard"))
            curves = comparison.run_one(
                loaded,
                refinement.label,
                refinement,
                seed,
                folder,
                environment,
                resume,
                callbacks,
                counted_bar(progress, "data, steps"),
            )
            progress.update(task, completed=loaded.training.intervals, note=f"metric {curves['metric'][-1]:.3e}")
            if (why := comparison.why_lost(curves)) is not None:
                diverged[seed] = why
            if "warning" in curves:
                warned[seed] = curves["warning"]
    console.print(f"records: {folder / refinement.label}", soft_wrap=True)
    for seed, what in warned.items():
        print(f"prdp: warning: seed {seed}, {what}", file=sys.stderr)
    for seed, why in diverged.items():
        print(f"prdp: seed {seed} diverged, {why}", file=sys.stderr)
    if diverged:
        raise typer.Exit(1)


@command
def compare(
    scene: SceneName,
    seeds: Seeds = None,
    out: Annotated[Path | None, _folder("runs/SCENE")] = None,
    resume: Resume = False,
    backward: Backward = None,
    intervals: Intervals = None,
    device: Device = None,
) -> None:
    """Compare converged, exact, auto, PRDP and a sweep of constant K: table, records and an HTML report."""
    loaded = _load(scene, device, backward, intervals)
    folder = records.prepare_folder(out or Path("runs") / loaded.name)
    seeds = seeds or loaded.compare.seeds
    with progress_bars() as progress:
        trainings = len(comparison.rows_of(loaded)) * seeds
        task = progress.add_task("", total=trainings * loaded.training.intervals, note="")
        finished: dict[tuple[str, int], int] = {}

        def show(row: comparison.Row, seed: int, done: int) -> None:
            finished[row.label, seed] = done
            progress.update(task, completed=sum(finished.values()), description=f"{row.title}, seed {seed}")

        rows = comparison.run(loaded, seeds, folder, resume, show, counted_bar(progress, "data, steps"))
        table = comparison.summarise(loaded, rows)
        records.write(
            folder / "summary.json",
            {"settings": records.settings(loaded), **records.environment(loaded.device), "seeds": seeds, "rows": table},
        )
        shown = trajectories.collect(loaded, rows, folder, counted_bar(progress, "pictures, steps"))
    report.write(loaded, rows, table, shown, folder)
    print_table(loaded, table)
    said = [report.headline(loaded, table), *report.failures(loaded, table), f"report: {folder / 'report.html'}"]
    console.print("\n" + "\n".join(said), soft_wrap=True)


@command
def export(
    scene: SceneName,
    out: Annotated[Path | None, typer.Option(help="The file, .h5, .hdf5 or .npz; default SCENE.h5.")] = None,
    steps: Annotated[
        int | None, typer.Option(**COUNT, help="Time steps of each trajectory; default: what the training needs.")
    ] = None,
) -> None:
    """Write the trajectories of a scene as HDF5 or .npz, in PDEBench's layout."""
    loaded = scene_files.load(scene)
    if not trajectories.exist(loaded):
        raise ValueError(f"export: the scene {loaded.name} has no trajectories")
    path = out or Path(f"{loaded.name}.h5")
    array_files.check_name(path)
    records.prepare_folder(path.parent)
    with progress_bars() as progress:
        samples, states, *_ = datasets.export(loaded, path, steps, counted_bar(progress, "data, steps"))
    console.print(f"{samples} trajectories of {states} states: {path}", soft_wrap=True)


@command
def advise(
    scene: SceneName,
    seconds: Annotated[float, typer.Option(metavar="S", help="The limit for each solver.")] = 5.0,
    device: Device = None,
) -> None:
    """Measure which solver a scene needs and how much refinement can save, without training."""
    loaded = _load(scene, device)
    with console.status("trying the solvers"):
        advised = scene_advice.advise_scene(loaded, seconds)
    console.print(str(advised), soft_wrap=True, highlight=False, markup=False)


def _load(scene: str, device: str | None, backward: str | None = None, intervals: int | None = None) -> _C.Scene:
    loaded = scene_files.placed(scene_files.load(scene), device)
    if backward is not None:
        loaded.backward = backward
    if intervals is not None:
        loaded.training.intervals = intervals
    return loaded


def _refinement(
    scene: _C.Scene, auto: bool, prdp: bool, constant: int | None, schedule: str | None, direct: bool
) -> Refinement:
    """The one way of choosing K that the options name, the default where they name none."""
    chosen = [
        name
        for name, given in (
            ("--auto", auto),
            ("--prdp", prdp),
            ("--constant", constant is not None),
            ("--schedule", schedule is not None),
            ("--direct", direct),
        )
        if given
    ]
    if len(chosen) > 1:
        raise ValueError(f"give one of --auto, --prdp, --constant, --schedule and --direct, not {' and '.join(chosen)}")
    if prdp:
        return Refinement.prdp(scene)
    if constant is not None:
        return Refinement.constant(constant)
    if schedule is not None:
        return Refinement.schedule(*_schedule(schedule, scene.max_iter), scene.max_iter)
    return Refinement.exact() if direct else Refinement.auto()


def _schedule(text: str, max_iter: int) -> tuple[int, int]:
    parts = text.split(":")
    most = _C.MOST_COUNTED
    if len(parts) != 2 or not all(part.isdecimal() and len(part) < 20 and int(part) <= most for part in parts):
        raise ValueError(f"--schedule: expected START:STEP, two whole numbers up to {most}, got '{text}'")
    start, step = map(int, parts)
    if start > max_iter:
        raise ValueError(f"--schedule: START must be at most max_iter of the scene, {max_iter}, got {start}")
    return start, step


def main() -> None:
    with contextlib.redirect_stdout(cast(IO[str], Output(sys.stdout))):
        try:
            app()
        finally:
            sys.stdout.flush()
