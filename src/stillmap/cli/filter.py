"""`stillmap filter`: the recording again, without the beams that met something moving."""

import argparse
from pathlib import Path

from stillmap.cli.commands import COMMANDS
from stillmap.cli.parents import parents_made
from stillmap.cli.printing import print_json
from stillmap.cli.progress import say
from stillmap.errors import InputError

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
    from stillmap.cli.filtering import filtered  # takes long to load

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
