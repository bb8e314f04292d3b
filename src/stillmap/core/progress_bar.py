"""Progress of a run on a terminal or in a notebook, for those who ask for it."""

import html
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from stillmap.core.profiling import Progress

_PERIOD = 0.2  # s between two changes of a bar in a notebook


class Step:
    """The current step and its start; only iterations count scans."""

    def __init__(self, what: str, iteration: int, iterations: int) -> None:
        self.key = what, iteration
        self.name = f"{what}, iteration {iteration} of at most {iterations}" if iteration else what
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


@contextmanager
def terminal_bar(iterations: int) -> Iterator[Progress]:
    """A Progress that shows step, iteration, scans, rate and time left on stderr."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[counted]}"),
        TimeRemainingColumn(),
    )
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        shown: Step | None = None
        task = bar.add_task("", total=None, counted="")

        def progress(what: str, iteration: int, done: int, total: int) -> None:
            nonlocal shown, task
            if shown is None or shown.key != (what, iteration):
                shown = Step(what, iteration, iterations)
                bar.remove_task(task)
                task = bar.add_task(shown.name, total=total or None, counted="")
            if total:
                counted = f"{done}/{total}"
                if shown.of_scans:
                    counted += f" scans {shown.rate(done):.0f}/s"
                # a finished step is shown even if it was short
                bar.update(task, completed=done, counted=counted, refresh=done == total)

        yield progress


def _in_notebook() -> bool:
    """Whether a kernel of Jupyter runs this."""
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
