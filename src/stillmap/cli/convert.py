"""`stillmap convert`: a recording in another format, a result in the forms of other programs."""

import argparse

from stillmap.cli.commands import COMMANDS
from stillmap.cli.progress import say
from stillmap.cli.reading import add_read_flags

# stillmap.recording.writers has them too, and takes long to load
ENDINGS = (
    *(".log", ".clf", ".txt", ".log.gz", ".clf.gz", ".txt.gz"),
    *(".bag", ".db3", ".mcap", ".ply", ".las", ".laz"),
)
# likewise of stillmap.export.cloud_files
CLOUDS = (".las", ".laz", ".e57", ".pcd", ".ply", ".xyz")
NAMES = ("stillmap", "ros2", "carmen", "bag", "db3", "mcap", "kitti", "pcd", "ply", "las")
_EPILOG = """examples:
  stillmap convert log.clf.gz -o log.bag      for ROS 1
  stillmap convert log.bag -o log --to ros2   a folder for ROS 2
  stillmap convert out -o out.mcap            a result in 2D, to look at in Foxglove
  stillmap convert out -o beams.parquet       likewise, every beam with its label
  stillmap convert out -o static.laz --only static    points of a result in 3D
  stillmap convert out -o model.obj           its model of the place, pages of texture beside it
"""


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    p = commands.add_parser(
        "convert",
        help=COMMANDS["convert"],
        description="Write a recording in another format, which the ending of FILE names: "
        f"{', '.join(ENDINGS)}; a folder otherwise. A result of `stillmap map` in 2D becomes a bag "
        "that shows it (.mcap for Foxglove) or a table of its beams (.parquet); in 3D a cloud of "
        f"points with p_static and colours ({', '.join(CLOUDS)}), or the model of the place "
        "(.obj).",
        epilog=_EPILOG,
    )
    p.add_argument("input", metavar="INPUT", help="a recording, or what `stillmap map` wrote")
    p.add_argument("-o", "--output", metavar="FILE", required=True, help="where it goes")
    p.add_argument("--to", metavar="FORMAT", choices=NAMES, help=f"the format: {', '.join(NAMES)}")
    p.add_argument(
        "--input", dest="recording", metavar="FILE", help="a result's recording, if it was moved"
    )
    p.add_argument(
        "--only", choices=("static", "dynamic"), help="of a cloud: these points (default: all)"
    )
    p.add_argument("--overwrite", action="store_true", help="replace what is there")
    p.add_argument("--quiet", action="store_true", help="no summary")
    add_read_flags(p)
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Reads and writes; says what could not be written.

    Raises:
        InputError: it cannot be read, or FILE cannot hold it.
    """
    from stillmap.cli.converting import converted  # takes long to load

    lost, what = converted(args)
    if not args.quiet:
        for sentence in lost:
            say(f"warning: {sentence}")
        say(f"{what}; in {args.output}")
    return 0
