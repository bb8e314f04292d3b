"""What is said, on stderr: a bar on a terminal, a line now and then elsewhere, nothing if quiet."""

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from stillmap.cli.terminal import is_terminal, painted

if TYPE_CHECKING:
    from stillmap.pipeline import Progress

_AT_ONCE = 0.01  # s: what takes no longer has no rate
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
    except OSError:  # nobody listens any more, or a full disk does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


@contextmanager
def shown_progress(quiet: bool, iterations: int) -> "Iterator[Progress]":
    """A Progress that shows step, iteration, scans, rate and time left."""
    if quiet or sys.stderr is None:  # None: it was closed before we began
        from stillmap.pipeline import silent

        yield silent
    elif is_terminal(sys.stderr):
        with _bar(iterations) as progress:
            yield progress
    else:
        with _Lines(iterations) as lines:
            yield lines


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
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[counted]}"),
        TimeRemainingColumn(),
    )
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        shown: _Step | None = None
        task = bar.add_task("", total=None, counted="")

        def progress(what: str, iteration: int, done: int, total: int) -> None:
            nonlocal shown, task
            if shown is None or not shown.is_same(what, iteration):
                shown = _Step(what, iteration, iterations)
                bar.remove_task(task)
                task = bar.add_task(shown.name, total=total or None, counted="")
            if total:
                counted = f"{done}/{total}"
                if shown.of_scans:
                    counted += f" scans {shown.rate(done):.0f}/s"
                # however short it was: what is done is seen
                bar.update(task, completed=done, counted=counted, refresh=done == total)

        yield progress


class _Step:
    """What is being done, since when; only iterations count scans."""

    def __init__(self, what: str, iteration: int, iterations: int) -> None:
        self.name = f"{what}, iteration {iteration} of at most {iterations}" if iteration else what
        self.of_scans = iteration > 0
        self._which, self._started = (what, iteration), time.monotonic()

    def is_same(self, what: str, iteration: int) -> bool:
        return self._which == (what, iteration)

    def seconds(self) -> float:
        return time.monotonic() - self._started

    def rate(self, done: int) -> float:
        """How many per second."""
        return done / max(self.seconds(), 1e-3)


class _Lines:
    """A line every few seconds, and when an iteration has looked at all scans."""

    def __init__(self, iterations: int) -> None:
        self._iterations, self._said = iterations, 0
        self._now = _Step("preparing", 0, iterations), 0, 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._now_and_then, daemon=True)

    def __enter__(self) -> "_Lines":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def __call__(self, what: str, iteration: int, done: int, total: int) -> None:
        step = self._now[0]
        if not step.is_same(what, iteration):
            step = _Step(what, iteration, self._iterations)
        self._now = step, done, total
        if 0 < total == done and iteration > self._said:
            self._said = iteration
            self._say()

    def _now_and_then(self) -> None:
        while not self._ended.wait(_EVERY):
            self._say()

    def _say(self) -> None:
        step, done, total = self._now
        if not total:
            say(f"{step.name}: {step.seconds():.0f} s so far")
            return
        text, rate = f"{step.name}: {done} of {total}", step.rate(done)
        if step.of_scans:
            text += " scans"
            if step.seconds() > _AT_ONCE:
                text += f", {rate:.0f}/s"
        if done < total:
            text += f", {(total - done) / max(rate, 1e-3):.0f} s left"
        say(text)
