"""The command line: one file per command. Only this package prints and exits."""

import argparse
import logging
import os
import signal
import sys
from types import FrameType

from stillmap import __version__
from stillmap.cli import config, eval, info, map, simulate
from stillmap.errors import InputError

EXIT_OURS, EXIT_INPUT, EXIT_INTERRUPTED, EXIT_TERMINATED = 1, 2, 130, 143

_EPILOG = """examples:
  stillmap info log.clf.gz              what is in a recording
  stillmap map log.clf.gz -o out        map it; then open out/report.html
  stillmap simulate hall -o sim         a recording with truth
  stillmap eval labels out sim          how good the labels are
"""


class _Parser(argparse.ArgumentParser):
    """Errors are one line and exit with status 2, like every other bad call."""

    def error(self, message: str) -> None:  # type: ignore[override]
        self.exit(EXIT_INPUT, f"{self.prog}: {message} (see {self.prog} --help)\n")


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
    for command in (map, info, simulate, eval, config):
        command.add_parser(commands)
    return top


def main(argv: list[str] | None = None) -> int:
    """Runs one command; returns its exit status."""
    args = parser().parse_args(argv)
    logging.basicConfig(
        level=logging.INFO if args.verbose else logging.WARNING, format="stillmap: %(message)s"
    )
    signal.signal(signal.SIGTERM, _terminated)
    try:
        status: int = args.run(args)
        sys.stdout.flush()
        return status
    except InputError as error:
        print(f"stillmap: {error}", file=sys.stderr)
        return EXIT_INPUT
    except KeyboardInterrupt:
        print("stillmap: interrupted, nothing was half-written", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # the reader of our output has gone: nothing more can be said, and nothing is wrong
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _terminated(signum: int, frame: FrameType | None) -> None:  # noqa: ARG001
    # leaves through the same clean-up as any exception: temporary folders go
    sys.exit(EXIT_TERMINATED)
