"""`stillmap filter`: write a result's recording again with its dynamic beams blanked."""

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from stillmap.cli.arguments import make_parents, require_apart
from stillmap.cli.console import print_json, say
from stillmap.core.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stillmap.core.recording import Recording
    from stillmap.results.folder import ResultFolder

DESCRIPTION = (
    "Write the recording again, in its own format, with dynamic beams blanked: for "
    "mapping and localization programs that assume a static world. Nothing else changes."
)
EPILOG = """examples:
  stillmap filter out -o clean.clf.gz
  stillmap filter out -o clean.log --below 0.3 --input moved/log.log
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the flags and arguments."""
    p.add_argument("result", metavar="DIR", help="folder that `stillmap map` wrote")
    p.add_argument("-o", "--output", metavar="FILE", required=True, help="filtered recording")
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
    from stillmap.results.folder import open_result

    if not 0.0 <= args.below <= 1.0:
        raise InputError(f"--below wants 0 to 1, got {args.below:g}")
    output = Path(args.output)
    with make_parents(output):
        result = open_result(Path(args.result), args.input)
        _require_free(result, output, args.overwrite)
        recording, labels = result.read()
        scratch = output.absolute().parent
        blank, hits, blanked = _select_beams(recording, labels.p_static, args.below, scratch)
        omitted, notes = _write(result, output, recording, blank, args.overwrite)
    if args.json:
        counts = {"hits": hits, "blanked": blanked, "scans_left_out": omitted}
        print_json({"output": str(output), "input": str(result.source), **counts})
    if not args.quiet:
        share = 100.0 * blanked / max(hits, 1)
        say(f"{blanked} beams blanked, {share:.1f} % of the hits; in {output}")
        if omitted:
            say(f"{omitted} scans left out that were not mapped")
        for note in notes:
            say(f"warning: {note}")
    return 0


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


def _require_free(result: "ResultFolder", output: Path, overwrite: bool) -> None:
    """Refuse an output of another format, one that is taken, or one that holds an input."""
    from stillmap.core.files import require_new, require_new_file
    from stillmap.io import stillmap_folder
    from stillmap.io.registry import detect_format

    source = result.source
    form = detect_format(source).name if source.exists() else None
    if form is not None:
        _require_ending(output, source, form)
    require_apart(output, source, result.folder)
    if source.is_dir() or source.name == stillmap_folder.HEADER:
        mark = "metadata.yaml" if form == "ROS bag" else stillmap_folder.HEADER
        require_new(output, mark, overwrite)
    else:
        require_new_file(output, overwrite)


def _require_ending(output: Path, source: Path, form: str) -> None:
    """The output has the format of the source.

    Raises:
        InputError: the ending is that of another format.
    """
    from stillmap.io import writers
    from stillmap.io.ros.bag_types import detect_kind

    own = {"CARMEN log": "carmen", "ROS bag": ""}.get(form, form)
    named = writers.format_of_ending(output)
    if named is not None and named != (own or detect_kind(source)[0]):
        what = f"would be a {form} like {source.name}, but has another ending"
        raise InputError(what, where=str(output), hint="`stillmap convert` writes other formats")


def _write(
    result: "ResultFolder",
    output: Path,
    recording: "Recording",
    blank: "NDArray[np.bool_]",
    overwrite: bool,
) -> tuple[int, list[str]]:
    """Write the copy; return the number of scans left out, and what else is not filtered."""
    from stillmap.core import arrays
    from stillmap.io import stillmap_folder
    from stillmap.io.carmen import filtered_log
    from stillmap.io.registry import detect_format

    source, form = result.source, detect_format(result.source).name
    if form == "ROS bag":
        from stillmap.io.ros import recording_writer

        bag = recording_writer.write_filtered_bag(
            source, output, recording, blank, result.read_options, overwrite=overwrite
        )
        unknown = "left out: the bag does not say what its messages are made of"
        return bag.omitted, [
            *(f"{topic} is as it was: it was not mapped" for topic in bag.unfiltered_topics),
            *(f"{topic} {unknown}" for topic in bag.omitted_topics),
        ]
    if form == "stillmap recording":
        # blanked beams are misses of the same length
        hit = arrays.copy(recording.hit, output.absolute().parent)
        for block in arrays.iter_blocks(hit, blank):
            hit[block] &= ~blank[block]
        stillmap_folder.write(dataclasses.replace(recording, hit=hit), output, overwrite=overwrite)
        return 0, []
    if form == "CARMEN log":
        return filtered_log.write_filtered_log(
            source, output, recording, blank, result.read_options
        ), []
    hint = "`stillmap convert` writes it in a format that can be"
    raise InputError(f"a {form} cannot be written again", where=str(source), hint=hint)
