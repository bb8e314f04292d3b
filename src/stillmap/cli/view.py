"""`stillmap view DIR`: look at a result."""

import argparse
import os
import sys
from pathlib import Path

from stillmap.cli.commands import COMMANDS
from stillmap.cli.progress import say
from stillmap.errors import InputError

_REPORT = "report.html"

_EPILOG = """examples:
  stillmap view out                     in the browser
  firefox "$(stillmap view out --print)"
"""


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    p = commands.add_parser(
        "view",
        help=COMMANDS["view"],
        description="Open the report of a result in the browser: the raw map beside the clean one, "
        "what moved and where, and how the run went. Where there is no screen, say where it is.",
        epilog=_EPILOG,
    )
    p.add_argument("result", metavar="DIR", help="what `stillmap map` wrote")
    p.add_argument("--print", action="store_true", help="print the path of the report instead")
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Opens the report.

    Raises:
        InputError: DIR is no result.
    """
    report = _report(Path(args.result))
    if args.print:
        print(report)
    elif not _opened(report):
        say(f"no browser to be had here; the report is {report}")
    return 0


def _report(folder: Path) -> Path:
    hint = "DIR is what `stillmap map` wrote"
    if not folder.exists():
        raise InputError("does not exist", where=str(folder), hint=hint)
    report = Path(os.path.abspath(folder)) / _REPORT
    if not report.is_file():
        raise InputError(f"is no result: there is no {_REPORT} in it", where=str(folder), hint=hint)
    return report


def _opened(report: Path) -> bool:
    # without a screen webbrowser would start a browser of text within the terminal
    screens = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    if sys.platform != "darwin" and not any(os.environ.get(name) for name in screens):
        return False
    import webbrowser

    return webbrowser.open(report.as_uri())
