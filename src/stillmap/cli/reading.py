"""The flags that say how a recording is read, shared by the commands."""

import argparse
import math
from typing import Any


def add_read_flags(parser: argparse.ArgumentParser) -> None:
    """Add --min-range, --max-range, --zero-means and --laser-offset to a command."""
    group = parser.add_argument_group("reading the recording")
    group.add_argument(
        "--min-range", type=float, metavar="M", help="nearer readings are unusable (the robot)"
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
        "--laser-offset",
        type=float,
        nargs=3,
        metavar=("X", "Y", "DEG"),
        help="where the first laser sits on the robot: m ahead, m left, degrees turned left",
    )


def read_changes(args: argparse.Namespace) -> dict[str, Any]:
    """The flags that were given, as changes to the options: `{"read": {...}}`, `{}` for none."""
    changes: dict[str, Any] = {
        name: value
        for name in ("min_range", "max_range", "zero_means")
        if (value := getattr(args, name)) is not None
    }
    if args.laser_offset is not None:
        x, y, degrees = args.laser_offset
        changes.update(laser_x=x, laser_y=y, laser_theta=math.radians(degrees))
    return {"read": changes} if changes else {}
