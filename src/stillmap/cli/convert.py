"""Write a recording in another format, by the ending of FILE: .log, .clf, .txt, .log.gz, .clf.gz,
.txt.gz, .bag, .db3, .mcap, .ply, .las, .laz; else a folder. A result of `stillmap map` becomes a
bag (.mcap for Foxglove), in 2D a table of its beams (.parquet), in 3D a point cloud with
p_static and colours (.las, .laz, .e57, .pcd, .ply, .xyz), or maps and masks for nav2. A place
becomes maps and masks, in 3D also a cloud; its sessions, PLACE/sessions/NAME, all of this.

examples:
  stillmap convert log.clf.gz -o log.bag      for ROS 1
  stillmap convert log.bag -o log --to ros2   a folder for ROS 2
  stillmap convert log.bag -o part.bag --from 60 --until 120    a minute of it
  stillmap convert out -o out.mcap            a result for Foxglove
  stillmap convert out -o beams.parquet       every beam of a 2D result with its label
  stillmap convert out -o static.laz --only static    static points of a 3D result
  stillmap convert out -o maps --mask zones.geojson   edited map and masks for nav2
"""

import argparse
from pathlib import Path

from stillmap.cli.arguments import OVERWRITE, READ, make_parents, read_options, require_apart
from stillmap.cli.console import say, show_share
from stillmap.core.errors import InputError
from stillmap.core.files import workplace

# a copy for the help: the modules that define them take long to load
NAMES = ("stillmap", "ros2", "carmen", "bag", "db3", "mcap", "kitti", "pcd", "ply", "las")


FLAGS = f"""
source INPUT  a recording, or a folder that `stillmap map` or `merge` wrote
-o --output FILE!  converted file or folder
--to {{{",".join(NAMES)},nav2}}  the format
--input FILE  a result's recording, if it was moved
--only {{static,dynamic}}  these points of a cloud (default: all)
{OVERWRITE}
maps and masks of a result for nav2, in a folder (docs/tutorials/2d-bag-to-nav2.md):
--mask FILE.geojson  polygons in metres in the map frame, each with an action: erase, block,
  keepout, or speed
--keepout-crossings N  keep out of the squares of the floor that were crossed N times or more
--slow-crossings N  limit the speed in the squares that were crossed N times or more
--slow-to LIMIT  to LIMIT in m/s, or in per cent of the robot's maximum (default: 50%%)
{READ.replace("--to ", "")}"""


def run(args: argparse.Namespace) -> int:
    """Read and write; report what the format cannot hold.

    Raises:
        InputError: it cannot be read, or FILE cannot hold it.
    """
    from stillmap.io.registry import detect_format
    from stillmap.results.reader import is_result

    source = Path(args.source)
    if is_result(source):
        from stillmap.cli.convert_result import convert_result  # takes long to load

        convert = convert_result
    else:
        detect_format(source)  # a missing input is reported before a bad output
        convert = _convert_recording
    with make_parents(Path(args.output)):
        losses, written = convert(args, source, Path(args.output))
    if not args.quiet:
        for loss in losses:
            say(f"warning: {loss}")
        say(f"wrote {args.output}: {written}")
    return 0


def _convert_recording(
    args: argparse.Namespace, source: Path, output: Path
) -> tuple[list[str], str]:
    """Convert a recording; return what was lost, and what was written."""
    from stillmap.io import read, writers

    names = "input", "only", "mask", "keepout_crossings", "slow_crossings", "slow_to"
    given = {f"--{name.replace('_', '-')}": getattr(args, name) for name in names}
    for flag, value in {**given, "--to nav2": True if args.to == "nav2" else None}.items():
        if value is not None:
            raise InputError(f"{flag} is for results", where=str(source))
    options = read_options(args)
    require_apart(output, source)
    writer = writers.find_writer(output, args.to)
    writers.require_free(output, writer.marker, args.overwrite)
    with show_share(args.quiet, "reading") as progress:
        recording = read(source, options, progress=progress, scratch=workplace(output))
    if not recording.n_scans:
        raise InputError("holds no scan", where=str(source))
    losses = writers.write(recording, output, name=args.to, overwrite=args.overwrite)
    return losses, f"{recording.n_scans} scans, {recording.n_beams} beams as {writer.description}"
