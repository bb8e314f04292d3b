"""The flags that say how a recording is read, shared by the commands.

Folders that an output is to lie in.

What `stillmap map` wrote, and the recording that it was made from.
"""

import argparse
import json
import math
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core import arrays, config
from stillmap.core.errors import InputError
from stillmap.core.files import read_text, require_regular
from stillmap.core.recording import Recording
from stillmap.eval.readers import Labels, read_labels
from stillmap.io import read, stillmap_folder
from stillmap.io.text_lines import Progress
from stillmap.mesh.options import TextureOptions
from stillmap.preprocessing.options import ReadOptions
from stillmap.results.save import RECORD

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
def parents_made(output: Path) -> Iterator[None]:
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


_MAX_RUN = 32 << 20  # bytes of a run.json


@dataclass(frozen=True)
class Mapped:
    """A result folder.

    Attributes:
        folder: where it lies.
        record: its run.json.
        source: where its recording is.
        given: whether the user said so.
    """

    folder: Path
    record: dict[str, Any]
    source: Path
    given: bool

    @property
    def read_options(self) -> ReadOptions:
        """How its recording was read.

        Raises:
            InputError: the record does not say so.
        """
        return _read_options(self.record, self.folder)

    @property
    def texture_options(self) -> TextureOptions:
        """How its models were painted; the defaults where the record does not say so."""
        chosen: Any = self.record.get("options")
        for name in ("mesh", "texture"):
            chosen = chosen.get(name) if isinstance(chosen, dict) else None
        quality = chosen.get("quality") if isinstance(chosen, dict) else None
        try:
            return TextureOptions() if quality is None else TextureOptions(quality=quality)
        except (ValueError, TypeError) as error:
            where = str(self.folder)
            raise InputError(f"has options that cannot be: {error}", where=where) from error

    def read(
        self, progress: Progress | None = None, scratch: Path | None = None
    ) -> tuple[Recording, Labels]:
        """The recording, as it was read when it was mapped, and its labels.

        Args:
            progress: hears which share of the recording is read.
            scratch: folder for what is too large for memory; None: the system's temporary folder.

        Raises:
            InputError: one of them is not there, or they do not belong together.
        """
        read_as = self.read_options
        if not self.given and not self.source.exists():
            hint = "that is where it was when it was mapped: name it with --input"
            raise InputError("does not exist", where=str(self.source), hint=hint)
        recording = read(self.source, read_as, progress=progress, scratch=scratch)
        labels = read_labels(self.folder)
        if not np.array_equal(recording.stamp_ns, labels.stamp_ns) or not np.array_equal(
            recording.offset, labels.offset
        ):
            raise InputError(
                "is not the recording that was mapped: other scans or beams",
                where=str(self.source),
                hint="name it with --input",
            )
        if any(
            (recording.hit[b] != labels.hit[b]).any()
            for b in arrays.iter_blocks(recording.hit, labels.hit)
        ):
            raise InputError(
                "is not the recording that was mapped: other beams hit something",
                where=str(self.source),
                hint="name it with --input",
            )
        return recording, labels


def is_result(path: Path) -> bool:
    """Whether a folder is a result."""
    return (path / RECORD).is_file()


def is_deskewed(record: dict[str, Any]) -> bool:
    """Whether the motion during scans was taken out, by a run.json."""
    chosen = record.get("options")
    section = chosen.get("slam") if isinstance(chosen, dict) else None
    deskew = section.get("deskew") if isinstance(section, dict) else None
    return deskew is not False


def found(result: Path, given: str | None) -> Mapped:
    """A result folder; its recording is where it says, or where `given` says.

    Raises:
        InputError: it is none, or names no recording.
    """
    record = _run_record(result / RECORD)
    return Mapped(result, record, Path(given or _path_of(record, result)), bool(given))


def require_apart(output: Path, recording: Path, result: Path | None = None) -> None:
    """Refuses to write over what is read, or over a folder that holds it.

    Raises:
        InputError: the output is the recording or the result, or one of them lies inside.
    """
    if recording.name == stillmap_folder.HEADER:
        recording = recording.parent
    there, kept = output.resolve(), [recording.resolve()]
    if there == kept[0]:
        raise InputError("is the recording itself", where=str(output))
    if result is not None:
        kept.append(result.resolve())
    if any(there == one or there in one.parents for one in kept):
        raise InputError("holds the recording or the result", where=str(output))


def _run_record(path: Path) -> dict[str, Any]:
    try:
        require_regular(path)
        record = json.loads(read_text(path, _MAX_RUN))
    except InputError as error:
        hint = "DIR is what `stillmap map` wrote"
        raise InputError(error.what, where=error.where, hint=hint) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not JSON: {error}", where=str(path)) from error
    if not isinstance(record, dict) or not isinstance(record.get("input"), dict):
        raise InputError("is no record of a run: no input named", where=str(path))
    return record


def _read_options(record: dict[str, Any], result: Path) -> ReadOptions:
    """As the recording was read: the same beams have the same numbers."""
    chosen = record.get("options")
    read_as = chosen.get("read") if isinstance(chosen, dict) else None
    if not isinstance(read_as, dict):
        raise InputError("names no options", where=str(result / RECORD))
    known = {key: value for key, value in read_as.items() if value is not None}
    try:
        return config.replaced(ReadOptions(), known)
    except (ValueError, InputError) as error:
        raise InputError(f"has options that cannot be: {error}", where=str(result)) from error


def _path_of(record: dict[str, Any], result: Path) -> str:
    path = record["input"].get("path")
    if not isinstance(path, str) or not path:
        where, hint = str(result / RECORD), "name it with --input"
        raise InputError("names no recording", where=where, hint=hint)
    return path
