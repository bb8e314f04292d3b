"""The command line: one file per command. Only this package prints and exits."""

import argparse
import io
import logging
import os
import sys
from pathlib import Path
from typing import NoReturn

from stillmap.cli.console import EXIT_INTERRUPTED, EXIT_TERMINATED, fail, handle_signals, say
from stillmap.cli.parser import COMMANDS, EXIT_INPUT, parser
from stillmap.core.errors import InputError, closest_match

EXIT_OURS = 1

_MANY = 10_000  # names of a folder in which one like a missing one is looked for


def main(argv: list[str] | None = None) -> int:
    """Runs one command; returns its exit status."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # file names need not be text
        sys.stdout.reconfigure(errors="backslashreplace")
    args = argparse.Namespace()
    try:
        if "_ARGCOMPLETE" in os.environ:
            _complete()
        args = _parsed(sys.argv[1:] if argv is None else argv)
        _log(args)
        handle_signals(main.__code__)
        status: int = args.run(args)
        _flush_stdout()
        return status
    except InputError as error:
        fail(str(_with_similar_name(error, args)))
        return EXIT_INPUT
    except KeyboardInterrupt:
        return _interrupted()
    except BrokenPipeError:
        # the reader of our output has gone: nothing more can be said, and nothing is wrong
        _drop_stdout()
        return 0
    except OSError as error:
        # a full disk behind stdout, a file that vanished while it was read
        fail(f"{error.filename or 'the output'}: {error.strerror or error}")
        _drop_stdout()
        return EXIT_INPUT
    except MemoryError as error:
        fail(f"not enough memory{': ' if str(error) else ''}{error}")
        return EXIT_INPUT
    except Exception as error:
        behind = _stopped_by(error)
        if behind is not None:
            return EXIT_TERMINATED if isinstance(behind, SystemExit) else _interrupted()
        _report_defect(error)
        return EXIT_OURS


def _parsed(words: list[str]) -> argparse.Namespace:
    command = next((word for word in words if not word.startswith("-")), "")
    top = parser([command])
    args = top.parse_args(words)
    if args.command is None:
        _show_commands(top)
    return args


def _show_commands(top: argparse.ArgumentParser) -> NoReturn:
    """What to do with a call without a command."""
    listed = "".join(f"  {name:<12} {about}\n" for name, about in COMMANDS.items())
    usage = f"{top.format_usage()}\ncommands:\n{listed}\nsee stillmap --help\n"
    top.exit(EXIT_INPUT, usage)


def _complete() -> NoReturn:
    """Answers the shell that asks how a line may go on."""
    from stillmap.cli.completion import answer

    answer(parser(os.environ.get("COMP_LINE", "").split()))


class _Said(logging.Handler):
    """What the package has to say goes where everything is said, above a bar that is shown."""

    def emit(self, record: logging.LogRecord) -> None:
        say(record.getMessage())


def _log(args: argparse.Namespace) -> None:
    root = logging.getLogger()
    root.setLevel(logging.INFO if args.verbose else logging.WARNING)
    if not any(isinstance(handler, _Said) for handler in root.handlers):
        root.addHandler(_Said())


def _with_similar_name(error: InputError, args: argparse.Namespace) -> InputError:
    """A file that was named but is not there: one beside it with nearly that name was meant?"""
    path = Path(error.where)
    given = {Path(word) for word in vars(args).values() if isinstance(word, str | Path)}
    if not error.what.startswith(("does not exist", "cannot be read")) or path not in given:
        return error
    try:
        if os.path.lexists(path) or not path.parent.is_dir():
            return error
        with os.scandir(path.parent) as entries:
            names = [entry.name for entry, _ in zip(entries, range(_MANY), strict=False)]
    except (OSError, ValueError):
        return error
    similar = closest_match(path.name, names)
    if similar is None:
        return error
    hint = f"did you mean '{path.with_name(similar)}'?"
    return InputError(error.what, where=error.where, hint=hint)


def _report_defect(error: Exception) -> None:
    """The trace is what we want to be sent: without it a report says little."""
    import traceback

    if sys.stderr is not None:
        traceback.print_exception(error)
    fail("this is a defect of stillmap: please report it, with the lines above")


def _stopped_by(error: BaseException | None) -> BaseException | None:
    """The Ctrl-C or SIGTERM behind an error that was made of it while something was closed."""
    while error is not None and not isinstance(error, KeyboardInterrupt | SystemExit):
        error = error.__cause__ or error.__context__
    return error


def _interrupted() -> int:
    say("interrupted, nothing was half-written")
    return EXIT_INTERRUPTED


def _flush_stdout() -> None:
    if sys.stdout is not None:  # None: it was closed before we began
        sys.stdout.flush()


def _drop_stdout() -> None:
    """What is still buffered goes nowhere, instead of failing once more when Python ends."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
