"""Map many recordings, and merge those of one place. The results lie in DIR, with a page about all
of them, fleet.html. The same command goes on after an interruption, and maps only what is new or
has changed.

examples:
  stillmap fleet monday.bag tuesday.bag -o out --merge
  stillmap fleet recordings -o out --jobs 4
  stillmap fleet 'logs/*.clf.gz' -o out --resolution 0.1
  stillmap fleet --manifest robots.csv -o out --json
  stillmap fleet --manifest robots.csv -o s3://maps/today --scheduler tcp://head:8786

manifest: CSV with the heading input,place, or JSON: [{"input": ..., "place": ...}, ...]

exit status: 0 all were mapped; 3 some failed, each is named; 2 the call is at fault
"""

import argparse
import json
import os
import shlex
from typing import TYPE_CHECKING

from stillmap.cli.arguments import METHOD, OTHERS, READ, options_from_args
from stillmap.cli.console import fail, print_json, say, show_steps
from stillmap.core.errors import InputError

if TYPE_CHECKING:
    from stillmap.core.profiling import Show
    from stillmap.fleet import Fleet, Request
    from stillmap.fleet.inputs import Entry
    from stillmap.pipeline.options import Options

EXIT_SOME_FAILED = 3
_ALL = "all"  # the place of --merge


FLAGS = f"""
inputs INPUT*  a recording, a folder of recordings, a pattern in quotes; a URL likewise
-o --output DIR!  folder or URL of all results
--manifest FILE  list of recordings, each with its place: CSV or JSON
--merge  all INPUTs are of one place: merge them
--jobs N  recordings at once (default: one per processor)
--scheduler ADDRESS  run on the workers of this Dask scheduler, which share DIR, instead of here
--threads N = 1  of each recording
--json  the content of fleet.json on stdout
{METHOD}{READ}{OTHERS}"""


def run(args: argparse.Namespace) -> int:
    """Map the recordings."""
    from stillmap.fleet import run_fleet

    try:
        with show_steps(args.quiet) as progress:
            fleet = run_fleet(_read_request(args, progress))
    except (KeyboardInterrupt, SystemExit):
        if not args.quiet:
            say(f"continue with the same command: {shlex.join(['stillmap', *args.words])}")
        raise
    if not args.quiet:
        _print_summary(fleet, args.output)
    if args.json:
        print_json(fleet.to_list())
    return EXIT_SOME_FAILED if fleet.failed else 0


def run_command(words: list[str]) -> None:
    """Run a command line of stillmap on a worker.

    Raises:
        InputError: an input is at fault.
    """
    from stillmap.cli.parser import parse

    args = parse(words)
    args.run(args)


def _read_request(args: argparse.Namespace, progress: "Show") -> "Request":
    from stillmap.core.parallel import resolve_threads
    from stillmap.fleet import Request

    if args.poses not in (None, "recording"):
        raise InputError("--poses FILE is for one recording", hint="--poses recording is possible")
    if args.jobs is not None and not 1 <= args.jobs <= 1024:
        raise InputError(f"--jobs must be 1 to 1024, got {args.jobs}")
    if args.jobs is not None and args.scheduler:
        raise InputError("--jobs and --scheduler exclude each other")
    options = _changed_options(options_from_args(args))
    odometry = ["--no-odometry"] if args.no_odometry else []
    poses = ["--poses", "recording"] if args.poses else []
    return Request(
        entries=_read_entries(args),
        output=args.output,
        command=run_command,
        fail=fail,
        progress=progress,
        map_flags=(*options, *odometry, *poses),
        merge_flags=tuple(options),
        jobs=args.jobs or resolve_threads(0),
        scheduler=args.scheduler,
    )


def _read_entries(args: argparse.Namespace) -> "list[Entry]":
    """The recordings that the command line and the manifest name."""
    from stillmap.fleet.inputs import Entry, absolute, read_manifest

    if not args.inputs and not args.manifest:
        raise InputError("names no recording", hint="give INPUTs or --manifest FILE")
    if args.merge and args.manifest:
        raise InputError("--merge is for INPUTs", hint="the manifest names the place of each")
    place = _ALL if args.merge else None
    entries = [Entry(absolute(location), place) for location in args.inputs]
    return [*(read_manifest(args.manifest) if args.manifest else ()), *entries]


def _changed_options(options: "Options") -> list[str]:
    """A flag for every option that is not the default."""
    from stillmap.core.config import iter_options

    flags = []
    for option in iter_options(options):
        value = option.value
        if option.name == "read.cameras" and value is not None:
            value = os.path.abspath(value)
        if value != option.default:
            flags.append(f"--set={option.name}={json.dumps(value, ensure_ascii=False)}")
    return flags


def _print_summary(fleet: "Fleet", output: str) -> None:
    done = sum(job.outcome.is_done for job in fleet.jobs)
    say(f"mapped {done} of {len(fleet.jobs)} recordings")
    if fleet.places:
        merged = sum(place.outcome.is_done for place in fleet.places)
        say(f"merged {merged} of {len(fleet.places)} places")
    say(f"wrote {output}: open {output.rstrip('/')}/fleet.html")
