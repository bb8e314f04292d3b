"""Write the recording again with dynamic beams blanked, 2D or 3D: for mapping and localization
programs that assume a static world. Bags, CARMEN logs, KITTI folders, PCD, PLY, LAS and LAZ
files keep their format, in which nothing else changes, unless FILE has the ending of another one
or --to names it; E57, 3DTK and depth images come back as PLY or PCD. Parts of one run become one
recording. Of a place FILE is a folder, with a recording for each of its sessions.

examples:
  stillmap filter out -o clean.clf.gz
  stillmap filter out -o clean.log --below 0.3 --input moved/log.log
  stillmap filter out -o clean            a KITTI folder, of a result of one
  stillmap filter out -o clean.mcap       a bag, of any result
  stillmap filter out -o clean --to pcd   a folder of PCD files
  stillmap filter place -o clean          a folder with a recording of every session
  stillmap filter place/sessions/monday -o monday.bag
"""

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.cli.arguments import JSON, OVERWRITE, make_parents, require_apart
from stillmap.cli.console import print_json, say, show_share
from stillmap.cli.convert import NAMES
from stillmap.core.errors import InputError

if TYPE_CHECKING:
    from stillmap.core.array_types import Bool, Float32
    from stillmap.core.recording import Recording
    from stillmap.io.filter_writers import FilterTarget
    from stillmap.results.folder import ResultFolder


_INDEX = "filtered.json"  # the list of what the folder of a place holds


FLAGS = f"""
result DIR  folder that `stillmap map` or `merge` wrote
-o --output FILE!  filtered recording
--to {{{",".join(NAMES)}}}  another format (default: by the ending of FILE, else its own)
--input FILE  the recording, if it was moved
--below P = 0.5  blank beams whose P(static) is below P
{OVERWRITE}{JSON}"""


def run(args: argparse.Namespace) -> int:
    """Read labels and recording, and write the recording without dynamic beams.

    Raises:
        InputError: the result or its recording is not there, or the output is taken.
    """
    from stillmap.io import writers
    from stillmap.results.folder import open_result
    from stillmap.results.reader import is_place

    if not 0.0 <= args.below <= 1.0:
        raise InputError(f"--below wants 0 to 1, got {args.below:g}")
    folder, output = Path(args.result), Path(args.output)
    with make_parents(output):
        if is_place(folder):
            summary = _filter_place(args, folder, output)
        else:
            result = open_result(folder, args.input)
            target = _find_target(result, output, args.to)
            writers.require_free(output, target.marker, args.overwrite)
            summary = _write_filtered(result, target, output, "", args)
    if args.json:
        print_json({"output": str(output), **summary})
    return 0


def _filter_place(args: argparse.Namespace, place: Path, output: Path) -> dict[str, Any]:
    """Write a folder with the filtered recording of every session, complete or not at all.

    Raises:
        InputError: a recording is not there any more, or the output is taken.
    """
    from stillmap.core.files import atomic_folder, require_new
    from stillmap.core.json import write_json
    from stillmap.results.timeline import read_sessions

    if args.input is not None:
        hint = f"one by one: stillmap filter {place}/sessions/NAME -o FILE --input FILE"
        raise InputError("has several recordings: --input names one", where=str(place), hint=hint)
    require_apart(output, place)
    require_new(output, _INDEX, args.overwrite)
    names = [session.name for session in read_sessions(place) if session.accepted]
    # what cannot be written is refused before any is read
    plans = [_plan_session(place, name, output, args.to) for name in names]
    records = []
    with atomic_folder(output, _INDEX, args.overwrite) as folder:
        for name, (result, file, target) in zip(names, plans, strict=True):
            record = _write_filtered(result, target, folder / file, f"{name}: ", args)
            records.append({"name": name, "file": file, **record})
        write_json(folder / _INDEX, records)
    if not args.quiet:
        say(f"wrote {output}")
    return {"sessions": records}


