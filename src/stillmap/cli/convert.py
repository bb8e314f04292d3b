"""`stillmap convert`: write a recording in another format, or a result for other programs."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

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

# copies for the help: the modules that define them take long to load
ENDINGS = (
    *(".log", ".clf", ".txt", ".log.gz", ".clf.gz", ".txt.gz"),
    *(".bag", ".db3", ".mcap", ".ply", ".las", ".laz"),
)
CLOUDS = (".las", ".laz", ".e57", ".pcd", ".ply", ".xyz")
NAMES = ("stillmap", "ros2", "carmen", "bag", "db3", "mcap", "kitti", "pcd", "ply", "las")

_EPILOG = """examples:
  stillmap convert log.clf.gz -o log.bag      for ROS 1
  stillmap convert log.bag -o log --to ros2   a folder for ROS 2
  stillmap convert out -o out.mcap            a 2D result for Foxglove
  stillmap convert out -o beams.parquet       every beam of a 2D result with its label
  stillmap convert out -o static.laz --only static    static points of a 3D result
  stillmap convert out -o model.obj           model of the place with its textures
"""


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    p = commands.add_parser(
        "convert",
        help=COMMANDS["convert"],
        description="Write a recording in another format, by the ending of FILE: "
        f"{', '.join(ENDINGS)}; else a folder. A 2D result of `stillmap map` becomes a bag (.mcap "
        "for Foxglove) or a table of its beams (.parquet), a 3D one a point cloud with p_static "
        f"and colours ({', '.join(CLOUDS)}) or the model of the place (.obj).",
        epilog=_EPILOG,
    )
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
    add_read_flags(p)
    p.set_defaults(run=run)


_PARQUET = ".parquet"


class _Request(NamedTuple):
    """Parsed arguments.

    Attributes:
        input: recording or result.
        output: converted file or folder.
        to: name of the format; None: by the ending of the output.
        recording: path of a result's recording; None: where the result says.
        only: the points of a cloud to write; None: all.
        overwrite: replace what is there.
        quiet: no progress.
    """

    input: Path
    output: Path
    to: str | None
    recording: str | None
    only: Literal["static", "dynamic"] | None
    overwrite: bool
    quiet: bool


def run(args: argparse.Namespace) -> int:
    """Read and write; report what the format cannot hold.

    Raises:
        InputError: it cannot be read, or FILE cannot hold it.
    """
    from stillmap.io.registry import detect_format
    from stillmap.results.folder import is_result

    request = _Request(
        input=Path(args.input),
        output=Path(args.output),
        to=args.to,
        recording=args.recording,
        only=args.only,
        overwrite=args.overwrite,
        quiet=args.quiet,
    )
    if is_result(request.input):
        convert = _convert_result
    else:
        detect_format(request.input)  # a missing input is reported before a bad output
        convert = _convert_recording
    with make_parents(request.output):
        losses, written = convert(request, read_changes(args).get("read", {}))
    if not request.quiet:
        for loss in losses:
            say(f"warning: {loss}")
        say(f"{written}; in {args.output}")
    return 0


def _convert_recording(request: _Request, read_changes: dict[str, Any]) -> tuple[list[str], str]:
    """Convert a recording; return what was lost, and what was written."""
    from stillmap.core import config
    from stillmap.io import read, writers
    from stillmap.preprocessing.options import ReadOptions

    source, output = request.input, request.output
    if request.recording or request.only:
        flag = "--input" if request.recording else "--only"
        raise InputError(f"{flag} is for results", where=str(source))
    read_options = config.override(ReadOptions(), read_changes)
    require_apart(output, source)
    writer = writers.find_writer(output, request.to)
    writers.require_free(output, writer, request.overwrite)
    with show_share(request.quiet, "reading") as progress:
        recording = read(source, read_options, progress=progress, scratch=output.absolute().parent)
    if not recording.n_scans:
        raise InputError("holds no scan", where=str(source))
    losses = writers.write(recording, output, name=request.to, overwrite=request.overwrite)
    return losses, f"{recording.n_scans} scans, {recording.n_beams} beams as {writer.description}"


def _convert_result(request: _Request, read_changes: dict[str, Any]) -> tuple[list[str], str]:
    """Convert a result; return what was lost, and what was written."""
    from stillmap.results.export import obj, point_cloud_files
    from stillmap.results.folder import open_result

    folder, output = request.input, request.output
    if read_changes:
        text = "a result's recording is read as it was for the map: no flags for reading it"
        raise InputError(text, where=str(folder))
    result = open_result(folder, request.recording)
    require_apart(output, result.source, folder)
    if (form := point_cloud_files.format_for(output, request.to)) is not None:
        return [], _convert_to_cloud(request, result, form)
    if request.only:
        endings = _list_cloud_endings()
        raise InputError("--only is for clouds of points", where=str(output), hint=endings)
    ending = output.suffix.lower() if request.to is None else None
    if ending == obj.ENDING:
        return [], _convert_to_obj(request, result)
    if ending == _PARQUET:
        return [], _convert_to_table(request, result)
    return _convert_to_bag(request, result)


def _convert_to_obj(request: _Request, result: "ResultFolder") -> str:
    from stillmap.results.export import obj

    faces, pages = obj.write_obj(
        result.folder, request.output, result.texture_quality, request.overwrite
    )
    return f"{faces} faces and {pages} page{'s' * (pages != 1)} of texture"


def _convert_to_table(request: _Request, result: "ResultFolder") -> str:
    from stillmap.core.files import require_new_file
    from stillmap.results.export import parquet

    require_new_file(request.output, request.overwrite)
    parquet.require_pyarrow()
    exported = _read_result(result)
    deskewed = _deskew(result, exported.recording, exported.poses)
    parquet.write(exported, deskewed, request.output)
    return f"{exported.recording.n_beams} beams"


def _convert_to_bag(request: _Request, result: "ResultFolder") -> tuple[list[str], str]:
    from stillmap.io import writers
    from stillmap.io.ros.bag_types import BagKind
    from stillmap.results.export import bag, obj

    output = request.output
    hint = f"a bag, .mcap for Foxglove, {_PARQUET}, or in 3D {_list_cloud_endings()}, {obj.ENDING}"
    try:
        writer = writers.find_writer(output, request.to)
    except InputError as error:
        raise InputError(error.what, where=str(output), hint=hint) from error
    kind = next((kind for kind in get_args(BagKind) if kind == writer.name), None)
    if kind is None:
        text = f"a result cannot be written as {writer.description}"
        hint += "; `stillmap filter` writes its recording"
        raise InputError(text, where=str(output), hint=hint)
    writers.require_free(output, writer, request.overwrite)
    exported = _read_result(result)
    losses = bag.write(exported, output, kind, overwrite=request.overwrite)
    scans, objects = exported.recording.n_scans, len(exported.tracks)
    return losses, f"{scans} scans, map, trajectory and {objects} objects"


def _list_cloud_endings() -> str:
    return ", ".join(CLOUDS)


def _convert_to_cloud(
    request: _Request, result: "ResultFolder", form: "point_cloud_files.Format"
) -> str:
    from stillmap.core.files import require_new_file
    from stillmap.results.export import point_cloud, point_cloud_files
    from stillmap.results.rig import FOLDER as TILTING

    require_new_file(request.output, request.overwrite)
    point_cloud_files.require_extras(form, request.output)
    if isinstance(result.record.get(TILTING), dict):
        points = point_cloud.cloud_from_folder(result.folder, request.only)
    else:
        points = _build_cloud(request, result)
    with show_share(request.quiet, "writing") as progress:
        point_cloud_files.write(points, request.output, form, progress)
    return f"{points.count} points as {form.description}"


def _build_cloud(request: _Request, result: "ResultFolder") -> "point_cloud.Cloud":
    from stillmap.io.trajectory import poses_from_tum
    from stillmap.results.export import point_cloud
    from stillmap.results.labels import read_colors

    with show_share(request.quiet, "reading") as progress:
        recording, labels = result.read(progress, request.output.absolute().parent)
    if recording.dimension != 3:
        raise InputError(
            "is a 2D result: it has no point cloud",
            where=str(result.folder),
            hint=f"{_PARQUET} holds the end points of its beams",
        )
    poses = poses_from_tum(result.folder / "trajectory.tum", recording)
    deskewed = _deskew(result, recording, poses)
    colors = read_colors(result.folder, recording.n_beams)
    return point_cloud.cloud_from_recording(
        recording, deskewed, poses, labels.p_static, request.only, colors
    )


def _read_result(result: "ResultFolder") -> "reader.Exported":
    from stillmap.results import reader

    recording, labels = result.read()
    return reader.read(result.folder, recording, labels.p_static)


def _deskew(
    result: "ResultFolder", recording: "Recording", poses: "NDArray[np.float64]"
) -> "Recording":
    """Deskew the recording if it was deskewed for the map."""
    from stillmap import slam
    from stillmap.results.folder import is_deskewed

    options = slam.SlamOptions(deskew=is_deskewed(result.record))
    return slam.deskew_recording(recording, poses, options)
