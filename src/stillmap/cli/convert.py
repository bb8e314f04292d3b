"""`stillmap convert`: a recording in another format, a result for other programs.

Imports that take long are made inside the functions, so that `--help` and completion are quick.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from stillmap.cli.arguments import add_read_flags, make_parents, read_changes, require_apart
from stillmap.cli.console import say, show_share
from stillmap.cli.parser import COMMANDS
from stillmap.core.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stillmap.core.recording import Recording
    from stillmap.results import reader
    from stillmap.results.export import point_cloud, point_cloud_files
    from stillmap.results.folder import ResultFolder

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
    lost, what = converted(args)
    if not args.quiet:
        for sentence in lost:
            say(f"warning: {sentence}")
        say(f"{what}; in {args.output}")
    return 0


_PARQUET = ".parquet"


def converted(args: argparse.Namespace) -> tuple[list[str], str]:
    """What could not be written, a sentence each, and what was.

    Raises:
        InputError: it cannot be read, or the output cannot hold it.
    """
    from stillmap.io.registry import detect_format
    from stillmap.results.folder import is_result

    source, output = Path(args.input), Path(args.output)
    if is_result(source):
        with make_parents(output):
            return _convert_result(args, source, output)
    detect_format(source)  # what is not there is told before what cannot be written
    with make_parents(output):
        return _convert_recording(args, source, output)


def _convert_recording(
    args: argparse.Namespace, source: Path, output: Path
) -> tuple[list[str], str]:
    from stillmap.core import config
    from stillmap.io import read, writers
    from stillmap.preprocessing.options import ReadOptions

    if args.recording or args.only:
        flag = "--input" if args.recording else "--only"
        raise InputError(f"{flag} is for results", where=str(source))
    read_options = config.override(ReadOptions(), read_changes(args).get("read", {}))
    require_apart(output, source)
    writer = writers.find_writer(output, args.to)
    writers.require_free(output, writer, args.overwrite)
    with show_share(args.quiet, "reading") as tell:
        recording = read(source, read_options, progress=tell, scratch=output.absolute().parent)
    if not recording.n_scans:
        raise InputError("holds no scan", where=str(source))
    lost = writers.write(recording, output, name=args.to, overwrite=args.overwrite)
    return lost, f"{recording.n_scans} scans, {recording.n_beams} beams as {writer.description}"


def _convert_result(args: argparse.Namespace, folder: Path, output: Path) -> tuple[list[str], str]:
    from stillmap.core.files import require_new_file
    from stillmap.io import writers
    from stillmap.io.ros.bag_types import BagKind
    from stillmap.results.export import bag, obj, parquet, point_cloud_files
    from stillmap.results.folder import open_result

    if read_changes(args):
        text = "a result's recording is read as it was when it was mapped: no flags for reading it"
        raise InputError(text, where=str(folder))
    mapped = open_result(folder, args.recording)
    require_apart(output, mapped.source, folder)
    if (form := point_cloud_files.format_for(output, args.to)) is not None:
        return [], _convert_to_cloud(args, mapped, output, form)
    if args.only:
        raise InputError("--only is for clouds of points", where=str(output), hint=_clouds())
    if output.suffix.lower() == obj.ENDING and args.to is None:
        return [], _convert_to_obj(args, mapped, output)
    if output.suffix.lower() == _PARQUET and args.to is None:
        require_new_file(output, args.overwrite)
        parquet.require_pyarrow()
        exported = _exported(mapped)
        seen = _seen(mapped, exported.recording, exported.poses)
        parquet.write(exported, seen, output)
        return [], f"{exported.recording.n_beams} beams"
    hint = f"a bag, .mcap for Foxglove, {_PARQUET}, or in 3D {_clouds()}, {obj.ENDING}"
    try:
        writer = writers.find_writer(output, args.to)
    except InputError as error:
        raise InputError(error.what, where=str(output), hint=hint) from error
    kind = next((kind for kind in get_args(BagKind) if kind == writer.name), None)
    if kind is None:
        text = f"a result cannot be written as {writer.description}"
        more = "; recordings come of `stillmap filter`"
        raise InputError(text, where=str(output), hint=hint + more)
    writers.require_free(output, writer, args.overwrite)
    exported = _exported(mapped)
    lost = bag.write(exported, output, kind, overwrite=args.overwrite)
    return lost, f"{exported.recording.n_scans} scans, map, way and {len(exported.tracks)} objects"


def _convert_to_obj(args: argparse.Namespace, mapped: "ResultFolder", output: Path) -> str:
    from stillmap.results.export import obj

    faces, pages = obj.write_obj(mapped.folder, output, mapped.texture_quality, args.overwrite)
    return f"{faces} faces and {pages} page{'s' * (pages != 1)} of texture"


def _clouds() -> str:
    from stillmap.results.export import point_cloud_files

    return ", ".join(end for form in point_cloud_files.FORMATS for end in form.endings)


def _convert_to_cloud(
    args: argparse.Namespace, mapped: "ResultFolder", output: Path, form: "point_cloud_files.Format"
) -> str:
    from stillmap.core.files import require_new_file
    from stillmap.results.export import point_cloud, point_cloud_files
    from stillmap.results.rig import FOLDER as TILTING

    require_new_file(output, args.overwrite)
    point_cloud_files.require_extras(form, output)
    if isinstance(mapped.record.get(TILTING), dict):
        points = point_cloud.cloud_from_folder(mapped.folder, args.only)
    else:
        points = _cloud_of(args, mapped, output)
    with show_share(args.quiet, "writing") as tell:
        point_cloud_files.write(points, output, form, tell)
    return f"{points.count} points as {form.description}"


def _cloud_of(
    args: argparse.Namespace, mapped: "ResultFolder", output: Path
) -> "point_cloud.Cloud":
    from stillmap.io.trajectory import poses_from_tum
    from stillmap.results.export import point_cloud
    from stillmap.results.labels import read_colors

    with show_share(args.quiet, "reading") as tell:
        recording, labels = mapped.read(tell, output.absolute().parent)
    if recording.dimension != 3:
        raise InputError(
            "is of a recording in the plane: it has no cloud of points",
            where=str(mapped.folder),
            hint=f"{_PARQUET} has where its beams ended",
        )
    poses = poses_from_tum(mapped.folder / "trajectory.tum", recording)
    seen = _seen(mapped, recording, poses)
    colours = read_colors(mapped.folder, recording.n_beams)
    return point_cloud.cloud_from_recording(
        recording, seen, poses, labels.p_static, args.only, colours
    )


def _exported(mapped: "ResultFolder") -> "reader.Exported":
    from stillmap.results import reader

    recording, labels = mapped.read()
    return reader.read(mapped.folder, recording, labels.p_static)


def _seen(
    mapped: "ResultFolder", recording: "Recording", poses: "NDArray[np.float64]"
) -> "Recording":
    """The recording without the motion during its scans, as it was mapped."""
    from stillmap import slam
    from stillmap.results.folder import is_deskewed

    how = slam.SlamOptions(deskew=is_deskewed(mapped.record))
    return slam.deskew_recording(recording, poses, how)
