"""`stillmap filter`: the recording again, without the beams that met something moving."""

import argparse
import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.cli.commands import COMMANDS
from stillmap.cli.printing import print_json
from stillmap.cli.progress import say
from stillmap.cli.results import Mapped, found, require_apart
from stillmap.errors import InputError
from stillmap.output.atomic import require_new, require_new_file
from stillmap.recording import Recording, carmen_blanked, folder
from stillmap.recording.formats import format_of

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
    mapped, output = found(Path(args.result), args.input), Path(args.output)
    form = format_of(mapped.source) if mapped.source.exists() else None
    require_apart(output, mapped.source, mapped.folder)
    in_folder = mapped.source.is_dir() or mapped.source.name == folder.HEADER
    if in_folder:
        mark = "metadata.yaml" if form is not None and form.name == "ROS bag" else folder.HEADER
        require_new(output, args.overwrite and (output / mark).is_file())
    else:
        require_new_file(output, args.overwrite)
    recording, labels = mapped.read()
    # NaN: unusable anyway
    blank = recording.hit & (labels.p_static < args.below)
    left_out, topics = _write(mapped, output, recording, blank, args.overwrite)
    beams, hits = int(blank.sum()), int(recording.hit.sum())
    if args.json:
        counts = {"hits": hits, "blanked": beams, "scans_left_out": left_out}
        print_json({"output": str(output), "input": str(mapped.source), **counts})
    if not args.quiet:
        say(f"{beams} beams blanked, {100.0 * beams / max(hits, 1):.1f} % of the hits; in {output}")
        if left_out:
            say(f"{left_out} scans left out that were not mapped")
        for topic in topics:
            say(f"warning: {topic} left out: the bag does not say what its messages are made of")
    return 0


def _write(
    mapped: Mapped, output: Path, recording: Recording, blank: NDArray[np.bool_], overwrite: bool
) -> tuple[int, list[str]]:
    """How many scans, and which topics, are not in what was written."""
    form = format_of(mapped.source)
    if form.name == "ROS bag":
        from stillmap.recording.ros import blanked

        options = mapped.read_options
        done = blanked.write(mapped.source, output, recording, blank, options, overwrite=overwrite)
        return done.left_out, done.topics
    if form.name == "stillmap recording":
        folder.write(_without(recording, blank), output, overwrite=overwrite)
        return 0, []
    if form.name == "CARMEN log":
        return carmen_blanked.write(mapped.source, output, recording, blank).left_out, []
    hint = "`stillmap convert` makes a recording of another form that can be"
    raise InputError(f"a {form.name} cannot be written again", where=str(mapped.source), hint=hint)


def _without(recording: Recording, blank: NDArray[np.bool_]) -> Recording:
    """Blanked beams went as far as they did, and met nothing."""
    return dataclasses.replace(recording, hit=recording.hit & ~blank)
