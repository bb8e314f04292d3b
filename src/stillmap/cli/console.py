"""Messages and progress on stderr, text and JSON on stdout, and signals."""

import os
import re
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType
from typing import IO, Any

from stillmap.core import profiling
from stillmap.core.errors import InputError, printable
from stillmap.core.interrupts import defers_signals_in, send_again
from stillmap.core.profiling import Progress, Show, is_terminal

_EMPTY: tuple[Any, ...] = (None, "", [], {}, ())
_WIDTH = 96  # characters of an object on one line
_STYLES = {"error": "1;31", "warning": "33"}  # bold red, yellow


def uses_color(stream: IO[str]) -> bool:
    """True if output is colored; NO_COLOR, FORCE_COLOR and TERM decide."""
    if os.environ.get("NO_COLOR"):
        return False
    return bool(os.environ.get("FORCE_COLOR")) or is_terminal(stream)


def colorize(text: str, style: str, stream: IO[str] | None) -> str:
    """The text in the color of a style, "error" or "warning", if the stream shows colors."""
    if stream is None or not uses_color(stream):
        return text
    return f"\x1b[{_STYLES[style]}m{text}\x1b[0m"


def say(line: str) -> None:
    """Print one line to stderr, control characters escaped; a closed stderr is ignored."""
    prefix, line = "warning:", printable(line)
    if line.startswith(prefix):
        line = colorize(prefix, "warning", sys.stderr) + line[len(prefix) :]
    write_line(f"stillmap: {line}")


def fail(line: str) -> None:
    """Print the error that ends the command, control characters escaped."""
    write_line(f"{colorize('stillmap:', 'error', sys.stderr)} {printable(line)}")


def write_line(line: str) -> None:
    """Print a line as it is to stderr; a closed stderr is ignored."""
    if sys.stderr is None:
        return
    try:
        # names need not be UTF-8, and a caller may have put another stream there
        print(line.encode("utf-8", "backslashreplace").decode(), file=sys.stderr, flush=True)
    except OSError:  # closed by the reader, a full disk, or a terminal that has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


@contextmanager
def show_steps(quiet: bool, first: str = "") -> Iterator[Show]:
    """A function that shows a step, and how much of it is done; see `core.profiling.Show`."""
    if quiet or sys.stderr is None:  # None: closed before the start
        yield lambda *_: None
    else:
        with profiling.show_steps(say, first) as show:
            yield show


@contextmanager
def show_progress(quiet: bool, iterations: int) -> Iterator[Progress]:
    """A Progress that shows step, iteration, scans, rate and time left; nothing if quiet."""
    with show_steps(quiet) as show:
        yield profiling.show_iterations(show, iterations)


@contextmanager
def show_share(quiet: bool, what: str) -> Iterator[Callable[[float], None]]:
    """A function that shows the share of a job that is done, 0 to 1; nothing if quiet."""
    with show_steps(quiet, what) as show:
        yield lambda share: show(what, float(share), 1.0)


def print_lines(lines: Iterable[str]) -> None:
    """Print lines of text to stdout, control characters escaped."""
    print("\n".join(map(printable, lines)))


def format_rows(content: Mapping[str, Any], indent: str = "") -> Iterator[str]:
    """Yield a line for each entry of a JSON object that is not empty, under the name it has there.

    Of lists of objects and of sentences each item has a line.
    """
    for key, value in content.items():
        is_table = isinstance(value, list) and any(isinstance(item, dict | str) for item in value)
        for item in value if is_table else [value]:
            if item in _EMPTY:
                continue
            text = _format_value(item)
            if isinstance(item, dict) and (dict in map(type, item.values()) or len(text) > _WIDTH):
                yield f"{indent}{key}"
                yield from format_rows(item, f"{indent}  ")
            else:
                yield f"{indent + key:<22}  {text}"


def _format_value(value: Any) -> str:
    if isinstance(value, dict):
        shown = [(key, item) for key, item in value.items() if item not in _EMPTY]
        return ", ".join(f"{key} {_format_value(item)}" for key, item in shown)
    if isinstance(value, list | tuple):
        return ", ".join(map(_format_value, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def print_json(content: dict[str, Any] | list[dict[str, Any]]) -> None:
    """Print one JSON object, or a list of them, to stdout; non-finite numbers become null."""
    import json

    from stillmap.core.json import to_jsonable

    print(json.dumps(to_jsonable(content), allow_nan=False))


def list_files(folder: Path) -> list[str]:
    """Sorted relative paths of all files below a folder."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


EXIT_INTERRUPTED, EXIT_TERMINATED = 130, 143

_IMPORTS = "<frozen importlib"  # file name of the frames of an import
_PACKING = "lazrsbackend.py"  # of laspy


def handle_signals(command: CodeType) -> None:
    """Make Ctrl-C raise KeyboardInterrupt, SIGTERM and SIGHUP SystemExit, within `command`.

    Both run the clean-up of any exception: temporary folders go. SIGHUP comes when the terminal
    goes, as when ssh is cut off. What was ignored at the start, as Ctrl-C in the background of a
    shell script, or SIGHUP by nohup, stays ignored. During an import a signal is
    deferred: a library may take the exception for a missing module, turn it into another error,
    or execute text as code, after which Python reports an uncaught interrupt. Likewise while
    points are packed as LAZ, where the exception becomes another one, and while something is made
    or removed that must not stay; see `core.interrupts`.
    """

    def handle(number: int, frame: FrameType | None) -> None:
        if _must_defer(frame, command):
            send_again(number)
        elif number == signal.SIGINT:
            raise KeyboardInterrupt
        else:
            sys.exit(EXIT_TERMINATED)

    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handle)


def _must_defer(frame: FrameType | None, command: CodeType) -> bool:
    while frame is not None and frame.f_code is not command:
        name = frame.f_code.co_filename
        if name.startswith(_IMPORTS) or name.endswith(_PACKING) or defers_signals_in(frame):
            return True
        frame = frame.f_back
    return False


# an argument in a hint for Python, not a part of a path: of yes or no, a text, or another
_ARGUMENT = re.compile(r"(?<![\w./-])([a-z_]+)=(?:(True|False)\b|\"([^\"]*)\"|(?=\S))")
_FLAGS = {"recording": "input", "name": "to"}  # of arguments with another name


def in_flags(error: InputError) -> InputError:
    """The error with flags in its hint instead of arguments."""

    def to_flag(argument: re.Match[str]) -> str:
        flag = _FLAGS.get(argument[1], argument[1]).replace("_", "-")
        if argument[2]:
            return f"--{flag}" if argument[2] == "True" else f"--no-{flag}"
        return f"--{flag} {argument[3] or ''}"

    hint = _ARGUMENT.sub(to_flag, error.hint)
    return InputError(error.what, where=error.where, hint=hint)
