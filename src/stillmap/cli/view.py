"""`stillmap view DIR`: a result in the browser, or its report.

Imports that take long are made inside the functions, so that `--help` and completion are quick.
"""

import argparse
import os
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from stillmap.cli.console import say, shown_share
from stillmap.cli.parser import COMMANDS
from stillmap.core.errors import InputError, MissingExtra, import_extra

if TYPE_CHECKING:
    from stillmap.results.folder import ResultFolder
    from stillmap.viewer.tracks import Beams


def has_screen() -> bool:
    """Whether there is one to open: without a screen it would be one of text in the terminal."""
    screens = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    return sys.platform == "darwin" or any(os.environ.get(name) for name in screens)


def opened(address: str) -> bool:
    """Open an address; whether that went well. Some browsers come back when they are closed."""
    if not has_screen():
        return False
    import webbrowser

    return webbrowser.open(address)


def opened_beside(address: str) -> bool:
    """The same without waiting for it; whether there is a screen."""
    if has_screen():
        threading.Thread(target=opened, args=(address,), daemon=True).start()
        return True
    return False


_REPORT = "report.html"

_LAST_PORT = 65_535

_EPILOG = """examples:
  stillmap view out                     map, beams, points, models and objects over time
  stillmap view out --report            the report of the run
  firefox "$(stillmap view out --print)"
  ssh -L 8080:127.0.0.1:8080 robot stillmap view out --port 8080
"""


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    p = commands.add_parser(
        "view",
        help=COMMANDS["view"],
        description="Show a result in the browser, scan by scan: map, beams, points, surface, the "
        "robot's way, and what moved. The page is served to this machine alone, until Ctrl-C, and "
        "asks for nothing from outside. It needs `pip install 'stillmap[viewer]'`; without it the "
        "report is opened. Where there is no screen, say where to look.",
        epilog=_EPILOG,
    )
    p.add_argument("result", metavar="DIR", help="what `stillmap map` wrote")
    p.add_argument("--report", action="store_true", help="open the report of the run instead")
    p.add_argument("--print", action="store_true", help="print the path of the report instead")
    p.add_argument(
        "--port", type=int, metavar="N", default=0, help="of the page (default: one that is free)"
    )
    p.add_argument("--input", metavar="FILE", help="the recording, if it is not where it was")
    p.add_argument(
        "--no-beams", action="store_true", help="leave the recording alone, which may be large"
    )
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Shows the result, or opens the report.

    Raises:
        InputError: DIR is no result, or a file of it is damaged.
    """
    if not 0 <= args.port <= _LAST_PORT:
        raise InputError(f"--port wants 0 to {_LAST_PORT}, got {args.port}")
    report = _report(Path(args.result))
    if args.print:
        print(report)
    elif args.report:
        _show_report(report)
    else:
        try:
            import_extra("viser", args.result, "shown over time", group="viewer")
        except MissingExtra as error:
            say(f"{error}; the report is shown")
            _show_report(report)
            return 0
            viewed(args, Path(args.result))
    return 0


def _show_report(report: Path) -> None:
    if not opened(report.as_uri()):
        say(f"no browser to be had here; the report is {report}")


def _report(folder: Path) -> Path:
    hint = "DIR is what `stillmap map` wrote"
    if not folder.exists():
        raise InputError("does not exist", where=str(folder), hint=hint)
    report = Path(os.path.abspath(folder)) / _REPORT
    if not report.is_file():
        raise InputError(f"is no result: there is no {_REPORT} in it", where=str(folder), hint=hint)
    return report


def viewed(args: argparse.Namespace, folder: Path) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        InputError: a file of the result is damaged, or the recording that was named is another.
    """
    from stillmap.results.folder import open_result
    from stillmap.viewer.scene import read_scene
    from stillmap.viewer.window import Window

    mapped = open_result(folder, args.input)
    scene = read_scene(folder)
    try:
        beams = None if args.no_beams else _beams(mapped, args.quiet)
    except InputError as error:
        if args.input:
            raise
        beams = None
        say(f"without beams: {error}")
        scene = replace(scene, notes=[f"Without beams: {error}", *scene.notes])
    window = Window(scene, beams, args.port)
    try:
        where = f"{args.result} is at {window.url}"
        here = "" if opened_beside(window.url) else "no browser to be had here; "
        say(f"{here}{where}, until Ctrl-C")
        while True:
            window.step()
    except KeyboardInterrupt:  # that is how it ends
        pass
    finally:
        window.close()


def _beams(mapped: "ResultFolder", quiet: bool) -> "Beams":
    from stillmap.io.trajectory import poses_from_tum
    from stillmap.results.folder import is_deskewed
    from stillmap.slam import SlamOptions
    from stillmap.viewer.tracks import Beams

    with shown_share(quiet, "reading") as tell:
        recording, labels = mapped.read(tell)
    poses = poses_from_tum(mapped.folder / "trajectory.tum", recording)
    slam = SlamOptions(deskew=is_deskewed(mapped.record))
    return Beams(recording, labels.p_static, poses, slam)
