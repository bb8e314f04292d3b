"""Arguments shared by the commands: flags for reading a recording, checks of output paths."""

import argparse
import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.core.errors import InputError, cannot_write

if TYPE_CHECKING:
    from stillmap.prepare.options import ReadOptions

_FLAGS = (
    *("min_range", "max_range", "zero_means", "spin", "cameras", "start", "end"),
    *("base_frame", "odom_frame"),
)

_LASERS = {"laser": "first", "laser2": "second"}  # flags and options begin with the name


def add_read_flags(
    parser: argparse.ArgumentParser, end_flags: tuple[str, ...] = ("--to", "--until")
) -> None:
    """Add the flags for reading a recording to a command; `end_flags` name the end of its part."""
    group = parser.add_argument_group("reading the recording")
    group.add_argument(
        "--min-range",
        type=float,
        metavar="M",
        help="shorter readings are unusable, say from the robot itself (default: 0)",
    )
    group.add_argument(
        "--max-range",
        type=float,
        metavar="M",
        help="readings of M and more are maximum-range beams (default: estimated)",
    )
    group.add_argument(
        "--zero-means",
        choices=("auto", "unusable", "max-range"),
        help="meaning of a reading of zero (default: auto)",
    )
    group.add_argument(
        "--spin",
        choices=("none", "clockwise", "counter-clockwise"),
        help="rotation of a lidar without beam times, seen from above (default: estimated)",
    )
    group.add_argument(
        "--cameras",
        metavar="FILE.toml",
        help="calibration and images that the recording lacks (docs/input.md)",
    )
    group.add_argument(
        "--topic",
        action="append",
        metavar="TOPIC",
        help="scans of a bag; can be given again (default: by type and rate)",
    )
    group.add_argument(
        "--base-frame", metavar="FRAME", help="robot frame of a bag (default: detected)"
    )
    group.add_argument(
        "--odom-frame", metavar="FRAME", help="odometry frame of a bag (default: detected)"
    )
    _add_time_flags(group, end_flags)
    _add_laser_flags(group)


def _add_laser_flags(group: argparse._ArgumentGroup) -> None:
    for laser, which in _LASERS.items():
        group.add_argument(
            f"--{laser}-offset",
            type=float,
            nargs=3,
            metavar=("X", "Y", "DEG"),
            help=f"pose of the {which} laser on the robot: m ahead, m left, degrees to the left",
        )
        group.add_argument(
            f"--{laser}-upside-down",
            action="store_true",
            help=f"the {which} laser is mounted upside down: its beams turn clockwise",
        )
        group.add_argument(
            f"--{laser}-fov",
            type=float,
            metavar="DEG",
            help=f"field of view of the {which} laser in FLASER and RLASER lines (default: 180)",
        )


def _add_time_flags(group: argparse._ArgumentGroup, end_flags: tuple[str, ...]) -> None:
    group.add_argument(
        "--from",
        dest="start",
        type=_parse_seconds,
        metavar="S",
        help="leave out scans before S: seconds from the first scan, from 1e8 on a stamp",
    )
    group.add_argument(
        *end_flags,
        dest="end",
        type=_parse_seconds,
        metavar="S",
        help="leave out scans after S, likewise",
    )


def _parse_seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0.0 <= seconds < math.inf:
        raise argparse.ArgumentTypeError(f"wants seconds from 0 on, got '{text}'")
    return seconds


def read_changes(args: argparse.Namespace) -> dict[str, Any]:
    """The given flags as changes of options: `{"read": {...}}`, `{}` for none."""
    changes: dict[str, Any] = {
        name: value for name in _FLAGS if (value := getattr(args, name)) is not None
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


def read_options(args: argparse.Namespace) -> "ReadOptions":
    """The options of reading by the given flags."""
    from stillmap.core.config import override
    from stillmap.prepare.options import ReadOptions

    return override(ReadOptions(), read_changes(args).get("read", {}))


@contextmanager
def make_parents(output: Path) -> Iterator[None]:
    """Create the parent folders of an output; remove them again if the block fails.

    Raises:
        InputError: they cannot be created, or the output cannot be written there; before anything
            is read.
    """
    from stillmap.core.files import resolve_output, temporary_folder

    parent = resolve_output(output).parent
    created: list[Path] = []
    try:
        try:
            for folder in reversed((parent, *parent.parents)):
                if not folder.exists():
                    created.append(folder)  # an interruption right after it was made finds it
                    folder.mkdir(exist_ok=True)
            # the writer reports a device at this path
            if not output.exists() or output.is_file() or output.is_dir():
                with temporary_folder(output):
                    pass
        except OSError as error:
            raise cannot_write(error, output) from error
        yield
    except BaseException:
        with suppress(OSError):  # not empty
            for folder in reversed(created):
                folder.rmdir()
        raise


def require_apart(output: Path, recording: Path, result: Path | None = None) -> None:
    """Refuse to overwrite what is read, or a folder that holds it.

    Raises:
        InputError: the output is the recording or the result, or one of them lies inside.
    """
    from stillmap.io import stillmap_folder

    if recording.name == stillmap_folder.HEADER:
        recording = recording.parent
    target, inputs = output.resolve(), [recording.resolve()]
    if target == inputs[0]:
        raise InputError("is the recording itself", where=str(output))
    if result is not None:
        inputs.append(result.resolve())
    if any(target == path or target in path.parents for path in inputs):
        raise InputError("holds the recording or the result", where=str(output))
