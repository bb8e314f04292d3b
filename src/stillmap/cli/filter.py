"""`stillmap filter`: write a result's recording again with its dynamic beams blanked."""

import argparse
from pathlib import Path

from stillmap.cli.arguments import make_parents
from stillmap.cli.console import print_json, say
from stillmap.cli.convert import NAMES
from stillmap.core.errors import InputError

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
    from stillmap.cli.filter_recording import find_target, write_filtered
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
