"""The flags that say how a recording is read, shared by the commands."""

import argparse
import math
from typing import Any

_PLAIN = (
    *("min_range", "max_range", "zero_means", "spin", "cameras"),
    *("base_frame", "odom_frame"),
)
_LASERS = {"laser": "first", "laser2": "second"}  # flags and options begin with the name


def add_read_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of ranges and of where the lasers sit to a command."""
    group = parser.add_argument_group("reading the recording")
    group.add_argument(
        "--min-range",
        type=float,
        metavar="M",
        help="nearer readings are unusable (the robot) (default: 0)",
    )
    group.add_argument(
        "--max-range",
        type=float,
        metavar="M",
        help="readings at or above M mean that nothing came back (default: found in the readings)",
    )
    group.add_argument(
        "--zero-means",
        choices=("auto", "unusable", "max-range"),
        help="what a reading of zero stands for (default: auto)",
    )
    group.add_argument(
        "--spin",
        choices=("none", "clockwise", "counter-clockwise"),
        help="how a lidar turns, seen from above, whose beams have no times (default: found)",
    )
    group.add_argument(
        "--cameras",
        metavar="FILE.toml",
        help="what the recording lacks of its cameras, and further pictures (docs/input.md)",
    )
    group.add_argument(
        "--topic",
        action="append",
        metavar="TOPIC",
        help="of a bag: take the scans from here; can be given again (default: by type and rate)",
    )
    group.add_argument(
        "--base-frame", metavar="FRAME", help="of a bag: the robot's own frame (default: found)"
    )
    group.add_argument(
        "--odom-frame", metavar="FRAME", help="of a bag: where odometry moves it (default: found)"
    )
    for laser, which in _LASERS.items():
        group.add_argument(
            f"--{laser}-offset",
            type=float,
            nargs=3,
            metavar=("X", "Y", "DEG"),
            help=f"where the {which} laser sits on the robot: m ahead, m left, degrees turned left",
        )
        group.add_argument(
            f"--{laser}-upside-down",
            action="store_true",
            help=f"the {which} laser hangs upside down: its beams turn clockwise",
        )
        group.add_argument(
            f"--{laser}-fov",
            type=float,
            metavar="DEG",
            help=f"field of view of the {which} laser, of FLASER and RLASER lines (default: 180)",
        )


def read_changes(args: argparse.Namespace) -> dict[str, Any]:
    """The flags that were given, as changes to the options: `{"read": {...}}`, `{}` for none."""
    changes: dict[str, Any] = {
        name: value for name in _PLAIN if (value := getattr(args, name)) is not None
    }
    if args.topic:
        changes["topic"] = ",".join(args.topic)
    for laser in _LASERS:
        offset, fov = getattr(args, f"{laser}_offset"), getattr(args, f"{laser}_fov")
        if offset is not None:
            place = (*offset[:2], math.radians(offset[2]))
            changes.update(zip((f"{laser}_x", f"{laser}_y", f"{laser}_theta"), place, strict=True))
        if getattr(args, f"{laser}_upside_down"):
            changes[f"{laser}_upside_down"] = True
        if fov is not None:
            changes[f"{laser}_fov"] = math.radians(fov)
    return {"read": changes} if changes else {}
