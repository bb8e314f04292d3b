"""Merge sessions of one place, hours or months apart and from any start, into one map. Each SESSION
is a recording, which is mapped first, or a folder that `stillmap map` wrote; a place that an
earlier merge wrote may go first and grows. What changed between sessions is listed with the
sessions between which it changed. A session that cannot be placed for certain is left out, and
named with the reason.

examples:
  stillmap merge monday.bag tuesday.bag -o place
  stillmap merge out1 out2 out3 -o place --map-state majority
  stillmap merge place wednesday.bag -o place2
  stillmap merge out1 out2 -o place --frame out2

exit status 2 where fewer than two sessions could be placed
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.cli import arguments
from stillmap.cli.console import list_files, print_json, say, show_progress

if TYPE_CHECKING:
    from stillmap.places.finish import PlaceResult


FLAGS = f"""
input SESSION+  a recording, a result folder, or first a place
-o --output PLACE!  folder of the place
{arguments.OVERWRITE}
--frame NAME  session whose frame the place has (default: the first one, or as it was)
--map-state STATE = last  state of what changed that the map shows: last, majority, the name of a
  session, or a date such as 2026-05-31
{arguments.PLACE_MAP}{arguments.NO_ODOMETRY}{arguments.RUN}{arguments.READ}{arguments.OTHERS}"""


def run(args: argparse.Namespace) -> int:
    """Merge sessions into a folder.

    Raises:
        InputError: an input or the output is at fault, or fewer than two sessions could be placed.
    """
    from stillmap.places.merge import merge_sessions, plan_merge

    options, output = arguments.options_from_args(args), Path(args.output)
    job = plan_merge(args.input, options, args.frame, args.map_state, not args.no_odometry)
    with (
        arguments.make_parents(output),
        show_progress(args.quiet, options.em.max_iterations) as progress,
    ):
        result = merge_sessions(job, output, args.overwrite, progress)
    if not args.quiet:
        _print_summary(result, args.map_state, output)
    if args.json:
        print_json(_summarize(result, output))
    return 0


def _print_summary(result: "PlaceResult", map_state: str, output: Path) -> None:
    """Print which sessions were placed, what changed, and where the result lies."""
    sessions, ties = result.place.sessions, result.place.ties
    say(f"{len(sessions)} sessions in one map, {len(ties)} constraints between them")
    for refusal in result.refusals:
        say(f"warning: {refusal.name} is not in the place: {refusal.why}")
    kinds = [change.kind for change in result.changes]
    words = {"appeared": "appeared", "gone": "are gone", "moved": "moved", "door": "are doors"}
    counts = [f"{kinds.count(kind)} {text}" for kind, text in words.items() if kind in kinds]
    what = f"{len(kinds)} changes between sessions: {', '.join(counts)}"
    say(f"{what}; the map shows {map_state}" if kinds else "nothing changed between sessions")
    say(f"wrote {output}")


def _summarize(result: "PlaceResult", output: Path) -> dict[str, Any]:
    from stillmap.places.finish import session_records

    return {
        "output": str(output),
        "files": list_files(output),
        "sessions": session_records(result),
        "changes": len(result.changes),
    }
