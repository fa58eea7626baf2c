"""What the command `prdp` shows in a terminal: bars while it works, and the table of a comparison."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import IO, Any

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


class Output:
    """Standard output that may be closed (None), whose reader may leave, or whose disk may be full: the work goes on
    without it."""

    def __init__(self, stream: IO[str] | None) -> None:
        self._stream = stream or open(os.devnull, "w")  # noqa: SIM115  # for as long as the process lives

    def write(self, text: str) -> int:
        with self._which_may_end():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with self._which_may_end():
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @contextlib.contextmanager
    def _which_may_end(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if not isinstance(error, BrokenPipeError):
                print(f"prdp: warning: standard output: {error.strerror}; the work goes on without it", file=sys.stderr)
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


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
    whole = console.measure(shown, options=console.options.update(width=1000)).maximum
    Console(width=max(whole, console.width)).print(shown)  # else a narrow terminal cuts the ends off numbers
    console.print(report.notes(scene, kept))
