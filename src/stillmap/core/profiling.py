"""Progress, time and memory of the stages of a run."""

import os
import resource
import shutil
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
_WIDE = 100  # columns of a terminal: from there on with longer texts


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
            stage = self._stages.setdefault(name, {"seconds": 0.0, "cpu_seconds": 0.0})
            stage["seconds"] += time.perf_counter() - started
            stage["cpu_seconds"] += time.process_time() - cpu  # of all threads
            stage["peak_memory_bytes"] = peak_memory_bytes()

    def add(self, earlier: Mapping[str, Mapping[str, Any]]) -> None:
        """Add the stages of the run that this one resumes, as `to_dict` returned them."""
        for name, before in earlier.items():
            stage = self._stages.setdefault(name, {"seconds": 0.0, "cpu_seconds": 0.0})
            stage["seconds"] += before["seconds"]
            stage["cpu_seconds"] += before["cpu_seconds"]
            known = stage.get("peak_memory_bytes", 0)
            stage["peak_memory_bytes"] = max(known, before["peak_memory_bytes"])

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


def _shows_bar() -> bool:
    return is_terminal(sys.stderr) or bool(os.environ.get("FORCE_COLOR"))


def print_line(line: str) -> None:
    """Print a line to stderr."""
    print(line, file=sys.stderr, flush=True)


@contextmanager
def show_progress(iterations: int, say: Callable[[str], None] = print_line) -> Iterator[Progress]:
    """A Progress that shows step, iteration, scans, rate and time left.

    Args:
        iterations: of EM, at most.
        say: prints a line where stderr is no terminal.
    """
    is_wide = not _shows_bar() or shutil.get_terminal_size().columns >= _WIDE
    with show_steps(say) as show:

        def progress(what: str, iteration: int, done: int, total: int) -> None:
            name = what
            if iteration and is_wide:
                name += f", iteration {iteration} of at most {iterations}"
            elif iteration:
                name += f" {iteration}/{iterations}"
            show(name, done, total, "scans" if iteration else "")

        yield progress


@contextmanager
def show_steps(say: Callable[[str], None] = print_line) -> Iterator[Show]:
    """Show steps on stderr: by a bar on a terminal, elsewhere by a line now and then."""
    if _shows_bar():
        with _show_bar() as show:
            yield show
    else:
        with _Lines(say) as lines:
            yield lines.update


@contextmanager
def _show_bar() -> Iterator[Show]:
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar
    from rich.table import Column

    columns = (
        TextColumn("{task.description}", table_column=Column(no_wrap=True)),
        BarColumn(bar_width=None),
        TextColumn("{task.fields[counted]}", table_column=Column(no_wrap=True)),
        TimeRemainingColumn(table_column=Column(no_wrap=True)),
    )
    bar = Bar(*columns, console=Console(stderr=True), transient=True, expand=True)
    shown = ""

    def update(step: str, done: float, total: float, unit: str = "") -> None:  # noqa: ARG001
        nonlocal shown
        bar.start()  # not before the first progress
        if step != shown:
            for task in bar.task_ids:
                bar.remove_task(task)
            bar.add_task(step, total=total or None, counted="")
            shown = step
        counted = f"{100.0 * done:.0f} %" if isinstance(done, float) else f"{done}/{total}"
        # a finished step is shown even if it was short
        bar.update(
            bar.task_ids[0],
            completed=done,
            counted=counted if total else "",
            refresh=done == total,
        )

    try:
        yield update
    finally:
        bar.stop()


class _Lines:
    """Print progress every `_LINE_PERIOD` seconds, and once when scans of a new iteration end."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._now: tuple[str, float, float, str] = ("preparing", 0, 0, "")
        self._started, self._ended = time.monotonic(), ""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "_Lines":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def update(self, step: str, done: float, total: float, unit: str = "") -> None:
        if step != self._now[0]:
            self._started = time.monotonic()
        self._now = step, done, total, unit
        iteration = step.rpartition(",")[2]
        if unit == "scans" and 0 < total == done and iteration != self._ended:
            self._ended = iteration
            self._report()

    def _run(self) -> None:
        while not self._stop.wait(_LINE_PERIOD):
            self._report()

    def _report(self) -> None:
        (step, done, total, unit), seconds = self._now, time.monotonic() - self._started
        if not total:
            text = f"{seconds:.0f} s so far"
        elif isinstance(done, float):
            text = f"{100.0 * done:.0f} %"
        else:
            rate = done / max(seconds, 1e-3)
            text = f"{done} of {total} {unit}, {rate:.0f}/s" if unit else f"{done} of {total}"
            if done < total:
                text += f", {(total - done) / max(rate, 1e-3):.0f} s left"
        self._say(f"{step}: {text}")


def reset_peak_memory() -> None:
    """Forget the peak memory of this process so far; without effect where there is no Linux."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
