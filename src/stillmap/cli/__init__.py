"""The command line: one file per command. Only this package prints and exits."""

import argparse
import logging
import os
import signal
import sys
from types import FrameType

from stillmap import __version__
from stillmap.cli import config, convert, eval, filter, info, map, simulate
from stillmap.cli.progress import say
from stillmap.errors import InputError

EXIT_OURS, EXIT_INPUT, EXIT_INTERRUPTED, EXIT_TERMINATED = 1, 2, 130, 143

_EPILOG = """examples:
  stillmap info log.clf.gz              what is in a recording
  stillmap map log.clf.gz -o out        map it; then open out/report.html
  stillmap filter out -o clean.clf      the recording without what moved
  stillmap convert log.bag -o log.mcap  one format to another
  stillmap simulate hall -o sim         a recording with truth
  stillmap eval labels out sim          how good the labels are
"""


class _Parser(argparse.ArgumentParser):
    """Errors are one line and exit with status 2, like every other bad call."""

    def error(self, message: str) -> None:  # type: ignore[override]
        self.exit(EXIT_INPUT, f"{self.prog}: {message} (see {self.prog} --help)\n")

    def exit(self, status: int = 0, message: str | None = None) -> None:  # type: ignore[override]
        _flush_stdout()  # --help and --version may be going into a pipe that has closed
        super().exit(status, message)


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    top = _Parser(
        prog="stillmap",
        description="Clean maps of what stands still, from recordings of places full of movers.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"stillmap {__version__}")
    top.add_argument("-v", "--verbose", action="store_true", help="say more while working")
    commands = top.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in (map, info, filter, convert, simulate, eval, config):
        command.add_parser(commands)
    return top


def main(argv: list[str] | None = None) -> int:
    """Runs one command; returns its exit status."""
    try:
        args = parser().parse_args(argv)
        logging.basicConfig(
            level=logging.INFO if args.verbose else logging.WARNING, format="stillmap: %(message)s"
        )
        signal.signal(signal.SIGTERM, _terminated)
        status: int = args.run(args)
        _flush_stdout()
        return status
    except InputError as error:
        say(str(error))
        return EXIT_INPUT
    except KeyboardInterrupt:
        return _interrupted()
    except BrokenPipeError:
        # the reader of our output has gone: nothing more can be said, and nothing is wrong
        _drop_stdout()
        return 0
    except OSError as error:
        say(str(error))  # a full disk behind stdout, a file that vanished while it was read
        _drop_stdout()
        return EXIT_INPUT
    except Exception as error:
        behind = _stopped_by(error)
        if behind is None:
            raise
        return EXIT_TERMINATED if isinstance(behind, SystemExit) else _interrupted()


def _stopped_by(error: BaseException | None) -> BaseException | None:
    """The Ctrl-C or SIGTERM behind an error: a module that is just being imported hides them."""
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


def _terminated(signum: int, frame: FrameType | None) -> None:  # noqa: ARG001
    # leaves through the same clean-up as any exception: temporary folders go
    sys.exit(EXIT_TERMINATED)
