"""Write the recording of one result again with its dynamic beams blanked."""

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from stillmap.cli.arguments import require_apart
from stillmap.cli.console import show_share

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stillmap.core.recording import Recording
    from stillmap.io.filter_writers import FilterTarget
    from stillmap.results.folder import ResultFolder


class Filtered(NamedTuple):
    """Counts of a recording that was written without its dynamic beams.

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
        """The number of beams that were blanked, and their share."""
        share = 100.0 * self.blanked / max(self.hits, 1)
        return f"{self.blanked} beams blanked, {share:.1f} % of the hits"


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
    from stillmap.core.files import workplace
    from stillmap.io.filtered_copy import FilterJob

    scratch = workplace(output)
    with show_share(args.quiet, "reading") as progress:
        recording, labels = result.read(progress, scratch, left_out=True)
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
