"""`stillmap live`: map while scans arrive, from a robot in ROS 2 or from a recording."""

import argparse
import tempfile
import threading
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from stillmap.cli.arguments import add_read_flags, make_parents, read_changes, require_apart
from stillmap.cli.config import add_option_flags, options_from_args
from stillmap.cli.console import print_json, say, show_progress, show_share
from stillmap.cli.live_foxglove import add_foxglove_flags, serve
from stillmap.cli.map_flags import add_map_mode_flag, add_run_flags, shared_changes
from stillmap.core.errors import InputError

if TYPE_CHECKING:
    from stillmap.core.recording import Recording
    from stillmap.live.replay import Latency
    from stillmap.pipeline.options import Options

DESCRIPTION = (
    "Map scan by scan, as a robot would while it drives: each pose and P(static) of each beam "
    "follow from what is known at the time. Alone it is a node in ROS 2, which must be sourced "
    "first; Ctrl-C ends it and writes DIR. With --replay the scans of a recording are pushed as "
    "fast as possible, and the result is the same to the bit every time. DIR has what `stillmap "
    "map` writes, of what is known at the end, and in live/ what was answered at the time."
)
EPILOG = """examples:
  stillmap live --replay log.clf.gz -o out
  stillmap live --replay log.bag -o out --json --quiet
  stillmap live --replay log.bag -o out --rate 1
  stillmap live --replay log.bag -o out --rate 1 --foxglove
  stillmap live --replay tuesday.bag --map monday -o out
  stillmap live --drive /tmp/stillmap-drive-abc -o elsewhere
  stillmap live -o out --ros-args -p base_frame:=base_link -r scan:=front/scan
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the flags and arguments."""
    p.add_argument(
        "--replay",
        metavar="INPUT",
        help="a recording (default: a ROS 2 node that maps until Ctrl-C)",
    )
    p.add_argument(
        "--drive",
        metavar="FOLDER",
        help="write the result of a drive that was kept because its disk was full, and remove "
        "FOLDER; the options are those of the drive",
    )
    p.add_argument("-o", "--output", metavar="DIR", required=True, help="result folder")
    p.add_argument("--overwrite", action="store_true", help="replace what is in DIR")
    p.add_argument(
        "--rate",
        metavar="X",
        type=float,
        help="push scans at X times the speed of the recording, loops closed beside; a scan that "
        "is due while earlier ones wait is dropped (default: one after another, the same to the "
        "bit every time)",
    )
    p.add_argument(
        "--map",
        metavar="DIR",
        help="a result or a place in whose map the robot is localized (default: map anew)",
    )
    p.add_argument(
        "--mode",
        choices=("localise", "extend"),
        default="localise",
        help="whether the map of --map stays as it is, or what is seen is added "
        "(default: localise)",
    )
    p.add_argument(
        "--max-scratch",
        metavar="GB",
        type=float,
        help="disk, about, that the beams of all scans may take in temporary files: beyond, every "
        "second one of the scans that lie most densely is dropped (default: all are kept)",
    )
    p.add_argument("--no-odometry", action="store_true", help="ignore odometry in the recording")
    p.add_argument(
        "--resolution", metavar="M", type=float, help="edge of a map cell in metres (default: 0.05)"
    )
    add_foxglove_flags(p)
    add_map_mode_flag(p)
    add_run_flags(p)
    add_read_flags(p)
    add_option_flags(p)
    p.add_argument(
        "--ros-args", nargs=argparse.REMAINDER, default=[], help="of the node, up to the end"
    )


def run(args: argparse.Namespace) -> int:
    """Run the node, or push a recording through the live mapper.

    Raises:
        InputError: ROS is missing, the recording cannot be read or does not suit the map, or the
            output is taken.
    """
    if args.drive is not None:
        return _save_drive(args)
    if args.replay is None:
        from stillmap.cli.live_node import run_node

        return run_node(args)
    return _replay(args)


def _replay(args: argparse.Namespace) -> int:
    from stillmap.cli.live_node import mapper_settings
    from stillmap.core.files import require_new
    from stillmap.live.last_save import save_last
    from stillmap.live.mapper import LiveMapper
    from stillmap.live.replay import replay
    from stillmap.results.run_json import RECORD

    options = options_from_args(args, read_changes(args), shared_changes(args))
    if args.rate is not None and not args.rate > 0.0:
        raise InputError(f"--rate: expected a positive number, got {args.rate:g}")
    settings, output = mapper_settings(args), Path(args.output)
    require_new(output, RECORD, args.overwrite)
    require_apart(output, Path(args.replay))
    with (
        make_parents(output),
        tempfile.TemporaryDirectory(prefix="stillmap-") as scratch,
        serve(args) as show,
    ):
        recording = _read(args, options, Path(scratch))
        in_background = args.rate is not None
        with (
            LiveMapper(options, **settings, background=in_background, scratch=scratch) as mapper,
            show_progress(args.quiet, 1) as progress,
            _stop_flag(args) as stop,
        ):
            latency = replay(recording, mapper, progress, args.rate, show, stop)
            has_scans = len(latency.seconds) > 0
            if has_scans:
                save_last(mapper.snapshot(), output, overwrite=args.overwrite, progress=progress)
    if not args.quiet:
        say(describe(latency))
        say(f"wrote {output}" if has_scans else "no scan was mapped: nothing was written")
    if args.json:
        print_json({"output": str(output) if has_scans else None, **latency.to_dict()})
    return 0


def _save_drive(args: argparse.Namespace) -> int:
    from stillmap.core.files import require_new
    from stillmap.live.drive_folder import read_drive, remove_drive
    from stillmap.results.run_json import RECORD

    output, folder = Path(args.output), Path(args.drive)
    if args.replay is not None or args.map is not None or args.config or args.assignments:
        raise InputError("--drive excludes --replay, --map, --config and --set")
    require_new(output, RECORD, args.overwrite)
    require_apart(output, folder)
    with make_parents(output), show_progress(args.quiet, 1) as progress:
        read_drive(folder).save(output, overwrite=args.overwrite, progress=progress)
    remove_drive(folder)
    if not args.quiet:
        say(f"wrote {output}, and removed {folder}")
    if args.json:
        print_json({"output": str(output)})
    return 0


def _stop_flag(
    args: argparse.Namespace,
) -> "AbstractContextManager[threading.Event | None]":
    """An event that Ctrl-C sets with --rate or --foxglove: it ends the drive, not the command."""
    from stillmap.live.stopping import signal_flag

    return signal_flag() if args.foxglove or args.rate is not None else nullcontext()


def _read(args: argparse.Namespace, options: "Options", scratch: Path) -> "Recording":
    from stillmap.pipeline import inputs

    with show_share(args.quiet, "reading") as progress:
        recording = inputs.read(args.replay, options.read, progress=progress, scratch=scratch)
    inputs.require_mappable(recording, options, None)
    return recording.without_odometry() if args.no_odometry else recording


def describe(latency: "Latency") -> str:
    """One line about the latencies of a replay."""
    numbers = latency.to_dict()["latency_ms"]
    assert isinstance(numbers, dict)
    median, p99, most = (numbers[name] for name in ("median", "p99", "max"))
    count = len(latency.seconds)
    return f"{count} scans, {median:.1f} ms each (99 %: {p99:.1f} ms, at most {most:.1f} ms)"
