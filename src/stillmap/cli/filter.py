"""`stillmap filter`: write a result's recording again with its dynamic beams blanked."""

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from stillmap.cli.arguments import make_parents, require_apart
from stillmap.cli.console import print_json, say
from stillmap.cli.parser import COMMANDS
from stillmap.core.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stillmap.core.recording import Recording
    from stillmap.results.folder import ResultFolder

_EPILOG = """examples:
  stillmap filter out -o clean.clf.gz
  stillmap filter out -o clean.log --below 0.3 --input moved/log.log
"""


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    p = commands.add_parser(
        "filter",
        help=COMMANDS["filter"],
        description="Write the recording again, in its own format, with dynamic beams blanked: for "
        "mapping and localization programs that assume a static world. Nothing else changes.",
        epilog=_EPILOG,
    )
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
    p.set_defaults(run=run)


class _Request(NamedTuple):
    """Parsed arguments.

    Attributes:
        result: result folder.
        output: filtered recording.
        recording: path of the recording, None: where the result says.
        below: blank beams whose P(static) is below this.
        overwrite: replace what is there.
    """

    result: Path
    output: Path
    recording: str | None
    below: float
    overwrite: bool


class _Filtered(NamedTuple):
    """Counts of the filtered copy.

    Attributes:
        hits: beams of the recording that hit something.
        blanked: how many of these were blanked.
        omitted: scans left out.
        omitted_topics: topics of a bag left out.
        unfiltered_topics: topics of a bag with scans of other lasers, copied unchanged.
    """

    hits: int
    blanked: int
    omitted: int
    omitted_topics: list[str]
    unfiltered_topics: list[str]


def run(args: argparse.Namespace) -> int:
    """Read labels and recording, and write the recording without dynamic beams."""
    if not 0.0 <= args.below <= 1.0:
        raise InputError(f"--below wants 0 to 1, got {args.below:g}")
    request = _Request(Path(args.result), Path(args.output), args.input, args.below, args.overwrite)
    with make_parents(request.output):
        source, done = _filter(request)
    if args.json:
        counts = {"hits": done.hits, "blanked": done.blanked, "scans_left_out": done.omitted}
        print_json({"output": str(request.output), "input": str(source), **counts})
    if not args.quiet:
        _print_summary(done, request.output)
    return 0


def _print_summary(done: _Filtered, output: Path) -> None:
    share = 100.0 * done.blanked / max(done.hits, 1)
    say(f"{done.blanked} beams blanked, {share:.1f} % of the hits; in {output}")
    if done.omitted:
        say(f"{done.omitted} scans left out that were not mapped")
    for topic in done.unfiltered_topics:
        say(f"warning: {topic} is as it was: it was not mapped")
    for topic in done.omitted_topics:
        say(f"warning: {topic} left out: the bag does not say what its messages are made of")


def _filter(request: _Request) -> tuple[Path, _Filtered]:
    """Write the filtered recording; return the path of the recording and what was written.

    Raises:
        InputError: the result or its recording is not there, or the output is taken.
    """
    import numpy as np

    from stillmap.core import arrays
    from stillmap.results.folder import open_result

    result = open_result(request.result, request.recording)
    _require_free(request, result)
    recording, labels = result.read()
    hits = blanked = 0
    blank = arrays.empty(recording.hit.shape, np.bool_, request.output.absolute().parent)
    for block in arrays.iter_blocks(recording.hit, labels.p_static, blank):
        hit = recording.hit[block]
        # p_static of unusable beams is NaN: never blanked
        blank[block] = hit & (labels.p_static[block] < request.below)
        hits += int(np.count_nonzero(hit))
        blanked += int(np.count_nonzero(blank[block]))
    written = _write(result, request, recording, blank)
    return result.source, _Filtered(hits, blanked, *written)


def _require_free(request: _Request, result: "ResultFolder") -> None:
    """Refuse an output of another format, one that is taken, or one that holds an input."""
    from stillmap.core.files import require_new, require_new_file
    from stillmap.io import stillmap_folder
    from stillmap.io.registry import detect_format

    source, output = result.source, request.output
    form = detect_format(source).name if source.exists() else None
    if form is not None:
        _require_ending(output, source, form)
    require_apart(output, source, result.folder)
    if source.is_dir() or source.name == stillmap_folder.HEADER:
        mark = "metadata.yaml" if form == "ROS bag" else stillmap_folder.HEADER
        require_new(output, mark, request.overwrite)
    else:
        require_new_file(output, request.overwrite)


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
    request: _Request,
    recording: "Recording",
    blank: "NDArray[np.bool_]",
) -> tuple[int, list[str], list[str]]:
    """Write the copy; return omitted scans, omitted topics and unfiltered topics."""
    from stillmap.io import stillmap_folder
    from stillmap.io.carmen import filtered_log
    from stillmap.io.registry import detect_format

    source, output, overwrite = result.source, request.output, request.overwrite
    form = detect_format(source)
    if form.name == "ROS bag":
        from stillmap.io.ros import recording_writer

        bag = recording_writer.write_filtered_bag(
            source, output, recording, blank, result.read_options, overwrite=overwrite
        )
        return bag.omitted, bag.omitted_topics, bag.unfiltered_topics
    if form.name == "stillmap recording":
        filtered = _blank_beams(recording, blank, output.absolute().parent)
        stillmap_folder.write(filtered, output, overwrite=overwrite)
        return 0, [], []
    if form.name == "CARMEN log":
        log = filtered_log.write_filtered_log(source, output, recording, blank)
        return log.omitted, [], []
    hint = "`stillmap convert` writes it in a format that can be"
    raise InputError(f"a {form.name} cannot be written again", where=str(source), hint=hint)


def _blank_beams(recording: "Recording", blank: "NDArray[np.bool_]", scratch: Path) -> "Recording":
    """The blanked beams as misses of the same length."""
    from stillmap.core import arrays

    hit = arrays.copy(recording.hit, scratch)
    for block in arrays.iter_blocks(hit, blank):
        hit[block] &= ~blank[block]
    return dataclasses.replace(recording, hit=hit)
