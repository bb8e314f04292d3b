"""What is said, on stderr: a bar on a terminal, a line now and then elsewhere, nothing if quiet."""

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from stillmap.cli.terminal import is_terminal, painted

if TYPE_CHECKING:
    from stillmap.pipeline import Progress

_EVERY = 10.0  # s between lines where there is no terminal


def say(line: str) -> None:
    """One line on stderr. That nobody listens there any more is no reason to give up the work."""
    marked = "warning:"
    if line.startswith(marked):
        line = painted(marked, "warning", sys.stderr) + line[len(marked) :]
    _write(f"stillmap: {line}")


def fail(line: str) -> None:
    """The one line that says why nothing came of it."""
    _write(f"{painted('stillmap:', 'error', sys.stderr)} {line}")


def _write(line: str) -> None:
    if sys.stderr is None:
        return
    try:
        print(line, file=sys.stderr, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


@contextmanager
def shown_progress(quiet: bool, iterations: int) -> "Iterator[Progress]":
    """A Progress that shows iteration, scan, rate and time left."""
    if quiet or sys.stderr is None:  # None: it was closed before we began
        from stillmap.pipeline import silent

        yield silent
    elif is_terminal(sys.stderr):
        with _bar(iterations) as progress:
            yield progress
    else:
        yield _Lines(iterations)


@contextmanager
def shown_share(quiet: bool, what: str) -> "Iterator[Callable[[float], None] | None]":
    """What shows the share of a job that is done, from 0 to 1; None where nobody looks."""
    if quiet or sys.stderr is None:
        yield None
    elif is_terminal(sys.stderr):
        from rich.console import Console
        from rich.progress import Progress as Bar

        bar = Bar(console=Console(stderr=True), transient=True)
        task = bar.add_task(what, total=1.0)

        def update(share: float) -> None:
            bar.start()  # not before there is something to show
            bar.update(task, completed=share)

        try:
            yield update
        finally:
            bar.stop()
    else:
        yield _Shares(what)


class _Shares:
    """A line every few seconds: none of what takes no longer."""

    def __init__(self, what: str) -> None:
        self._what, self._last = what, time.monotonic()

    def __call__(self, share: float) -> None:
        now = time.monotonic()
        if now - self._last >= _EVERY:
            self._last = now
            say(f"{self._what}: {100.0 * share:.0f} %")


@contextmanager
def _bar(iterations: int) -> "Iterator[Progress]":
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        TaskID,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("scans {task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        tasks: dict[int, TaskID] = {}
        rate = _Rate()

        def progress(what: str, iteration: int, done: int, total: int) -> None:
            if iteration not in tasks:
                for old in tasks.values():
                    bar.remove_task(old)
                tasks.clear()
                name = f"{what}, iteration {iteration} of at most {iterations}"
                tasks[iteration] = bar.add_task(name, total=total, rate="")
            bar.update(tasks[iteration], completed=done, rate=f"{rate(iteration, done):.0f}/s")

        yield progress


class _Rate:
    """Scans per second within one iteration."""

    def __init__(self) -> None:
        self._iteration, self._started = 0, time.monotonic()

    def __call__(self, iteration: int, done: int) -> float:
        if iteration != self._iteration:
            self._iteration, self._started = iteration, time.monotonic()
        return done / max(time.monotonic() - self._started, 1e-3)


class _Lines:
    """A line every few seconds and at the end of an iteration."""

    def __init__(self, iterations: int) -> None:
        self._iterations = iterations
        self._last = time.monotonic()
        self._rate = _Rate()

    def __call__(self, what: str, iteration: int, done: int, total: int) -> None:
        rate = self._rate(iteration, done)
        now = time.monotonic()
        if done < total and now - self._last < _EVERY:
            return
        self._last = now
        left = (total - done) / max(rate, 1e-3)
        say(
            f"{what}, iteration {iteration} of at most {self._iterations}: "
            f"{done} of {total} scans, {rate:.0f}/s, {left:.0f} s left in this iteration"
        )
