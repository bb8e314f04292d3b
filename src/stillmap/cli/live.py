"""Map scan by scan, as a robot would while it drives: each pose and P(static) of each beam follow
from what is known at the time. Alone it is a node in ROS 2, which must be sourced first; Ctrl-C
ends it and writes DIR. With --replay the scans of a recording are pushed as fast as possible,
and the result is the same to the bit every time. DIR has what `stillmap map` writes, of what is
known at the end, and in live/ what was answered at the time. The drive itself is written to
DIR/recording while it lasts: `stillmap map DIR/recording` reads it, whatever has happened.

examples:
  stillmap live --replay log.clf.gz -o out
  stillmap live --replay log.bag -o out --json --quiet
  stillmap live --replay log.bag -o out --rate 1
  stillmap live --replay log.bag -o out --rate 1 --foxglove
  stillmap live --replay tuesday.bag --map monday -o out
  stillmap live -o out --ros-args -p base_frame:=base_link -r scan:=front/scan
"""

import argparse
import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.cli import arguments
from stillmap.cli.console import print_json, say, show_progress, show_share
from stillmap.core.errors import InputError, import_extra

if TYPE_CHECKING:
    from stillmap.live.replay import Show
    from stillmap.pipeline.options import Options


FLAGS = f"""
--replay INPUT  a recording (default: a ROS 2 node that maps until Ctrl-C)
-o --output DIR!  result folder
{arguments.OVERWRITE}
--rate X  push scans at X times the speed of the recording, loops closed beside; a scan that is due
  while earlier ones wait is dropped (default: one after another, the same to the bit every time)
--map DIR  a result or a place in whose map the robot is localized (default: map anew)
--mode {{localise,extend}} = localise  whether the map of --map stays as it is, or grows
--max-scratch GB  disk, about, that the beams of the drive may take: beyond, poses go on, but no
  scan is kept (default: all are)
--foxglove  serve map, scans, pose and path to Foxglove or Lichtblick on this machine, over a
  WebSocket; needs the extra `live`
--host ADDRESS  where --foxglove listens; who reaches it can watch (default: 127.0.0.1)
--port N  port of --foxglove; 0: a free one (default: 8765)
{arguments.NO_ODOMETRY}{arguments.PLACE_MAP}{arguments.RUN}{arguments.READ}{arguments.OTHERS}"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add what a table cannot say."""
    text = "of the node, up to the end"
    p.add_argument("--ros-args", nargs=argparse.REMAINDER, default=[], help=text)


def run(args: argparse.Namespace) -> int:
    """Run the node, or push a recording through the live mapper.

    Raises:
        InputError: ROS is missing, the recording cannot be read or does not suit the map, or the
            output is taken.
    """
    from stillmap.core.files import resolve_output
    from stillmap.live.history import FOLDER
    from stillmap.live.saving import require_place_for_drive

    options = arguments.options_from_args(args)
    output, limit = Path(args.output), args.max_scratch
    if args.rate is not None and not args.rate > 0.0:
        raise InputError(f"--rate: expected a positive number, got {args.rate:g}")
    if limit is not None and not 1e-4 <= limit < math.inf:
        raise InputError(f"--max-scratch: expected at least 0.0001 GB, got {limit:g}")
    require_place_for_drive(output, args.overwrite)
    if args.replay is not None:
        arguments.require_apart(output, Path(args.replay))
    elif args.no_odometry or args.json or args.rate is not None:
        raise InputError("--no-odometry, --rate and --json are for --replay")
    with (
        arguments.make_parents(output),
        tempfile.TemporaryDirectory(prefix="stillmap-") as scratch,
        _serve(args) as show,
    ):
        settings = {
            "place": args.map,
            "mode": args.mode,
            "background": args.replay is None or args.rate is not None,
            "folder": resolve_output(output) / FOLDER,
            "scratch": scratch,
            "max_scratch": None if limit is None else math.ceil(1e9 * limit),
        }
        work = _run_node if args.replay is None else _replay
        return work(args, options, settings, show)


def _replay(
    args: argparse.Namespace, options: "Options", settings: dict[str, Any], show: "Show | None"
) -> int:
    from stillmap.live.mapper import LiveMapper
    from stillmap.live.replay import replay, signal_flag
    from stillmap.pipeline import inputs

    scratch = Path(settings["scratch"])
    with show_share(args.quiet, "reading") as share:
        recording = inputs.read(args.replay, options.read, progress=share, scratch=scratch)
    inputs.require_mappable(recording, options, None)
    if args.no_odometry:
        recording = recording.without_odometry()
    # Ctrl-C ends the drive then, not the command
    stops = args.foxglove or args.rate is not None
    with (
        LiveMapper(options, **settings) as mapper,
        show_progress(args.quiet, 1) as progress,
        signal_flag() if stops else nullcontext() as stop,
    ):
        latency = replay(recording, mapper, progress, args.rate, show, stop)
        has_scans = len(latency.seconds) > 0
        if has_scans:
            mapper.save(args.output, overwrite=args.overwrite, progress=progress)
    if not args.quiet:
        median, p99, most = latency.to_dict()["latency_ms"].values()
        timing = f"{median:.1f} ms each (99 %: {p99:.1f} ms, at most {most:.1f} ms)"
        say(f"{len(latency.seconds)} scans, {timing}")
        say(f"wrote {args.output}" if has_scans else "no scan was mapped: nothing was written")
    if args.json:
        print_json({"output": args.output if has_scans else None, **latency.to_dict()})
    return 0


def _run_node(
    args: argparse.Namespace, options: "Options", settings: dict[str, Any], show: "Show | None"
) -> int:
    """Map until Ctrl-C or SIGTERM, then write the result."""
    from stillmap.live.mapper import LiveMapper
    from stillmap.live.ros.run import run

    scans = run(
        options,
        Path(args.output),
        ["--ros-args", *args.ros_args],
        overwrite=args.overwrite,
        make_mapper=partial(LiveMapper, **settings),
        show_progress=partial(show_progress, args.quiet, 1),
        show=show,
    )
    if not args.quiet:
        say(f"wrote {args.output}" if scans else "no scan arrived: nothing was written")
    return 0


@contextmanager
def _serve(args: argparse.Namespace) -> "Iterator[Show | None]":
    """A function to call with each scan and its update; None without --foxglove."""
    if not args.foxglove:
        if args.host is not None or args.port is not None:
            raise InputError("--host and --port are for --foxglove")
        yield None
        return
    import_extra("foxglove", "the live view", "served", group="live")
    from stillmap.live.foxglove_server import HOST, PORT, FoxgloveServer

    with FoxgloveServer(args.host or HOST, PORT if args.port is None else args.port) as server:
        say(f"seen live at {server.url}, in Foxglove or Lichtblick")
        yield server.show
