"""Entry point of `stillmap`: parse, run one command, turn errors into exit statuses."""

import argparse
import ctypes
import io
import logging
import os
import sys
from contextlib import suppress

from stillmap.cli import console
from stillmap.cli.parser import EXIT_INPUT, parse
from stillmap.core import errors

EXIT_DEFECT = 1
_M_ARENA_MAX, _HEAPS = -8, 2  # parameter of glibc's mallopt, and heaps for all threads


def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit status."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # file names need not be valid UTF-8
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        args = parse(sys.argv[1:] if argv is None else argv)
        _set_up_logging(args)
        console.handle_signals(main.__code__)
        _share_heaps()
        status: int = args.run(args)
        if sys.stdout is not None:  # None: closed before the start
            sys.stdout.flush()
        return status
    except Exception as error:
        return _report_failure(error)
    except KeyboardInterrupt:
        return _report_interrupt()


def _share_heaps() -> None:
    """Let threads share heaps: each keeps freed blocks, and glibc makes one for each thread."""
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(_M_ARENA_MAX, _HEAPS)


def _report_failure(error: Exception) -> int:
    """Print why the command failed; the exit status."""
    # a clean-up may fail, too, as on a terminal that has gone
    error = errors.memory_error(error) if errors.is_out_of_memory(error) else error
    cause = _find_interrupt(error)
    if cause is not None:
        return console.EXIT_TERMINATED if isinstance(cause, SystemExit) else _report_interrupt()
    if isinstance(error, errors.InputError):
        console.fail(str(console.in_flags(error)))
    elif isinstance(error, BrokenPipeError):
        # the reader of stdout has closed it: not an error
        _drop_stdout()
        return 0
    elif isinstance(error, OSError):
        # a full disk behind stdout, or a file that vanished while it was read
        console.fail(f"{error.filename or 'the output'}: {error.strerror or error}")
        _drop_stdout()
    else:
        _report_defect(error)
        return EXIT_DEFECT
    return EXIT_INPUT


class _Handler(logging.Handler):
    """Print log messages like all others, above a progress bar."""

    def emit(self, record: logging.LogRecord) -> None:
        console.say(record.getMessage())


def _set_up_logging(args: argparse.Namespace) -> None:
    root = logging.getLogger()
    root.setLevel(logging.INFO if args.verbose else logging.WARNING)
    if not any(isinstance(handler, _Handler) for handler in root.handlers):
        root.addHandler(_Handler())


def _report_defect(error: Exception) -> None:
    """Print the trace and ask for a report."""
    import traceback

    for line in "".join(traceback.format_exception(error)).splitlines():
        console.write_line(errors.printable(line))
    console.fail("this is a defect of stillmap: please report it, with the lines above")


def _find_interrupt(error: BaseException | None) -> BaseException | None:
    """The Ctrl-C or SIGTERM that an error was raised from during clean-up, or None."""
    seen = list[BaseException]()  # a library may raise an error from a later one
    while error is not None and not any(error is one for one in seen):
        if isinstance(error, KeyboardInterrupt | SystemExit):
            return error
        seen.append(error)
        error = error.__cause__ or error.__context__
    return None


def _report_interrupt() -> int:
    console.say("interrupted, nothing was half-written")
    return console.EXIT_INTERRUPTED


def _drop_stdout() -> None:
    """Discard what is buffered, which would fail once more when Python exits."""
    with suppress(OSError, AttributeError):  # None: closed before the start; or no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