def _plan_session(
    place: Path, name: str, output: Path, to: str | None
) -> "tuple[ResultFolder, str, FilterTarget]":
    """The folder of a session, the name of its filtered recording, and how it is written.

    Raises:
        InputError: its recording is not there, or cannot be written so.
    """
    from stillmap.io import filter_writers
    from stillmap.results.folder import open_result

    try:
        result = open_result(place / "sessions" / name)
        result.require_source()
    except InputError as error:
        hint = f"stillmap filter {place}/sessions/{name} -o FILE --input FILE finds it elsewhere"
        raise InputError(error.what, where=error.where, hint=hint) from error
    source = result.sources[0] if len(result.sources) == 1 else None
    file = name + filter_writers.find_ending(source, to)
    for path in result.sources:
        require_apart(output, path, place)
    return result, file, _find_target(result, output / file, to)


def _find_target(result: "ResultFolder", output: Path, to: str | None) -> "FilterTarget":
    """Find how the filtered recording of a result is written.

    Raises:
        InputError: it cannot be; before anything long is done.
    """
    from stillmap.io import filter_writers, writers

    _ = result.read_options  # refused before the recording is looked for
    source = result.require_source()
    for path in result.sources:
        require_apart(output, path, result.folder)
        filter_writers.require_outside(output, path)
    target = filter_writers.find_target(source if len(result.sources) == 1 else None, output, to)
    if target.writer is not None:
        sensors = result.record["input"].get("sensors")
        count = len(sensors) if isinstance(sensors, list) and sensors else 1
        writers.require_fit(output, target.writer, result.dimension, count)
    return target


def _write_filtered(
    result: "ResultFolder",
    target: "FilterTarget",
    output: Path,
    prefix: str,
    args: argparse.Namespace,
) -> dict[str, Any]:
    """Write the recording of a result without its dynamic beams, and say what was done.

    Raises:
        InputError: labels and recording cannot be read, or do not belong together.
    """
    from stillmap.core.files import workplace
    from stillmap.io.filtered_clouds import FilterJob

    scratch = workplace(output)
    with show_share(args.quiet, "reading") as progress:
        recording, labels = result.read(progress, scratch, left_out=True)
    if target.takes_poses and recording.T_recorded_base is None:
        recording = _place(recording, result, target)
    blank, hits, blanked = _select_beams(recording, labels.p_static, args.below, scratch)
    with show_share(args.quiet, "writing") as progress:
        job = FilterJob(
            result.sources[0],
            output,
            recording,
            blank,
            result.read_options,
            target.marker,
            args.overwrite,
            (Path(args.result),),
            progress,
        )
        left_out, notes = target.write(job)
    if not args.quiet:
        share = 100.0 * blanked / max(hits, 1)
        words = prefix or f"wrote {output}: "
        say(f"{words}{blanked} beams blanked, {share:.1f} % of the hits")
        if left_out:
            say(f"{prefix}{left_out} scans left out that were not mapped")
        for note in notes:
            say(f"warning: {prefix}{note}")
    return {
        "input": str(result.sources[0]),
        **({"parts": list(map(str, result.sources))} if len(result.sources) > 1 else {}),
        "hits": hits,
        "blanked": blanked,
        "scans_left_out": left_out,
    }


def _place(recording: "Recording", result: "ResultFolder", target: "FilterTarget") -> "Recording":
    """The recording at the poses of the map; in one cloud, without the motion during its scans."""
    from stillmap.slam import deskew_recording

    poses = result.read_poses(recording)
    recording = result.calibrate(recording)
    if not target.marker:
        recording = deskew_recording(recording, poses, result.slam_options)
    return dataclasses.replace(recording, T_recorded_base=poses)


def _select_beams(
    recording: "Recording", p_static: "Float32", below: float, scratch: Path
) -> "tuple[Bool, int, int]":
    """(M,) the beams to blank; how many hit something, and how many of these are blanked."""
    import numpy as np

    from stillmap.core import arrays

    hits = blanked = 0
    blank = arrays.empty(recording.hit.shape, np.bool_, scratch)
    for block in arrays.iter_blocks(recording.hit, p_static, blank):
        hit = recording.hit[block]
        # p_static of unusable beams is NaN: never blanked
        blank[block] = hit & (p_static[block] < below)
        hits += int(np.count_nonzero(hit))
        blanked += int(np.count_nonzero(blank[block]))
    return blank, hits, blanked
