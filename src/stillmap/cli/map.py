"""`stillmap map`: the main job, recording in, folder out."""

import argparse
from typing import Any

from stillmap.cli.commands import COMMANDS
from stillmap.cli.options import add_option_flags
from stillmap.cli.reading import add_read_flags
from stillmap.errors import InputError

_EPILOG = """examples:
  stillmap map log.clf.gz -o out
  stillmap map sim -o out --overwrite --resolution 0.1
  stillmap map log.clf.gz -o out --min-range 0.3 --set em.max_iterations=3
  stillmap map log.clf.gz -o out --poses poses.tum --config options.toml
  stillmap map log.bag -o out --resume
  stillmap map sim/horizontal -o out --tilting sim/tilting
  stillmap map log.clf.gz -o out --quiet --json
"""


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    p = commands.add_parser(
        "map",
        help=COMMANDS["map"],
        description="Map a recording: find out for every beam how likely it hit something that "
        "stands still, where the robot was at every scan, and what the map is without what moves. "
        "The result is a folder; open it with `stillmap view`.",
        epilog=_EPILOG,
    )
    p.add_argument(
        "input",
        metavar="INPUT",
        help="a CARMEN log, a ROS bag, a stillmap recording folder, ...: see docs/input.md",
    )
    p.add_argument(
        "--tilting",
        metavar="RECORDING",
        help="of the same robot and time, a laser that tilts or pans, in 3D: INPUT, which lies "
        "flat, tells what moves in it (docs/rig.md)",
    )
    p.add_argument(
        "--tilting-topic",
        metavar="TOPIC",
        help="the same, of scans in the bag INPUT, whose transforms say how their laser moves",
    )
    p.add_argument("-o", "--output", metavar="DIR", required=True, help="where the result goes")
    p.add_argument("--overwrite", action="store_true", help="replace what is in DIR")
    p.add_argument(
        "--resume", action="store_true", help="go on where an interrupted run of the same stopped"
    )
    p.add_argument(
        "--threads", metavar="N", type=int, help="0: one per processor; same result (default: 0)"
    )
    p.add_argument("--json", action="store_true", help="a summary as one JSON object on stdout")
    p.add_argument("--quiet", action="store_true", help="no progress, no summary")
    _add_method_flags(p.add_argument_group("method"))
    _add_map_flags(p.add_argument_group("map"))
    add_read_flags(p)
    add_option_flags(p)
    p.set_defaults(run=run)


def _add_method_flags(p: argparse._ArgumentGroup) -> None:
    p.add_argument("--paper", action="store_true", help="the method exactly as printed")
    p.add_argument(
        "--estimator",
        choices=("stillmap", "paper", "hit-ratio", "tracker"),
        help="what says which beams are static (default: stillmap)",
    )
    p.add_argument(
        "--poses",
        metavar="FILE.tum",
        help="keep these poses, estimate the rest; `recording`: those that the recording states",
    )
    p.add_argument("--no-odometry", action="store_true", help="ignore odometry in the recording")


def _add_map_flags(p: argparse._ArgumentGroup) -> None:
    p.add_argument(
        "--resolution",
        metavar="M",
        type=float,
        help="edge of a map cell in metres (default: 0.05); of a voxel in 3D (0.15, of depth "
        "cameras 0.05)",
    )
    p.add_argument(
        "--map-mode",
        choices=("trinary", "scale", "raw"),
        help="pixels of map.pgm (default: trinary)",
    )
    p.add_argument(
        "--map-state",
        choices=("last", "majority"),
        help="which state of places that changed (default: last)",
    )


def run(args: argparse.Namespace) -> int:
    """Reads, maps, writes, says what came of it."""
    from stillmap.cli.mapping import mapped  # takes long to load

    return mapped(args, _changes(args))


def _changes(args: argparse.Namespace) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    if args.paper and args.estimator not in (None, "paper"):
        raise InputError(f"--paper and --estimator {args.estimator} exclude each other")
    if args.paper or args.estimator:
        changes["estimator"] = "paper" if args.paper else args.estimator
    if args.threads is not None:
        changes["threads"] = args.threads
    if args.resolution is not None:
        changes["slam"] = {"resolution": args.resolution, "voxel": args.resolution}
    if args.tilting_topic is not None:
        changes["read"] = {"tilting_topic": args.tilting_topic}
    output = {"map_mode": args.map_mode, "map_state": args.map_state}
    if chosen := {name: value for name, value in output.items() if value}:
        changes["output"] = chosen
    return changes
