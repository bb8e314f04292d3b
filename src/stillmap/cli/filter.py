"""`stillmap filter`: the recording again, without beams that ended on something moving.

Imports that take long are made inside the functions, so that `--help` and completion are quick.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from stillmap.cli.arguments import parents_made, require_apart
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
    """Adds the command."""
    p = commands.add_parser(
        "filter",
        help=COMMANDS["filter"],
        description="Write the recording again, in its own format, with the beams blanked that met "
        "something moving: for mappers and localisers that take all they see for static. Nothing "
        "else is changed.",
        epilog=_EPILOG,
    )
    p.add_argument("result", metavar="DIR", help="what `stillmap map` wrote")
    p.add_argument("-o", "--output", metavar="FILE", required=True, help="where the recording goes")
    p.add_argument("--input", metavar="FILE", help="the recording, if it is not where it was")
    p.add_argument(
        "--below",
        metavar="P",
        type=float,
        default=0.5,
        help="blank beams that something static reflected with less than P (default: %(default)g)",
    )
    p.add_argument("--overwrite", action="store_true", help="replace what is there")
    p.add_argument("--json", action="store_true", help="the summary as one JSON object on stdout")
    p.add_argument("--quiet", action="store_true", help="no summary")
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Reads labels and recording, writes the recording without dynamic beams."""
    if not 0.0 <= args.below <= 1.0:
        raise InputError(f"--below wants 0 to 1, got {args.below:g}")
    output = Path(args.output)
    with parents_made(output):
        done = filtered(Path(args.result), output, args.input, args.below, args.overwrite)
    if args.json:
        counts = {"hits": done.hits, "blanked": done.blanked, "scans_left_out": done.left_out}
        print_json({"output": str(output), "input": str(done.source), **counts})
    if not args.quiet:
        share = 100.0 * done.blanked / max(done.hits, 1)
        say(f"{done.blanked} beams blanked, {share:.1f} % of the hits; in {output}")
        if done.left_out:
            say(f"{done.left_out} scans left out that were not mapped")
        for topic in done.unfiltered:
            say(f"warning: {topic} is as it was: it was not mapped")
        for topic in done.topics:
            say(f"warning: {topic} left out: the bag does not say what its messages are made of")
    return 0


class Filtered(NamedTuple):
    """What was written.

    Attributes:
        source: the recording that it was made from.
        hits: beams of it that hit something.
        blanked: of these.
        left_out: scans that are not in it.
        topics: of a bag, that are not in it.
        unfiltered: of a bag, with scans of other lasers, as they were.
    """

    source: Path
    hits: int
    blanked: int
    left_out: int
    topics: list[str]
    unfiltered: list[str]


def filtered(
    result: Path, output: Path, given: str | None, below: float, overwrite: bool
) -> Filtered:
    """Write the recording of a result without the beams that are static with less than `below`.

    Raises:
        InputError: the result or its recording is not there, or the output is taken.
    """
    import numpy as np

    from stillmap.core import arrays
    from stillmap.core.files import require_new, require_new_file
    from stillmap.io import stillmap_folder
    from stillmap.io.registry import detect_format
    from stillmap.results.folder import open_result

    mapped = open_result(result, given)
    form = detect_format(mapped.source) if mapped.source.exists() else None
    if form is not None:
        _require_ending(output, mapped.source, form.name)
    require_apart(output, mapped.source, mapped.folder)
    in_folder = mapped.source.is_dir() or mapped.source.name == stillmap_folder.HEADER
    if in_folder:
        mark = (
            "metadata.yaml"
            if form is not None and form.name == "ROS bag"
            else stillmap_folder.HEADER
        )
        require_new(output, mark, overwrite)
    else:
        require_new_file(output, overwrite)
    recording, labels = mapped.read()
    hits = blanked = 0
    scratch = output.absolute().parent
    blank = arrays.empty(recording.hit.shape, np.bool_, scratch)
    for block in arrays.iter_blocks(recording.hit, labels.p_static, blank):
        hit = recording.hit[block]
        # NaN: unusable anyway
        blank[block] = hit & (labels.p_static[block] < below)
        hits += int(np.count_nonzero(hit))
        blanked += int(np.count_nonzero(blank[block]))
    written = _write(mapped, output, recording, blank, overwrite)
    return Filtered(mapped.source, hits, blanked, *written)


def _require_ending(output: Path, source: Path, form: str) -> None:
    """What is written has the form of the source: no other one is to be named.

    Raises:
        InputError: the ending is that of another form.
    """
    from stillmap.io import writers
    from stillmap.io.ros.bag_types import detect_kind

    own = {"CARMEN log": "carmen", "ROS bag": ""}.get(form, form)
    said = writers.format_of_ending(output)
    if said is not None and said != (own or detect_kind(source)[0]):
        what = f"would be a {form} like {source.name}, which its ending does not say"
        raise InputError(what, where=str(output), hint="`stillmap convert` makes another form")


def _write(
    mapped: "ResultFolder",
    output: Path,
    recording: "Recording",
    blank: "NDArray[np.bool_]",
    overwrite: bool,
) -> tuple[int, list[str], list[str]]:
    """How many scans, and which topics, are not in what was written; which are not filtered."""
    from stillmap.io import stillmap_folder
    from stillmap.io.carmen import filtered_log
    from stillmap.io.registry import detect_format

    form = detect_format(mapped.source)
    if form.name == "ROS bag":
        from stillmap.io.ros import recording_writer

        options = mapped.read_options
        done = recording_writer.write_filtered_bag(
            mapped.source, output, recording, blank, options, overwrite=overwrite
        )
        return done.omitted, done.omitted_topics, done.unfiltered_topics
    if form.name == "stillmap recording":
        stillmap_folder.write(
            _without(recording, blank, output.absolute().parent), output, overwrite=overwrite
        )
        return 0, [], []
    if form.name == "CARMEN log":
        copy = filtered_log.write_filtered_log(mapped.source, output, recording, blank)
        return copy.omitted, [], []
    hint = "`stillmap convert` makes a recording of another form that can be"
    raise InputError(f"a {form.name} cannot be written again", where=str(mapped.source), hint=hint)


def _without(recording: "Recording", blank: "NDArray[np.bool_]", scratch: Path) -> "Recording":
    """Blanked beams went as far as they did, and met nothing."""
    from stillmap.core import arrays

    hit = arrays.copy(recording.hit, scratch)
    for block in arrays.iter_blocks(hit, blank):
        hit[block] &= ~blank[block]
    return dataclasses.replace(recording, hit=hit)
