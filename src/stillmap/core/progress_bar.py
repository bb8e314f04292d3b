"""Progress of a run on a terminal or in a notebook, for those who ask for it."""

import html
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any

from stillmap.core.profiling import Progress

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

_WIDE, _ROOMY = 100, 120  # columns of a terminal: from there on with longer texts
_BAR_WIDTH = 40  # columns; on narrower terminals the bar takes what is left
_PERIOD = 0.2  # s between two changes of a bar in a notebook


class Step:
    """The current step and its start; only iterations count scans."""

    def __init__(self, what: str, iteration: int, iterations: int) -> None:
        self.key = what, iteration
        self.name = f"{what}, iteration {iteration} of at most {iterations}" if iteration else what
        self.short_name = f"{what} {iteration}/{iterations}" if iteration else what
        self.of_scans, self._started = iteration > 0, time.monotonic()

    def seconds(self) -> float:
        return time.monotonic() - self._started

    def rate(self, done: int) -> float:
        """Items per second."""
        return done / max(self.seconds(), 1e-3)


@contextmanager
def show_bar(iterations: int) -> Iterator[Progress]:
    """A Progress that shows a bar: in a notebook below the cell, else on stderr.

    Args:
        iterations: of EM, at most.
    """
    with _notebook_bar(iterations) if _in_notebook() else terminal_bar(iterations) as progress:
        yield progress


def make_bar() -> "Bar":
    """A bar on stderr in one line of a terminal of any width, for tasks with a field `counted`."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar
    from rich.table import Column

    console = Console(stderr=True)
    is_roomy = console.width >= _ROOMY
    columns = (
        TextColumn("{task.description}", table_column=Column(no_wrap=True)),
        BarColumn(bar_width=_BAR_WIDTH if is_roomy else None),
        TextColumn("{task.fields[counted]}", table_column=Column(no_wrap=True)),
        TimeRemainingColumn(table_column=Column(no_wrap=True)),
    )
    return Bar(*columns, console=console, transient=True, expand=not is_roomy)


@contextmanager
def terminal_bar(iterations: int) -> Iterator[Progress]:
    """A Progress that shows step, iteration, scans, rate and time left on stderr."""
    with make_bar() as bar:
        width = bar.console.width
        shown: Step | None = None
        task = bar.add_task("", total=None, counted="")

        def progress(what: str, iteration: int, done: int, total: int) -> None:
            nonlocal shown, task
            if shown is None or shown.key != (what, iteration):
                shown = Step(what, iteration, iterations)
                bar.remove_task(task)
                name = shown.name if width >= _WIDE else shown.short_name
                task = bar.add_task(name, total=total or None, counted="")
            if total:
                counted = f"{done}/{total}"
                if shown.of_scans and width >= _ROOMY:
                    counted += f" scans {shown.rate(done):.0f}/s"
                # a finished step is shown even if it was short
                bar.update(task, completed=done, counted=counted, refresh=done == total)

        yield progress


def _in_notebook() -> bool:
    """True if a kernel of Jupyter runs this."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return hasattr(shell, "kernel")


@contextmanager
def _notebook_bar(iterations: int) -> Iterator[Progress]:
    """A bar of HTML, which needs no widgets, and is gone when the run has ended."""
    # the kernel's own, no dependency of ours
    shown: Any = import_module(f"{sys.modules['IPython'].__name__}.display")
    handle = shown.display(shown.HTML(""), display_id=True)
    step, changed = Step("preparing", 0, iterations), 0.0

    def progress(what: str, iteration: int, done: int, total: int) -> None:
        nonlocal step, changed
        new = step.key != (what, iteration)
        if new:
            step = Step(what, iteration, iterations)
        if not new and time.monotonic() - changed < _PERIOD:
            return
        changed = time.monotonic()
        share = f" value='{done}' max='{total}'" if total else ""
        counted = f" {done}/{total}" if total else ""
        handle.update(shown.HTML(f"<progress{share}></progress> {html.escape(step.name)}{counted}"))

    try:
        yield progress
    finally:
        handle.update(shown.HTML(""))
