"""Show a result in the browser, scan by scan: map, beams, points, surface, trajectory and moving
objects; a place session by session, with what changed. The page is served to this machine only,
until Ctrl-C, and requests nothing from outside. It needs the extra `viewer`; without it, the
command that installs it is printed and the report is opened. Without a screen, the address is
printed.

examples:
  stillmap view out                     map, beams, points, models and objects over time
  stillmap view out --report            the report
  stillmap view place                   a place of several sessions, and what changed
  firefox "$(stillmap view out --print)"
  ssh -L 8080:127.0.0.1:8080 robot stillmap view out --port 8080
"""

import argparse
import os
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from stillmap.cli.console import in_flags, say, show_share
from stillmap.core.errors import InputError, MissingExtra, import_extra, printable
from stillmap.core.profiling import is_terminal

if TYPE_CHECKING:
    from stillmap.results.viewer.scene import Beams, Scene


_REPORT, _LAST_PORT = "report.html", 65_535


FLAGS = """
result DIR  folder that `stillmap map` or `merge` wrote
--report  open the report instead
--print  print the path of the report
--port N = 0  port of the page; 0: a free one
--input FILE  the recording, if it was moved
--no-beams  do not read the recording
"""


def run(args: argparse.Namespace) -> int:
    """Show the result, or open the report.

    Raises:
        InputError: DIR is no result, or a file of it is damaged.
    """
    if not 0 <= args.port <= _LAST_PORT:
        raise InputError(f"--port wants 0 to {_LAST_PORT}, got {args.port}")
    folder = Path(args.result)
    report = _find_report(folder)
    if args.print:
        # a script gets the name itself
        print(printable(str(report)) if is_terminal(sys.stdout) else report)
    elif args.report:
        _open_report(report)
    else:
        try:
            import_extra("viser", args.result, "shown over time", group="viewer")
        except MissingExtra as error:
            say(f"{error}; the report is shown")
            _open_report(report)
            return 0
        _serve(args, folder)
    return 0


def _find_report(folder: Path) -> Path:
    """The report of a result.

    Raises:
        InputError: there is none.
    """
    from stillmap.results.reader import is_place

    hint = "DIR is what `stillmap map` or `merge` wrote"
    if not folder.exists():
        raise InputError("does not exist", where=str(folder), hint=hint)
    report = Path(os.path.abspath(folder)) / _REPORT
    place = report.parent.parent.parent  # of a session, in its folder `sessions`
    if not report.is_file() and report.parent.parent.name == "sessions" and is_place(place):
        hint = f"stillmap view {place} shows all of them"
        raise InputError("is a session of a place", where=str(folder), hint=hint)
    if not report.is_file():
        raise InputError(f"is no result: there is no {_REPORT} in it", where=str(folder), hint=hint)
    return report


def _has_screen() -> bool:
    """True if a graphical browser can open; without a screen it would be a text browser."""
    screens = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    return sys.platform == "darwin" or any(os.environ.get(name) for name in screens)


def _open_browser(address: str) -> bool:
    """Open an address and return whether that succeeded."""
    import webbrowser

    return _has_screen() and webbrowser.open(address)


def _open_report(report: Path) -> None:
    if not _open_browser(report.as_uri()):
        say(f"no browser found; the report is {report}")


def _serve(args: argparse.Namespace, folder: Path) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        InputError: a file of the result is damaged, or the recording that was named is another.
    """
    from stillmap.results.reader import is_place
    from stillmap.results.viewer.scene import Scene
    from stillmap.results.viewer.window import Window

    if is_place(folder):
        if args.input:
            what = "is a place, which has many recordings"
            raise InputError(what, where=str(folder), hint="--input is for single results")
        scene, beams = Scene(folder), None
    else:
        scene, beams = _read_result(args, folder)
    window = Window(scene, beams, args.port)
    try:
        # some browsers block until they are closed
        threading.Thread(target=_open_browser, args=(window.url,), daemon=True).start()
        prefix = "" if _has_screen() else "no browser found; "
        say(f"{prefix}{folder} is at {window.url}, until Ctrl-C")
        while True:
            window.step()
    except KeyboardInterrupt:  # the regular end
        pass
    finally:
        window.close()


def _read_result(args: argparse.Namespace, folder: Path) -> tuple["Scene", "Beams | None"]:
    """The result of one recording; without beams where that cannot be read and is not named."""
    from stillmap.results.folder import open_result
    from stillmap.results.viewer.scene import Beams, Scene

    result = open_result(folder, args.input)
    scene = Scene(folder, result.sources[0].name)
    if args.no_beams:
        return scene, None
    try:
        with show_share(args.quiet, "reading") as progress:
            recording, labels = result.read(progress)
        recording = result.calibrate(recording)
        poses = result.read_poses(recording)
        return scene, Beams(recording, labels.p_static, poses, result.slam_options)
    except InputError as error:
        if args.input:
            raise
        note = f"without beams: {in_flags(error)}"
        say(note)
        scene.notes.insert(0, f"W{note[1:]}")
        return scene, None
