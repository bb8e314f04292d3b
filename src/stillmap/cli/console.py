"""What is said, on stderr: a bar on a terminal, a line now and then elsewhere, nothing if quiet.

What goes to stdout for machines: one JSON object, alone.

Ctrl-C and SIGTERM: an exception in the main thread, but none while a module is being imported.

A library that is just being imported may take the exception for a missing module and go on
without it, may turn it into an error of its own, or may execute text as code, after which Python
believes that nobody caught the interrupt. So the signal is sent again until the import is over.
Likewise while points are packed as LAZ: an exception on the way to the file becomes another one.

Colours, on terminals alone.
"""

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stillmap.core.profiling import Progress


_STYLES = {"error": "1;31", "warning": "33"}  # bold red, yellow


def uses_color(stream: IO[str]) -> bool:
    """Whether to write colours: as NO_COLOR, FORCE_COLOR, CLICOLOR_FORCE and TERM say."""
    if os.environ.get("NO_COLOR"):
        return False
    if os.environ.get("FORCE_COLOR") or os.environ.get("CLICOLOR_FORCE", "0") not in ("", "0"):
        return True
    return is_terminal(stream)


def is_terminal(stream: IO[str] | None) -> bool:
    """Whether a stream goes to a terminal that knows more than plain text."""
    return stream is not None and stream.isatty() and os.environ.get("TERM") != "dumb"


def colorize(text: str, style: str, stream: IO[str] | None) -> str:
    """The text in the colour of a style, "error" or "warning", where the stream shows colours."""
    if stream is None or not uses_color(stream):
        return text
    return f"\x1b[{_STYLES[style]}m{text}\x1b[0m"


_AT_ONCE = 0.01  # s: what takes no longer has no rate

_EVERY = 10.0  # s between lines where there is no terminal


def say(line: str) -> None:
    """One line on stderr. That nobody listens there any more is no reason to give up the work."""
    marked = "warning:"
    if line.startswith(marked):
        line = colorize(marked, "warning", sys.stderr) + line[len(marked) :]
    _write(f"stillmap: {line}")


def fail(line: str) -> None:
    """The one line that says why nothing came of it."""
    _write(f"{colorize('stillmap:', 'error', sys.stderr)} {line}")


def _write(line: str) -> None:
    if sys.stderr is None:
        return
    try:
        print(line, file=sys.stderr, flush=True)
    except OSError:  # nobody listens any more, or a full disk does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


@contextmanager
def show_progress(quiet: bool, iterations: int) -> "Iterator[Progress]":
    """A Progress that shows step, iteration, scans, rate and time left."""
    if quiet or sys.stderr is None:  # None: it was closed before we began
        from stillmap.core.profiling import no_progress

        yield no_progress
    elif is_terminal(sys.stderr):
        with _bar(iterations) as progress:
            yield progress
    else:
        with _Lines(iterations) as lines:
            yield lines


@contextmanager
def show_share(quiet: bool, what: str) -> "Iterator[Callable[[float], None] | None]":
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


def print_json(content: dict[str, Any]) -> None:
    """One object on stdout; numbers that are not finite become null."""
    from stillmap.core.json import to_jsonable

    print(json.dumps(to_jsonable(content), allow_nan=False))


def list_files(folder: Path) -> list[str]:
    """The files of a folder, with those of its folders, as paths below it."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


EXIT_INTERRUPTED, EXIT_TERMINATED = 130, 143

_SOON = 0.02  # s until a signal that came at a bad moment is sent again

_IMPORTS = "<frozen importlib"  # where Python says that the code of its imports is

_PACKING = "lazrsbackend.py"  # of laspy


def handle_signals(command: CodeType) -> None:
    """From now on Ctrl-C raises KeyboardInterrupt, and SIGTERM SystemExit, within `command`.

    Both leave through the clean-up of any exception: temporary folders go. Ctrl-C that was
    ignored when we began, as in the background of a shell script, stays ignored.
    """

    main = threading.get_ident()  # Python hears signals in it alone

    def heard(number: int, frame: FrameType | None) -> None:
        if _is_at_a_bad_moment(frame, command):
            again = threading.Timer(_SOON, signal.pthread_kill, (main, number))
            again.daemon = True
            again.start()
        elif number == signal.SIGINT:
            raise KeyboardInterrupt
        else:
            sys.exit(EXIT_TERMINATED)

    signal.signal(signal.SIGTERM, heard)
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, heard)


def _is_at_a_bad_moment(frame: FrameType | None, command: CodeType) -> bool:
    while frame is not None and frame.f_code is not command:
        name = frame.f_code.co_filename
        if name.startswith(_IMPORTS) or name.endswith(_PACKING):
            return True
        frame = frame.f_back
    return False
