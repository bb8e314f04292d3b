"""`stillmap convert`: write a recording in another format, or a result for other programs."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from stillmap.cli.arguments import (
    add_read_flags,
    make_parents,
    read_changes,
    read_options,
    require_apart,
)
from stillmap.cli.console import say, show_share
from stillmap.core.errors import InputError

if TYPE_CHECKING:
    from stillmap.results.export import point_cloud, point_cloud_files
    from stillmap.results.folder import Exported, ResultFolder

# copies for the help: the modules that define them take long to load
ENDINGS = (
    *(".log", ".clf", ".txt", ".log.gz", ".clf.gz", ".txt.gz"),
    *(".bag", ".db3", ".mcap", ".ply", ".las", ".laz"),
)
CLOUDS = (".las", ".laz", ".e57", ".pcd", ".ply", ".xyz")
NAMES = ("stillmap", "ros2", "carmen", "bag", "db3", "mcap", "kitti", "pcd", "ply", "las")

DESCRIPTION = (
    "Write a recording in another format, by the ending of FILE: "
    f"{', '.join(ENDINGS)}; else a folder. A result of `stillmap map` becomes a bag (.mcap for "
    "Foxglove), in 2D a table of its beams (.parquet), in 3D a point cloud with p_static and "
    f"colours ({', '.join(CLOUDS)}) or the model of the place (.obj)."
)
EPILOG = """examples:
  stillmap convert log.clf.gz -o log.bag      for ROS 1
  stillmap convert log.bag -o log --to ros2   a folder for ROS 2
  stillmap convert log.bag -o part.bag --from 60 --until 120    a minute of it
  stillmap convert out -o out.mcap            a result for Foxglove
  stillmap convert out -o beams.parquet       every beam of a 2D result with its label
  stillmap convert out -o static.laz --only static    static points of a 3D result
  stillmap convert out -o model.obj           model of the place with its textures
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the flags and arguments."""
    p.add_argument(
        "input", metavar="INPUT", help="a recording, or a folder that `stillmap map` wrote"
    )
    p.add_argument("-o", "--output", metavar="FILE", required=True, help="converted file or folder")
    p.add_argument("--to", metavar="FORMAT", choices=NAMES, help=f"the format: {', '.join(NAMES)}")
    p.add_argument(
        "--input", dest="recording", metavar="FILE", help="a result's recording, if it was moved"
    )
    p.add_argument(
        "--only", choices=("static", "dynamic"), help="these points of a cloud (default: all)"
    )
    p.add_argument("--overwrite", action="store_true", help="replace what is there")
    p.add_argument("--quiet", action="store_true", help="no summary")
    add_read_flags(p, end_flags=("--until",))  # --to is the format


_PARQUET = ".parquet"


def run(args: argparse.Namespace) -> int:
    """Read and write; report what the format cannot hold.

    Raises:
        InputError: it cannot be read, or FILE cannot hold it.
    """
    from stillmap.io.registry import detect_format
    from stillmap.results.folder import is_result

    source = Path(args.input)
    if is_result(source):
        convert = _convert_result
    else:
        detect_format(source)  # a missing input is reported before a bad output
        convert = _convert_recording
    with make_parents(Path(args.output)):
        losses, written = convert(args, source, Path(args.output))
    if not args.quiet:
        for loss in losses:
            say(f"warning: {loss}")
        say(f"{written}; in {args.output}")
    return 0


def _convert_recording(
    args: argparse.Namespace, source: Path, output: Path
) -> tuple[list[str], str]:
    """Convert a recording; return what was lost, and what was written."""
    from stillmap.io import read, writers

    if args.recording or args.only:
        flag = "--input" if args.recording else "--only"
        raise InputError(f"{flag} is for results", where=str(source))
    options = read_options(args)
    require_apart(output, source)
    writer = writers.find_writer(output, args.to)
    writers.require_free(output, writer, args.overwrite)
    with show_share(args.quiet, "reading") as progress:
        recording = read(source, options, progress=progress, scratch=output.absolute().parent)
    if not recording.n_scans:
        raise InputError("holds no scan", where=str(source))
    losses = writers.write(recording, output, name=args.to, overwrite=args.overwrite)
    return losses, f"{recording.n_scans} scans, {recording.n_beams} beams as {writer.description}"


def _convert_result(args: argparse.Namespace, source: Path, output: Path) -> tuple[list[str], str]:
    """Convert a result; return what was lost, and what was written."""
    from stillmap.results.export import obj, point_cloud_files
    from stillmap.results.folder import open_result

    if read_changes(args):
        text = "a result's recording is read as it was for the map: no flags for reading it"
        raise InputError(text, where=str(source))
    result = open_result(source, args.recording)
    require_apart(output, result.source, source)
    if (form := point_cloud_files.format_for(output, args.to)) is not None:
        return [], _convert_to_cloud(args, result, output, form)
    if args.only:
        hint = ", ".join(CLOUDS)
        raise InputError("--only is for clouds of points", where=str(output), hint=hint)
    ending = output.suffix.lower() if args.to is None else None
    if ending == obj.ENDING:
        faces, pages = obj.write_obj(source, output, result.texture_quality, args.overwrite)
        return [], f"{faces} faces and {pages} page{'s' * (pages != 1)} of texture"
    if ending == _PARQUET:
        return [], _convert_to_table(args, result, output)
    return _convert_to_bag(args, result, output)


def _convert_to_table(args: argparse.Namespace, result: "ResultFolder", output: Path) -> str:
    from stillmap.core.files import require_new_file
    from stillmap.results.export import parquet

    require_new_file(output, args.overwrite)
    parquet.require_pyarrow()
    exported = _read_result(args, result, output)
    if exported.recording.dimension != 2:
        raise InputError(
            "is of a 3D recording: its points can be written, as a cloud",
            where=str(result.folder),
            hint=", ".join(CLOUDS),
        )
    parquet.write(exported, exported.deskew(), output)
    return f"{exported.recording.n_beams} beams"


def _convert_to_bag(
    args: argparse.Namespace, result: "ResultFolder", output: Path
) -> tuple[list[str], str]:
    from stillmap.io import writers
    from stillmap.io.ros.bag_types import BagKind
    from stillmap.results.export import bag, obj

    hint = f"a bag, .mcap for Foxglove, {_PARQUET}, or in 3D {', '.join(CLOUDS)}, {obj.ENDING}"
    try:
        writer = writers.find_writer(output, args.to)
    except InputError as error:
        raise InputError(error.what, where=str(output), hint=hint) from error
    kind = next((kind for kind in get_args(BagKind) if kind == writer.name), None)
    if kind is None:
        text = f"a result cannot be written as {writer.description}"
        hint += "; `stillmap filter` writes its recording"
        raise InputError(text, where=str(output), hint=hint)
    writers.require_free(output, writer, args.overwrite)
    exported = _read_result(args, result, output)
    with show_share(args.quiet, "writing") as progress:
        losses = bag.write(exported, output, kind, overwrite=args.overwrite, progress=progress)
    scans, objects = exported.recording.n_scans, len(exported.tracks)
    return losses, f"{scans} scans, map, trajectory and {objects} objects"


def _read_result(args: argparse.Namespace, result: "ResultFolder", output: Path) -> "Exported":
    with show_share(args.quiet, "reading") as progress:
        return result.export(progress, output.absolute().parent)


def _convert_to_cloud(
    args: argparse.Namespace, result: "ResultFolder", output: Path, form: "point_cloud_files.Format"
) -> str:
    from stillmap.core.files import require_new_file
    from stillmap.results.export import point_cloud, point_cloud_files
    from stillmap.results.run_json import TILTING

    require_new_file(output, args.overwrite)
    point_cloud_files.require_extras(form, output)
    if isinstance(result.record.get(TILTING), dict):
        points = point_cloud.cloud_from_folder(result.folder, args.only)
    else:
        points = _build_cloud(args, result, output.absolute().parent)
    with show_share(args.quiet, "writing") as progress:
        point_cloud_files.write(points, output, form, progress)
    return f"{points.count} points as {form.description}"


def _build_cloud(
    args: argparse.Namespace, result: "ResultFolder", scratch: Path
) -> "point_cloud.Cloud":
    from stillmap.io.trajectory import poses_from_tum
    from stillmap.results.export import point_cloud
    from stillmap.results.labels import read_colors
    from stillmap.slam import deskew_recording

    with show_share(args.quiet, "reading") as progress:
        recording, labels = result.read(progress, scratch)
    if recording.dimension != 3:
        raise InputError(
            "is a 2D result: it has no point cloud",
            where=str(result.folder),
            hint=f"{_PARQUET} holds the end points of its beams",
        )
    poses = poses_from_tum(result.folder / "trajectory.tum", recording)
    deskewed = deskew_recording(recording, poses, result.slam_options)
    colors = read_colors(result.folder, recording.n_beams)
    return point_cloud.cloud_from_recording(
        recording, deskewed, poses, labels.p_static, args.only, colors
    )
