"""`stillmap filter`: write a result's recording again with its dynamic beams blanked."""

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from stillmap.cli.arguments import make_parents, require_apart
from stillmap.cli.console import print_json, say, show_share
from stillmap.cli.convert import NAMES
from stillmap.core.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stillmap.core.recording import Recording
    from stillmap.io.filter_writers import FilterTarget
    from stillmap.results.folder import ResultFolder

DESCRIPTION = (
    "Write the recording again with dynamic beams blanked, 2D or 3D: for mapping and localization "
    "programs that assume a static world. It keeps its own format, in which nothing else changes, "
    "unless FILE has the ending of another one or --to names it. Parts of one run become one "
    "recording."
)
EPILOG = """examples:
  stillmap filter out -o clean.clf.gz
  stillmap filter out -o clean.log --below 0.3 --input moved/log.log
  stillmap filter out -o clean            a KITTI folder, of a result of one
  stillmap filter out -o clean.mcap       a bag, of any result
  stillmap filter out -o clean --to pcd   a folder of PCD files
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the flags and arguments."""
    p.add_argument("result", metavar="DIR", help="folder that `stillmap map` wrote")
    p.add_argument("-o", "--output", metavar="FILE", required=True, help="filtered recording")
    p.add_argument(
        "--to",
        metavar="FORMAT",
        choices=NAMES,
        help=f"another format: {', '.join(NAMES)} (default: by the ending of FILE, else its own)",
    )
    p.add_argument("--input", metavar="FILE", help="the recording, if it was moved")
    p.add_argument(
        "--below",
        metavar="P",
        type=float,
        default=0.5,
        help="blank beams whose P(static) is below P (default: %(default)g)",
    )
    p.add_argument("--overwrite", action="store_true", help="replace what is there")
    p.add_argument("--json", action="store_true", help="the summary as one JSON object on stdout")
    p.add_argument("--quiet", action="store_true", help="no summary")


def run(args: argparse.Namespace) -> int:
    """Read labels and recording, and write the recording without dynamic beams.

    Raises:
        InputError: the result or its recording is not there, or the output is taken.
    """
    from stillmap.io.filtered_copy import FilterJob
    from stillmap.results.folder import open_result

    if not 0.0 <= args.below <= 1.0:
        raise InputError(f"--below wants 0 to 1, got {args.below:g}")
    output = Path(args.output)
    with make_parents(output):
        result = open_result(Path(args.result), args.input)
        options = result.read_options
        target = _find_target(result, output, args)
        scratch = output.absolute().parent
        with show_share(args.quiet, "reading") as progress:
            recording, labels = result.read(progress, scratch)
        if target.takes_poses and recording.T_recorded_base is None:
            recording = _place(recording, result, target)
        blank, hits, blanked = _select_beams(recording, labels.p_static, args.below, scratch)
        with show_share(args.quiet, "writing") as progress:
            job = FilterJob(
                result.source,
                output,
                recording,
                blank,
                options,
                target.marker,
                args.overwrite,
                (result.folder,),
                progress,
            )
            omitted, notes = target.write(job)
    if args.json:
        counts = {"hits": hits, "blanked": blanked, "scans_left_out": omitted}
        parts = {"parts": list(map(str, result.parts))} if result.parts else {}
        print_json({"output": str(output), "input": str(result.source), **parts, **counts})
    if not args.quiet:
        share = 100.0 * blanked / max(hits, 1)
        say(f"wrote {output}: {blanked} beams blanked, {share:.1f} % of the hits")
        if omitted:
            say(f"{omitted} scans left out that were not mapped")
        for note in notes:
            say(f"warning: {note}")
    return 0


def _place(recording: "Recording", result: "ResultFolder", target: "FilterTarget") -> "Recording":
    """The recording at the poses of the map; in one cloud, without the motion during its scans."""
    from stillmap.slam import deskew_recording

    poses, recording = result.read_poses(recording), result.calibrate(recording)
    if not target.is_folder:
        recording = deskew_recording(recording, poses, result.slam_options)
    return dataclasses.replace(recording, T_recorded_base=poses)


def _find_target(result: "ResultFolder", output: Path, args: argparse.Namespace) -> "FilterTarget":
    """Find how the output is written.

    Raises:
        InputError: it cannot be, or is taken; before anything long is done.
    """
    from stillmap.io import filter_writers, writers

    source = result.require_source()
    for path in result.sources:
        require_apart(output, path, result.folder)
    if result.parts:
        target = filter_writers.find_joined_target(output, args.to)
    else:
        target = filter_writers.find_target(source, output, args.to)
    filter_writers.require_free(target, output, source, args.overwrite)
    if target.writer is not None:
        writers.require_fit(output, target.writer, result.dimension, result.n_sensors)
    return target


def _select_beams(
    recording: "Recording", p_static: "NDArray[np.float32]", below: float, scratch: Path
) -> "tuple[NDArray[np.bool_], int, int]":
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
