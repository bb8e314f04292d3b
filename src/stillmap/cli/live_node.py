"""`stillmap live` without --replay: the ROS 2 node."""

import argparse
import math
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from stillmap.cli.arguments import make_parents, read_changes
from stillmap.cli.config import options_from_args
from stillmap.cli.console import say, show_progress
from stillmap.cli.live_foxglove import serve
from stillmap.cli.map_flags import shared_changes
from stillmap.core.errors import InputError


def run_node(args: argparse.Namespace) -> int:
    """Map until Ctrl-C or SIGTERM, then write the result.

    Raises:
        InputError: ROS 2 is missing, a parameter is wrong, or the output is taken.
    """
    from stillmap.core.files import require_new
    from stillmap.live.mapper import LiveMapper
    from stillmap.live.ros.run import run
    from stillmap.results.run_json import RECORD

    options = options_from_args(args, read_changes(args), shared_changes(args))
    output = Path(args.output)
    require_new(output, RECORD, args.overwrite)
    if args.no_odometry or args.json or args.rate is not None:
        raise InputError("--no-odometry, --rate and --json are for --replay")
    with (
        make_parents(output),
        tempfile.TemporaryDirectory(prefix="stillmap-") as scratch,
        serve(args) as show,
    ):
        scans = run(
            options,
            output,
            ["--ros-args", *args.ros_args],
            overwrite=args.overwrite,
            make_mapper=partial(
                LiveMapper, **mapper_settings(args), background=True, scratch=scratch
            ),
            show_progress=partial(show_progress, args.quiet, 1),
            show=show,
        )
    if not args.quiet:
        say(f"wrote {output}" if scans else "no scan arrived: nothing was written")
    return 0


def mapper_settings(args: argparse.Namespace) -> dict[str, Any]:
    """Arguments of the mapper that do not depend on where the scans come from.

    Raises:
        InputError: the bound is none.
    """
    limit = args.max_scratch
    if limit is not None and not 1e-4 <= limit < math.inf:
        raise InputError(f"--max-scratch: expected at least 0.0001 GB, got {limit:g}")
    max_scratch = None if limit is None else math.ceil(1e9 * limit)
    return {"place": args.map, "mode": args.mode, "max_scratch": max_scratch}
