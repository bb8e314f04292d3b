"""Flags of mapping, shared by `map`, `merge` and `fleet`, and the options that they set."""

import argparse
from typing import Any

from stillmap.core.errors import InputError


def add_run_flags(p: argparse.ArgumentParser) -> None:
    """Add the flags of how the command itself runs and what it prints."""
    p.add_argument(
        "--threads", metavar="N", type=int, help="0: one per processor; same result (default: 0)"
    )
    p.add_argument("--json", action="store_true", help="a summary as one JSON object on stdout")
    p.add_argument("--quiet", action="store_true", help="no progress, no summary")


def require_memory_flag(gigabytes: float) -> None:
    """Refuse a value of `--memory` that is no amount of memory."""
    if not 0.0 < gigabytes < 1e9:
        raise InputError(f"--memory must be a positive number of GB, got {gigabytes:g}")


def add_method_flags(p: argparse._ArgumentGroup) -> None:
    """Add the flags that choose how poses and labels are estimated."""
    p.add_argument("--paper", action="store_true", help="the method exactly as printed")
    p.add_argument(
        "--estimator",
        choices=("stillmap", "paper", "hit-ratio", "tracker"),
        help="how beams are labelled (default: stillmap)",
    )
    p.add_argument(
        "--poses",
        metavar="FILE.tum",
        help="keep these poses; `recording`: the poses stored in the recording",
    )
    p.add_argument("--no-odometry", action="store_true", help="ignore odometry in the recording")


def add_map_mode_flag(p: argparse._ActionsContainer) -> None:
    """Add the flag of how the map image is written."""
    p.add_argument(
        "--map-mode",
        choices=("trinary", "scale", "raw"),
        help="pixels of map.pgm (default: trinary)",
    )


def add_map_flags(p: argparse._ArgumentGroup) -> None:
    """Add the flags of the map that is written."""
    p.add_argument(
        "--mesh",
        action=argparse.BooleanOptionalAction,
        help="surface and models of 3D recordings (default: where there are pictures)",
    )
    p.add_argument(
        "--resolution",
        metavar="M",
        type=float,
        help="edge of a map cell in metres (default: 0.05); of a voxel in 3D (0.15, of depth "
        "cameras 0.05)",
    )
    add_map_mode_flag(p)
    p.add_argument(
        "--region",
        type=float,
        nargs=4,
        metavar=("X0", "Y0", "X1", "Y1"),
        help="write this part of the map frame alone, in metres; poses are of all scans",
    )
    p.add_argument(
        "--map-state",
        choices=("last", "majority", "open", "shut"),
        help="state of changed places (default: last); open or shut: that of doors",
    )


def option_changes(args: argparse.Namespace) -> dict[str, Any]:
    """The options that the flags of `map` set."""
    changes = shared_changes(args)
    if args.paper and args.estimator not in (None, "paper"):
        raise InputError(f"--paper and --estimator {args.estimator} exclude each other")
    if args.paper or args.estimator:
        changes["estimator"] = "paper" if args.paper else args.estimator
    if args.mesh is not None:
        changes["mesh"] = {"enabled": args.mesh}
    if args.tilting_topic is not None:
        changes["read"] = {"tilting_topic": args.tilting_topic}
    output = {"map_state": args.map_state, "region": args.region}
    if chosen := {name: value for name, value in output.items() if value}:
        changes["output"] = changes.get("output", {}) | chosen
    return changes


def shared_changes(args: argparse.Namespace) -> dict[str, Any]:
    """The options that the flags of both `map` and `merge` set."""
    changes: dict[str, Any] = {}
    if args.threads is not None:
        changes["threads"] = args.threads
    if args.resolution is not None:
        changes["slam"] = {"resolution": args.resolution, "voxel_size": args.resolution}
    if args.map_mode is not None:
        changes["output"] = {"map_mode": args.map_mode}
    return changes
