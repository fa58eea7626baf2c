"""What the command `prdp` shows in a terminal: bars while it works, and the table of a comparison."""

from collections.abc import Callable

from rich import box
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from prdp_torch.experiments import _C, report
from prdp_torch.experiments.compare import Entry

console = Console(highlight=False, markup=False, emoji=False)  # paths and titles are printed as they are


def progress_bars() -> Progress:
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    return Progress(*columns, console=console)


def counted_bar(progress: Progress, name: str) -> Callable[[int, int], None]:
    """A callback (done, total) that has a bar of its own from its first call on."""
    task: TaskID | None = None

    def show(done: int, total: int) -> None:
        nonlocal task
        if task is None:
            task = progress.add_task(name, total=total, note="")
        progress.update(task, completed=done)

    return show


def print_table(scene: _C.Scene, table: list[Entry]) -> None:
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    names = [column.short for column in report.columns(scene)]
    kept = report.in_terminal(scene)  # the report has the others
    for i in kept:
        shown.add_column(names[i], justify="right" if i else "left", no_wrap=True)
    for entry in table:
        row = report.cells(scene, entry)
        shown.add_row(*(row[i] for i in kept), style="bold" if entry["kind"] in ("auto", "prdp") else None)
    console.print(shown)
    console.print(report.notes(scene, kept))
