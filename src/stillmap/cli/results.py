"""What `stillmap map` wrote, and the recording that it was made from."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stillmap import options
from stillmap.errors import InputError
from stillmap.evaluation.folders import Labels, read_labels
from stillmap.output.run_json import RECORD
from stillmap.recording import Recording, folder, read, spool
from stillmap.recording.lines import Progress
from stillmap.recording.options import ReadOptions
from stillmap.texts import read_text, require_regular
from stillmap.texture.options import TextureOptions

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
            for b in spool.blocks(recording.hit, labels.hit)
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
    if recording.name == folder.HEADER:
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
        return options.replaced(ReadOptions(), known)
    except (ValueError, InputError) as error:
        raise InputError(f"has options that cannot be: {error}", where=str(result)) from error


def _path_of(record: dict[str, Any], result: Path) -> str:
    path = record["input"].get("path")
    if not isinstance(path, str) or not path:
        where, hint = str(result / RECORD), "name it with --input"
        raise InputError("names no recording", where=where, hint=hint)
    return path
