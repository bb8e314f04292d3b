"""What `stillmap convert` does once it is known what is wanted."""

import argparse
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from stillmap import options, slam
from stillmap.cli.parents import parents_made
from stillmap.cli.progress import shown_share
from stillmap.cli.reading import read_changes
from stillmap.cli.results import Mapped, found, is_deskewed, is_result, require_apart
from stillmap.errors import InputError
from stillmap.evaluation.folders import read_colours
from stillmap.export import bag, beam_table, cloud, cloud_files, model, result
from stillmap.output.atomic import require_new_file
from stillmap.output.tilting import FOLDER as TILTING
from stillmap.recording import ReadOptions, Recording, read, ros_writing, writers
from stillmap.recording.formats import format_of
from stillmap.recording.poses import poses_from_tum

_PARQUET = ".parquet"


def converted(args: argparse.Namespace) -> tuple[list[str], str]:
    """What could not be written, a sentence each, and what was.

    Raises:
        InputError: it cannot be read, or the output cannot hold it.
    """
    source, output = Path(args.input), Path(args.output)
    if is_result(source):
        with parents_made(output):
            return _convert_result(args, source, output)
    format_of(source)  # what is not there is told before what cannot be written
    with parents_made(output):
        return _convert_recording(args, source, output)


def _convert_recording(
    args: argparse.Namespace, source: Path, output: Path
) -> tuple[list[str], str]:
    if args.recording or args.only:
        flag = "--input" if args.recording else "--only"
        raise InputError(f"{flag} is for results", where=str(source))
    read_options = options.replaced(ReadOptions(), read_changes(args).get("read", {}))
    require_apart(output, source)
    writer = writers.writer_for(output, args.to)
    writers.require_free(output, writer, args.overwrite)
    with shown_share(args.quiet, "reading") as tell:
        recording = read(source, read_options, progress=tell, scratch=output.absolute().parent)
    if not recording.n_scans:
        raise InputError("holds no scan", where=str(source))
    lost = writers.write(recording, output, name=args.to, overwrite=args.overwrite)
    return lost, f"{recording.n_scans} scans, {recording.n_beams} beams as {writer.about}"


def _convert_result(args: argparse.Namespace, folder: Path, output: Path) -> tuple[list[str], str]:
    if read_changes(args):
        text = "a result's recording is read as it was when it was mapped: no flags for reading it"
        raise InputError(text, where=str(folder))
    mapped = found(folder, args.recording)
    require_apart(output, mapped.source, folder)
    if (form := cloud_files.format_for(output, args.to)) is not None:
        return [], _convert_to_cloud(args, mapped, output, form)
    if args.only:
        raise InputError("--only is for clouds of points", where=str(output), hint=_clouds())
    if output.suffix.lower() == model.ENDING and args.to is None:
        return [], _convert_to_obj(args, mapped, output)
    if output.suffix.lower() == _PARQUET and args.to is None:
        require_new_file(output, args.overwrite)
        beam_table.require_pyarrow()
        exported = _exported(mapped)
        seen = _seen(mapped, exported.recording, exported.poses)
        beam_table.write(exported, seen, output)
        return [], f"{exported.recording.n_beams} beams"
    hint = f"a bag, .mcap for Foxglove, {_PARQUET}, or in 3D {_clouds()}, {model.ENDING}"
    try:
        writer = writers.writer_for(output, args.to)
    except InputError as error:
        raise InputError(error.what, where=str(output), hint=hint) from error
    kind = next((kind for kind in get_args(ros_writing.Kind) if kind == writer.name), None)
    if kind is None:
        text = f"a result cannot be written as {writer.about}"
        more = "; recordings come of `stillmap filter`"
        raise InputError(text, where=str(output), hint=hint + more)
    writers.require_free(output, writer, args.overwrite)
    exported = _exported(mapped)
    lost = bag.write(exported, output, kind, overwrite=args.overwrite)
    return lost, f"{exported.recording.n_scans} scans, map, way and {len(exported.tracks)} objects"


def _convert_to_obj(args: argparse.Namespace, mapped: Mapped, output: Path) -> str:
    faces, pages = model.write_obj(
        mapped.folder, output, mapped.texture_options.quality, args.overwrite
    )
    return f"{faces} faces and {pages} page{'s' * (pages != 1)} of texture"


def _clouds() -> str:
    return ", ".join(end for form in cloud_files.FORMATS for end in form.endings)


def _convert_to_cloud(
    args: argparse.Namespace, mapped: Mapped, output: Path, form: cloud_files.Format
) -> str:
    require_new_file(output, args.overwrite)
    cloud_files.require_extras(form, output)
    if isinstance(mapped.record.get(TILTING), dict):
        points = cloud.cloud_in(mapped.folder, args.only)
    else:
        points = _cloud_of(args, mapped, output)
    with shown_share(args.quiet, "writing") as tell:
        cloud_files.write(points, output, form, tell)
    return f"{points.count} points as {form.about}"


def _cloud_of(args: argparse.Namespace, mapped: Mapped, output: Path) -> cloud.Cloud:
    with shown_share(args.quiet, "reading") as tell:
        recording, labels = mapped.read(tell, output.absolute().parent)
    if recording.dimension != 3:
        raise InputError(
            "is of a recording in the plane: it has no cloud of points",
            where=str(mapped.folder),
            hint=f"{_PARQUET} has where its beams ended",
        )
    poses = poses_from_tum(mapped.folder / "trajectory.tum", recording)
    seen = _seen(mapped, recording, poses)
    colours = read_colours(mapped.folder, recording.n_beams)
    return cloud.cloud_of(recording, seen, poses, labels.p_static, args.only, colours)


def _exported(mapped: Mapped) -> result.Exported:
    recording, labels = mapped.read()
    return result.read(mapped.folder, recording, labels.p_static)


def _seen(mapped: Mapped, recording: Recording, poses: NDArray[np.float64]) -> Recording:
    """The recording without the motion during its scans, as it was mapped."""
    how = slam.SlamOptions(deskew=is_deskewed(mapped.record))
    return slam.deskewed(recording, poses, how)
