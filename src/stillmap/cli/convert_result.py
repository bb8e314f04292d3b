"""Results for other programs: bags, tables, point clouds, models, maps and masks for nav2."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from stillmap.cli.arguments import flag_changes, require_apart
from stillmap.cli.console import show_share
from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import workplace

if TYPE_CHECKING:
    from stillmap.results import point_cloud
    from stillmap.results.export import nav2, point_cloud_files
    from stillmap.results.folder import ResultFolder
    from stillmap.results.mapped_place import MappedPlace

# a copy for the help: the module that defines them takes long to load
CLOUDS = (".las", ".laz", ".e57", ".pcd", ".ply", ".xyz")
NAV2 = "nav2"  # the format of maps and masks
_PARQUET = ".parquet"


ZONE_FLAGS = """
maps and masks of a result for nav2, in a folder (docs/tutorials/2d-bag-to-nav2.md):
--mask FILE.geojson  polygons in metres in the map frame, each with an action: erase, block,
  keepout, or speed
--keepout-crossings N  keep out of the squares of the floor that were crossed N times or more
--slow-crossings N  limit the speed in the squares that were crossed N times or more
--slow-to LIMIT  to LIMIT in m/s, or in per cent of the robot's maximum (default: 50%%)
"""


def given_zone_flags(args: argparse.Namespace) -> dict[str, object]:
    """The flags for maps and masks that were given, with their values."""
    names = ("mask", "keepout_crossings", "slow_crossings", "slow_to")
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    return {f"--{name.replace('_', '-')}": value for name, value in given.items()}


def convert_result(args: argparse.Namespace, source: Path, output: Path) -> tuple[list[str], str]:
    """Write a result for other programs; return what was lost, and what was written."""
    from stillmap.results.export import point_cloud_files
    from stillmap.results.folder import ResultFolder, open_result
    from stillmap.results.reader import is_place, read_run

    if flag_changes(args):
        text = "a result's recording is read as it was for the map: no flags for reading it"
        raise InputError(text, where=str(source))
    is_whole = is_place(source)  # what a place has as a whole needs none of its recordings
    if is_whole:
        result = ResultFolder(source, read_run(source))
    else:
        result = open_result(source, args.recording)
    for path in result.sources or (source,):
        require_apart(output, path, source)
    if args.to == NAV2 or given_zone_flags(args):
        return _convert_to_nav2(args, result, output)
    form = point_cloud_files.format_for(output, args.to)
    if form is not None and (result.dimension == 3 or not is_whole):
        return [], _convert_to_cloud(args, result, output, form)
    if is_whole:
        raise _only_for_sessions(result)
    if args.only:
        hint = ", ".join(CLOUDS)
        raise InputError("--only is for clouds of points", where=str(output), hint=hint)
    if args.to is None and output.suffix.lower() == _PARQUET:
        return [], _convert_to_table(args, result, output)
    return _convert_to_bag(args, result, output)


def _only_for_sessions(place: "ResultFolder") -> InputError:
    what = f"is a place of several recordings: it becomes maps and masks (--to {NAV2})"
    if place.dimension == 3:
        what += f" or a cloud ({', '.join(CLOUDS)})"
    hint = f"session by session: stillmap convert {place.folder}/sessions/NAME -o FILE"
    return InputError(what, where=str(place.folder), hint=hint)


def _convert_to_nav2(
    args: argparse.Namespace, result: "ResultFolder", output: Path
) -> tuple[list[str], str]:
    from stillmap.core.files import require_new
    from stillmap.results.export import nav2, zones
    from stillmap.results.reader import read_crossings, read_grid

    if args.to != NAV2 and (args.to or output.suffix):
        flag = next(iter(given_zone_flags(args)))
        hint = f"FILE is a folder; if it shall be called so, give --to {NAV2}"
        raise InputError(f"{flag} is for maps and masks of nav2", where=str(output), hint=hint)
    require_new(output, nav2.PARAMETERS, args.overwrite)
    rule = _traffic_rule(args)
    drawn = zones.read_zones(Path(args.mask)) if args.mask is not None else []
    is_traffic = rule.keepout is not None or rule.slow is not None
    crossings = read_crossings(result.folder) if is_traffic else None
    maps = nav2.make_maps(read_grid(result.folder), drawn, rule, crossings)
    nav2.write(maps, output, result.output_options.map_mode, overwrite=args.overwrite)
    written = ["map"]
    if maps.keepout is not None:
        written.append(f"keep-out zones of {maps.keepout_area:.1f} m2")
    if maps.speed is not None:
        written.append(f"speed limits on {maps.slow_area:.1f} m2")
    return maps.warnings, ", ".join(written)


def _traffic_rule(args: argparse.Namespace) -> "nav2.TrafficRule":
    from stillmap.results.export import nav2, zones

    for flag, value in given_zone_flags(args).items():
        if isinstance(value, int) and value < 1:
            raise InputError(f"{flag} is a number of crossings, from 1 on, not {value}")
    if args.slow_to is not None and args.slow_crossings is None:
        raise InputError("--slow-to needs --slow-crossings")
    limit = zones.parse_speed_limit("50%" if args.slow_to is None else args.slow_to, "--slow-to")
    return nav2.TrafficRule(args.keepout_crossings, args.slow_crossings, limit)


def _convert_to_table(args: argparse.Namespace, result: "ResultFolder", output: Path) -> str:
    from stillmap.core.files import require_new_file
    from stillmap.results.tables import write_parquet

    require_new_file(output, args.overwrite)
    import_extra("pyarrow.parquet", output, "written")
    exported = _read_result(args, result, output)
    if exported.recording.dimension != 2:
        raise InputError(
            "is of a 3D recording: no table",
            where=str(result.folder),
            hint=f"its points as a cloud ({', '.join(CLOUDS)}), all of it as a bag (.mcap, .bag)",
        )
    write_parquet(exported, output)
    return f"{exported.recording.n_beams} beams"


def _convert_to_bag(
    args: argparse.Namespace, result: "ResultFolder", output: Path
) -> tuple[list[str], str]:
    from stillmap.io import writers
    from stillmap.io.ros.messages import BagKind
    from stillmap.results.export import bag

    hint = f"a bag, .mcap for Foxglove, {_PARQUET}, or in 3D {', '.join(CLOUDS)}"
    try:
        writer = writers.find_writer(output, args.to)
    except InputError as error:
        raise InputError(error.what, where=str(output), hint=hint) from error
    kind = next((kind for kind in get_args(BagKind) if kind == writer.name), None)
    if kind is None:
        text = f"a result cannot be written as {writer.description}"
        hint += "; `stillmap filter` writes its recording"
        raise InputError(text, where=str(output), hint=hint)
    writers.require_free(output, writer.marker, args.overwrite)
    exported = _read_result(args, result, output)
    with show_share(args.quiet, "writing") as progress:
        losses = bag.write(exported, output, kind, overwrite=args.overwrite, progress=progress)
    scans, objects = exported.recording.n_scans, len(exported.objects)
    return losses, f"{scans} scans, map, trajectory and {objects} objects"


def _read_result(args: argparse.Namespace, result: "ResultFolder", output: Path) -> "MappedPlace":
    from stillmap.results.mapped_place import MappedPlace

    with show_share(args.quiet, "reading") as progress:
        recording, _ = result.read(progress, workplace(output))
    exported = MappedPlace.open(result.folder)
    exported.recording = result.calibrate(recording)
    return exported


def _convert_to_cloud(
    args: argparse.Namespace, result: "ResultFolder", output: Path, form: "point_cloud_files.Format"
) -> str:
    from stillmap.core.files import require_new_file
    from stillmap.results import point_cloud
    from stillmap.results.export import point_cloud_files
    from stillmap.results.reader import EXTENDS, TILTING, is_place

    require_new_file(output, args.overwrite)
    point_cloud_files.require_extras(form, output)
    is_whole = isinstance(result.record.get(TILTING), dict) or is_place(result.folder)
    if is_whole or result.record["input"].get(EXTENDS) is True:  # no recording has all of it
        points = point_cloud.cloud_from_folder(result.folder, args.only)
    else:
        points = _build_cloud(args, result, workplace(output))
    with show_share(args.quiet, "writing") as progress:
        point_cloud_files.write(points, output, form, progress)
    return f"{points.count} points as {form.description}"


def _build_cloud(
    args: argparse.Namespace, result: "ResultFolder", scratch: Path
) -> "point_cloud.Cloud":
    from stillmap.core.grid_map import limit_hits
    from stillmap.results import point_cloud
    from stillmap.results.reader import read_colors
    from stillmap.slam import deskew_recording

    with show_share(args.quiet, "reading") as progress:
        recording, labels = result.read(progress, scratch)
    if recording.dimension != 3:
        raise InputError(
            "is a 2D result: it has no point cloud",
            where=str(result.folder),
            hint=f"{_PARQUET} holds the end points of its beams",
        )
    poses = result.read_poses(recording)
    deskewed = deskew_recording(recording, poses, result.slam_options)
    colors = read_colors(result.folder, recording.n_beams)
    deskewed = limit_hits(deskewed, poses, result.output_options.region)
    return point_cloud.cloud_from_recording(
        recording,
        deskewed,
        poses,
        labels.p_static,
        args.only,
        colors,
        result.read_frame().origin,
    )
