"""The flags that say how a recording is read, shared by the commands.

Folders that an output is to lie in.

What `stillmap map` wrote, and the recording that it was made from.
"""

import argparse
import math
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from stillmap.core.errors import InputError

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


@contextmanager
def make_parents(output: Path) -> Iterator[None]:
    """Makes the folders above an output that are not there; they go again where the block fails.

    Raises:
        InputError: they cannot be made, or nothing can be written there. Nothing was read yet.
    """
    parent = Path(os.path.abspath(output)).parent
    made: list[Path] = []
    try:
        try:
            for folder in reversed((parent, *parent.parents)):
                if not folder.exists():
                    folder.mkdir(exist_ok=True)
                    made.append(folder)
            # a device in the way is told of by who writes
            if not output.exists() or output.is_file() or output.is_dir():
                tempfile.TemporaryFile(dir=parent).close()
        except OSError as error:
            what = f"cannot be written: {error.strerror or error}"
            raise InputError(what, where=str(output)) from error
        yield
    except BaseException:
        with suppress(OSError):  # something may lie in them by now
            for folder in reversed(made):
                folder.rmdir()
        raise


def require_apart(output: Path, recording: Path, result: Path | None = None) -> None:
    """Refuses to write over what is read, or over a folder that holds it.

    Raises:
        InputError: the output is the recording or the result, or one of them lies inside.
    """
    from stillmap.io import stillmap_folder

    if recording.name == stillmap_folder.HEADER:
        recording = recording.parent
    there, kept = output.resolve(), [recording.resolve()]
    if there == kept[0]:
        raise InputError("is the recording itself", where=str(output))
    if result is not None:
        kept.append(result.resolve())
    if any(there == one or there in one.parents for one in kept):
        raise InputError("holds the recording or the result", where=str(output))
