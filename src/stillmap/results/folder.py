"""A result folder opened again: its `run.json`, its recording and its labels."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core import arrays, config
from stillmap.core.errors import InputError
from stillmap.core.files import read_text, require_regular
from stillmap.core.recording import Recording
from stillmap.io import read
from stillmap.io.text_lines import Progress
from stillmap.mesh.options import MeshOptions
from stillmap.preprocessing.options import ReadOptions
from stillmap.results.labels import Labels, read_labels
from stillmap.results.run_json import RECORD

_MAX_RUN = 32 << 20  # bytes of a run.json


@dataclass(frozen=True)
class ResultFolder:
    """A result folder.

    Attributes:
        folder: where it lies.
        record: its run.json.
        source: where its recording is.
        source_given: whether the user named the recording.
    """

    folder: Path
    record: dict[str, Any]
    source: Path
    source_given: bool

    @property
    def read_options(self) -> ReadOptions:
        """The options with which its recording was read.

        Raises:
            InputError: the record does not say so.
        """
        return _read_options(self.record, self.folder)

    @property
    def texture_quality(self) -> int:
        """JPEG quality of the texture pages; the default where the record does not have it."""
        options: Any = self.record.get("options")
        mesh = options.get("mesh") if isinstance(options, dict) else None
        quality = mesh.get("texture_quality") if isinstance(mesh, dict) else None
        try:
            return (
                MeshOptions() if quality is None else MeshOptions(texture_quality=quality)
            ).texture_quality
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
        if not self.source_given and not self.source.exists():
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
    """Whether scans were deskewed, by a run.json."""
    chosen = record.get("options")
    section = chosen.get("slam") if isinstance(chosen, dict) else None
    deskew = section.get("deskew") if isinstance(section, dict) else None
    return deskew is not False


def open_result(result: Path, recording: str | None = None) -> ResultFolder:
    """A result folder; its recording is where `run.json` says, or at the path `recording`.

    Raises:
        InputError: it is none, or names no recording.
    """
    record = _run_record(result / RECORD)
    return ResultFolder(
        result, record, Path(recording or _path_of(record, result)), bool(recording)
    )


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
        return config.override(ReadOptions(), known)
    except (ValueError, InputError) as error:
        raise InputError(f"has options that cannot be: {error}", where=str(result)) from error


def _path_of(record: dict[str, Any], result: Path) -> str:
    path = record["input"].get("path")
    if not isinstance(path, str) or not path:
        where, hint = str(result / RECORD), "name it with --input"
        raise InputError("names no recording", where=where, hint=hint)
    return path
