"""`stillmap filter`: write a result's recording again with its dynamic beams blanked."""

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

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
    "recording. Of a place FILE is a folder, with a recording for each of its sessions."
)
EPILOG = """examples:
  stillmap filter out -o clean.clf.gz
  stillmap filter out -o clean.log --below 0.3 --input moved/log.log
  stillmap filter out -o clean            a KITTI folder, of a result of one
  stillmap filter out -o clean.mcap       a bag, of any result
  stillmap filter out -o clean --to pcd   a folder of PCD files
  stillmap filter place -o clean          a folder with a recording of every session
  stillmap filter place/sessions/monday -o monday.bag
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the flags and arguments."""
    p.add_argument("result", metavar="DIR", help="folder that `stillmap map` or `merge` wrote")
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


class Filtered(NamedTuple):
    """What was done to a recording.

    Attributes:
        hits: beams that hit something.
        blanked: how many of them were blanked.
        left_out: scans that were not mapped.
        notes: what the format cannot hold, a sentence each.
    """

    hits: int
    blanked: int
    left_out: int
    notes: tuple[str, ...]

    def describe(self) -> str:
        """How many beams were blanked."""
        share = 100.0 * self.blanked / max(self.hits, 1)
        return f"{self.blanked} beams blanked, {share:.1f} % of the hits"


def run(args: argparse.Namespace) -> int:
    """Read labels and recording, and write the recording without dynamic beams.

    Raises:
        InputError: the result or its recording is not there, or the output is taken.
    """
    from stillmap.places.inputs import is_place

    if not 0.0 <= args.below <= 1.0:
        raise InputError(f"--below wants 0 to 1, got {args.below:g}")
    output = Path(args.output)
    with make_parents(output):
        if is_place(Path(args.result)):
            from stillmap.cli.filter_place import filter_place

            filter_place(args, Path(args.result), output)
        else:
            _filter_result(args, output)
    return 0


def _filter_result(args: argparse.Namespace, output: Path) -> None:
    from stillmap.io import filter_writers
    from stillmap.results.folder import open_result

    result = open_result(Path(args.result), args.input)
    _ = result.read_options  # refused before the recording is looked for
    target = find_target(result, output, args.to)
    filter_writers.require_free(target, output, result.source, args.overwrite)
    done = write_filtered(result, target, output, args)
    if args.json:
        parts = {"parts": list(map(str, result.parts))} if result.parts else {}
        print_json(
            {
                "output": str(output),
                "input": str(result.source),
                **parts,
                "hits": done.hits,
                "blanked": done.blanked,
                "scans_left_out": done.left_out,
            }
        )
    if not args.quiet:
        say(f"wrote {output}: {done.describe()}")
        if done.left_out:
            say(f"{done.left_out} scans left out that were not mapped")
        for note in done.notes:
            say(f"warning: {note}")


def find_target(result: "ResultFolder", output: Path, to: str | None) -> "FilterTarget":
    """Find how the filtered recording of a result is written.

    Args:
        result: of a recording.
        output: the filtered recording.
        to: name of a format; None: by the ending of the output, else the recording's own.

    Raises:
        InputError: it cannot be; before anything long is done.
    """
    from stillmap.io import filter_writers, writers

    source = result.require_source()
    for path in result.sources:
        require_apart(output, path, result.folder)
    if result.parts:
        target = filter_writers.find_joined_target(output, to)
    else:
        target = filter_writers.find_target(source, output, to)
    if target.writer is not None:
        writers.require_fit(output, target.writer, result.dimension, result.n_sensors)
    return target


def write_filtered(
    result: "ResultFolder", target: "FilterTarget", output: Path, args: argparse.Namespace
) -> Filtered:
    """Write the recording of a result without its dynamic beams.

    Raises:
        InputError: labels and recording cannot be read, or do not belong together.
    """
    from stillmap.io.filtered_copy import FilterJob

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
            result.read_options,
            target.marker,
            args.overwrite,
            (Path(args.result),),
            progress,
        )
        left_out, notes = target.write(job)
    return Filtered(hits, blanked, left_out, tuple(notes))


def _place(recording: "Recording", result: "ResultFolder", target: "FilterTarget") -> "Recording":
    """The recording at the poses of the map; in one cloud, without the motion during its scans."""
    from stillmap.slam import deskew_recording

    poses, recording = result.read_poses(recording), result.calibrate(recording)
    if not target.is_folder:
        recording = deskew_recording(recording, poses, result.slam_options)
    return dataclasses.replace(recording, T_recorded_base=poses)


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
