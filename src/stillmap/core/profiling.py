"""Progress, time and memory of the stages of a run."""

import os
import resource
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, Protocol

# stage, iteration (0: outside the loop), scans done, of how many (0: not counted)
Progress = Callable[[str, int, int, int], None]

_LINE_PERIOD = 10.0  # s between lines of progress without a terminal
_SILENT_PERIOD = 30.0  # s between lines of a step that says nothing
_STAGE = ("seconds", "cpu_seconds", "peak_memory_bytes")


class Show(Protocol):
    """Shows a step, how much of it is done, and of how much (0: not counted); `unit` is counted."""

    def __call__(self, step: str, done: float, total: float, unit: str = "") -> None: ...


def no_progress(stage: str, iteration: int, done: int, total: int) -> None:
    """Discards progress."""


class StageTimer:
    """Wall-clock and CPU time per stage, summed over calls, and peak memory after the last one."""

    def __init__(self) -> None:
        self._stages: dict[str, dict[str, Any]] = {}

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Add the time of the block to stage `name`."""
        started, cpu = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            seconds = time.perf_counter() - started
            self._add(name, seconds, time.process_time() - cpu, peak_memory_bytes())

    def add(self, earlier: Mapping[str, Mapping[str, Any]]) -> None:
        """Add the stages of the run that this one resumes, as `to_dict` returned them."""
        for name, before in earlier.items():
            self._add(name, *(before[key] for key in _STAGE))

    def _add(self, name: str, seconds: float, cpu_seconds: float, peak_memory: int) -> None:
        """Add to a stage; CPU time is that of all threads."""
        stage = self._stages.setdefault(name, dict.fromkeys(_STAGE, 0))
        stage["seconds"] += seconds
        stage["cpu_seconds"] += cpu_seconds
        stage["peak_memory_bytes"] = max(stage["peak_memory_bytes"], peak_memory)

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """`seconds`, `cpu_seconds` and `peak_memory_bytes` (of the process so far) by stage."""
        return {name: dict(stage) for name, stage in self._stages.items()}


def peak_memory_bytes() -> int:
    """Peak resident memory of this process."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def is_terminal(stream: IO[str] | None) -> bool:
    """True if a stream is a terminal that supports control sequences."""
    return stream is not None and stream.isatty() and os.environ.get("TERM") != "dumb"


def print_line(line: str) -> None:
    """Print a line to stderr."""
    print(line, file=sys.stderr, flush=True)


def prefix_steps(progress: Progress, of: str) -> Progress:
    """A Progress that says of what each step is."""
    return lambda stage, *counts: progress(f"{of}: {stage}", *counts)


def show_iterations(show: Show, iterations: int) -> Progress:
    """A Progress that shows steps, of EM with its iteration, of at most so many."""

    def progress(what: str, iteration: int, done: int, total: int) -> None:
        if iteration:
            show(f"{what}, iteration {iteration}/{iterations}", done, total, "scans")
        else:
            show(what, done, total)

    return progress


@contextmanager
def show_steps(say: Callable[[str], None] = print_line, first: str = "") -> Iterator[Show]:
    """Show steps on stderr: by a bar on a terminal, elsewhere by a line that `say` prints.

    Args:
        say: prints a line.
        first: the step that begins at once, if it is known.
    """
    if is_terminal(sys.stderr) or os.environ.get("FORCE_COLOR"):
        with _show_bar() as show:
            yield show
    else:
        with _Lines(say, first).watch() as show:
            yield show


@contextmanager
def _show_bar() -> Iterator[Show]:
    from rich.console import Console
    from rich.progress import BarColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = "{task.description}", BarColumn(None), "{task.fields[counted]}", TimeRemainingColumn()
    bar = Bar(*columns, console=Console(stderr=True), transient=True, expand=True)
    task, shown = bar.add_task("", counted=""), ""

    def update(step: str, done: float, total: float, unit: str = "") -> None:  # noqa: ARG001
        nonlocal shown
        bar.start()  # not before the first progress
        if step != shown:
            bar.reset(task, description=step, total=total or None)
            shown = step
        counted = f"{100.0 * done:.0f} %" if isinstance(done, float) else f"{done}/{total}"
        # a finished step is shown even if it was short
        text = counted if total else ""
        bar.update(task, completed=done, counted=text, refresh=done == total)

    try:
        yield update
    finally:
        bar.stop()


class _Lines:
    """Prints progress every `_LINE_PERIOD` seconds, and once when scans of an iteration end.

    A step that says nothing for `_SILENT_PERIOD` seconds is named again, by a thread of its own.
    """

    def __init__(self, say: Callable[[str], None], first: str) -> None:
        self._say, self._step, self._ended = say, first, ""
        self._started = self._printed = time.monotonic()
        self._is_over = threading.Event()

    def update(self, step: str, done: float, total: float, unit: str = "") -> None:
        now = time.monotonic()
        if step != self._step:
            self._step, self._started = step, now
        iteration = step.rpartition(",")[2]
        is_end = unit == "scans" and 0 < total == done and iteration != self._ended
        if is_end or now - self._printed >= _LINE_PERIOD:
            self._printed = now
            self._ended = iteration if is_end else self._ended
            self._say(f"{step}: {_describe(done, total, unit, now - self._started)}")

    @contextmanager
    def watch(self) -> Iterator[Show]:
        """The function `update`; meanwhile steps that say nothing are named."""
        watcher = threading.Thread(target=self._name_silent_steps, daemon=True)
        watcher.start()
        try:
            yield self.update
        finally:
            self._is_over.set()
            watcher.join()

    def _name_silent_steps(self) -> None:
        while not self._is_over.wait(_SILENT_PERIOD / 10.0):
            now = time.monotonic()
            if self._step and now - self._printed >= _SILENT_PERIOD:
                self._printed = now
                self._say(f"{self._step}: {now - self._started:.0f} s so far")


def _describe(done: float, total: float, unit: str, seconds: float) -> str:
    """Progress of a step as text: the count, its total, the rate and the time left."""
    if not total:
        return "begins"
    if isinstance(done, float):
        return f"{100.0 * done:.0f} %"
    rate = done / max(seconds, 1e-3)
    text = f"{done} of {total} {unit}, {rate:.0f}/s" if unit else f"{done} of {total}"
    left = f", {(total - done) / max(rate, 1e-3):.0f} s left" if done < total else ""
    return text + left


def reset_peak_memory() -> None:
    """Forget the peak memory of this process so far; without effect where there is no Linux."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
