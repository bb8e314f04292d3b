"""What `stillmap view` does once it is known what is wanted: a page that shows a result."""

import argparse
from dataclasses import replace
from pathlib import Path

from stillmap.cli.browser import opened_beside
from stillmap.cli.progress import say, shown_share
from stillmap.cli.results import Mapped, found, is_deskewed
from stillmap.errors import InputError
from stillmap.recording.poses import poses_from_tum
from stillmap.slam import SlamOptions
from stillmap.viewer.beams import Beams
from stillmap.viewer.scene import read_scene
from stillmap.viewer.window import Window


def viewed(args: argparse.Namespace, folder: Path) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        InputError: a file of the result is damaged, or the recording that was named is another.
    """
    mapped = found(folder, args.input)
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


def _beams(mapped: Mapped, quiet: bool) -> Beams:
    with shown_share(quiet, "reading") as tell:
        recording, labels = mapped.read(tell)
    poses = poses_from_tum(mapped.folder / "trajectory.tum", recording)
    slam = SlamOptions(deskew=is_deskewed(mapped.record))
    return Beams(recording, labels.p_static, poses, slam)
