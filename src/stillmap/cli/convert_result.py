"""Results for other programs: bags, tables, point clouds, maps and masks for nav2."""

import argparse
from pathlib import Path
from typing import get_args

from stillmap.cli.arguments import flag_changes, require_apart
from stillmap.cli.console import show_share
from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import require_new_file, workplace
from stillmap.core.grid_map import limit_hits
from stillmap.io import writers
from stillmap.io.ros.messages import BagKind
from stillmap.results import point_cloud, reader, tables
from stillmap.results.export import bag, nav2, point_cloud_files, zones
from stillmap.results.folder import ResultFolder, open_result
from stillmap.results.mapped_place import MappedPlace
from stillmap.slam import deskew_recording

NAV2 = "nav2"  # the format of maps and masks
_PARQUET = ".parquet"
_CLOUDS = ", ".join(ending for form in point_cloud_files.FORMATS for ending in form.endings)


def _given_zone_flags(args: argparse.Namespace) -> dict[str, object]:
    """The flags for maps and masks that were given, with their values."""
    flags = ("--mask", "--keepout-crossings", "--slow-crossings", "--slow-to")
    values = {flag: getattr(args, flag[2:].replace("-", "_")) for flag in flags}
    return {flag: value for flag, value in values.items() if value is not None}


def convert_result(args: argparse.Namespace, source: Path, output: Path) -> tuple[list[str], str]:
    """Write a result for other programs; return what was lost, and what was written."""
    if flag_changes(args):
        text = "a result's recording is read as it was for the map: no flags for reading it"
        raise InputError(text, where=str(source))
    is_whole = reader.is_place(source)  # what a place has as a whole needs none of its recordings
    place = ResultFolder(source, reader.read_run(source)) if is_whole else None
    result = place or open_result(source, args.input)
    for path in result.sources or (source,):
        require_apart(output, path, source)
    if args.to == NAV2 or _given_zone_flags(args):
        return _convert_to_nav2(args, result, output)
    form = point_cloud_files.format_for(output, args.to)
    if form is not None and (result.dimension == 3 or not is_whole):
        return [], _convert_to_cloud(args, result, output, form)
    if is_whole:
        what = f"is a place of several recordings: it becomes maps and masks (--to {NAV2})"
        what += f" or a cloud ({_CLOUDS})" if result.dimension == 3 else ""
        hint = f"session by session: stillmap convert {source}/sessions/NAME -o FILE"
        raise InputError(what, where=str(source), hint=hint)
    if args.only:
        raise InputError("--only is for clouds of points", where=str(output), hint=_CLOUDS)
    if args.to is None and output.suffix.lower() == _PARQUET:
        return [], _convert_to_table(args, result, output)
    return _convert_to_bag(args, result, output)


def _convert_to_nav2(
    args: argparse.Namespace, result: ResultFolder, output: Path
) -> tuple[list[str], str]:
    if args.to != NAV2 and (args.to or output.suffix):
        flag = next(iter(_given_zone_flags(args)))
        hint = f"FILE is a folder; if it shall be called so, give --to {NAV2}"
        raise InputError(f"{flag} is for maps and masks of nav2", where=str(output), hint=hint)
    traffic = _traffic_zones(args)
    drawn = zones.read_zones(Path(args.mask)) if args.mask is not None else []
    crossings = reader.read_crossings(result.folder) if traffic else None
    maps = nav2.Maps(reader.read_grid(result.folder), traffic, crossings, drawn)
    nav2.write(maps, output, result.output_options.map_mode, overwrite=args.overwrite)
    written = ["map"]
    if maps.keepout is not None:
        written.append(f"keep-out zones of {maps.area(maps.keepout):.1f} m2")
    if maps.speed is not None:
        written.append(f"speed limits on {maps.area(maps.speed):.1f} m2")
    return maps.warnings, ", ".join(written)


def _traffic_zones(args: argparse.Namespace) -> list[nav2.TrafficZone]:
    for flag, value in _given_zone_flags(args).items():
        if isinstance(value, int) and value < 1:
            raise InputError(f"{flag} is a number of crossings, from 1 on, not {value}")
    if args.slow_to is not None and args.slow_crossings is None:
        raise InputError("--slow-to needs --slow-crossings")
    limit = zones.parse_speed_limit("50%" if args.slow_to is None else args.slow_to, "--slow-to")
    wanted = (
        (args.keepout_crossings, zones.Zone("traffic", "keepout", None, [])),
        (args.slow_crossings, zones.Zone("traffic", "speed", limit, [])),
    )
    return [nav2.TrafficZone(least, zone) for least, zone in wanted if least is not None]


def _convert_to_table(args: argparse.Namespace, result: ResultFolder, output: Path) -> str:
    require_new_file(output, args.overwrite)
    import_extra("pyarrow.parquet", output, "written")
    exported = _read_result(args, result, output)
    if exported.recording.dimension != 2:
        hint = f"its points as a cloud ({_CLOUDS}), all of it as a bag (.mcap, .bag)"
        raise InputError("is of a 3D recording: no table", where=str(result.folder), hint=hint)
    tables.write_parquet(exported, output)
    return f"{exported.recording.n_beams} beams"


def _convert_to_bag(
    args: argparse.Namespace, result: ResultFolder, output: Path
) -> tuple[list[str], str]:
    hint = f"a bag, .mcap for Foxglove, {_PARQUET}, or in 3D {_CLOUDS}"
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


def _read_result(args: argparse.Namespace, result: ResultFolder, output: Path) -> MappedPlace:
    with show_share(args.quiet, "reading") as progress:
        recording, _ = result.read(progress, workplace(output))
    exported = MappedPlace.open(result.folder)
    exported.recording = result.calibrate(recording)
    return exported


def _convert_to_cloud(
    args: argparse.Namespace, result: ResultFolder, output: Path, form: point_cloud_files.Format
) -> str:
    require_new_file(output, args.overwrite)
    point_cloud_files.require_extras(form, output)
    is_whole = isinstance(result.record.get(reader.TILTING), dict) or reader.is_place(result.folder)
    if is_whole or result.record["input"].get(reader.EXTENDS) is True:  # no recording has all of it
        points = point_cloud.cloud_from_folder(result.folder, args.only)
    else:
        points = _build_cloud(args, result, workplace(output))
    with show_share(args.quiet, "writing") as progress:
        point_cloud_files.write(points, output, form, progress)
    return f"{points.count} points as {form.description}"


def _build_cloud(
    args: argparse.Namespace, result: ResultFolder, scratch: Path
) -> point_cloud.Cloud:
    with show_share(args.quiet, "reading") as progress:
        recording, labels = result.read(progress, scratch)
    if recording.dimension != 3:
        hint = f"{_PARQUET} holds the end points of its beams"
        what = "is a 2D result: it has no point cloud"
        raise InputError(what, where=str(result.folder), hint=hint)
    poses = result.read_poses(recording)
    deskewed = deskew_recording(recording, poses, result.slam_options)
    colors = reader.read_colors(result.folder, recording.n_beams)
    deskewed = limit_hits(deskewed, poses, result.output_options.region)
    return point_cloud.cloud_from_recording(
        recording,
        deskewed,
        poses,
        labels.p_static,
        args.only,
        colors,
        result.read_origin(),
    )
