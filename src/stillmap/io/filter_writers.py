"""Formats in which a recording is written again with beams blanked: its own, or another one.

In its own format all that is not a blanked beam stays as it was; another one is written by a writer
of `writers.py`.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stillmap.core import arrays
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.errors import InputError
from stillmap.core.files import workplace
from stillmap.core.recording import Recording
from stillmap.io import stillmap_folder, writers
from stillmap.io.filtered_clouds import (
    FilterJob,
    Omissions,
    filter_pcd,
    filter_ply,
    write_files,
    write_kitti,
    write_las,
)
from stillmap.io.point_cloud import pcd, ply
from stillmap.io.registry import FORMATS, detect_format, load_later
from stillmap.io.ros.messages import detect_kind

Write = Callable[[FilterJob], Omissions]

_ROS2 = ("ros2", "db3", "mcap")  # kinds of bags that hold the same messages
_OF_RANGES = ("stillmap", "carmen", "ros2", "bag", "db3", "mcap")  # they hold misses of 2D lasers


class FilterTarget(NamedTuple):
    """Writer of a filtered recording.

    Attributes:
        write: writes it.
        marker: see FilterJob.
        writer: of another format than the recording's own; None: its own.
    """

    write: Write
    marker: str
    writer: writers.Writer | None = None

    @property
    def takes_poses(self) -> bool:
        """True of formats of points at poses: those of the map, where none are recorded."""
        if self.writer is None or self.writer.name == "stillmap":
            return False
        return "T_recorded_base" in self.writer.fields


def _write_stillmap(job: FilterJob) -> Omissions:
    recording = _to_misses(job)
    folder = job.source if job.source.is_dir() else job.source.parent
    if not stillmap_folder.has_beam_times(folder):  # times that were estimated stay out
        source = replace(recording.source, spin=None)
        recording = replace(recording, beam_time=None, source=source)
    stillmap_folder.write(recording, job.output, overwrite=job.overwrite)
    return Omissions()


# by format: its name in `writers.py`, pattern of a file that every such folder holds, writer
_OWN: dict[str, tuple[str, str, Write]] = {
    "stillmap recording": ("stillmap", stillmap_folder.HEADER, _write_stillmap),
    "ROS bag": ("", "metadata.yaml", load_later("ros.filtered", "write_filtered")),
    "CARMEN log": ("carmen", "", load_later("carmen.writer", "write_filtered")),
    "KITTI folder": ("kitti", "velodyne*", write_kitti),
    "PCD": ("pcd", "*.[pP][cC][dD]", partial(write_files, filter_pcd, pcd.EXTENSIONS)),
    "PLY": ("ply", "*.[pP][lL][yY]", partial(write_files, filter_ply, ply.EXTENSIONS)),
    "LAS": ("las", "*.[lL][aA][sSzZ]", write_las),
}


def find_target(source: Path | None, output: Path, name: str | None = None) -> FilterTarget:
    """Find how a filtered recording is written.

    Args:
        source: the recording; None: it is joined from parts, and written as a recording folder
            unless another format is named.
        output: its filtered copy, of the recording's own format unless its ending is that of
            another one. A format that is not written comes back as a folder of PCD files.
        name: of the format, as in `writers.py`; None: by the output's ending.

    Raises:
        InputError: there is no such format, or the recording cannot be written so.
    """
    if source is None:
        return _convert_to(writers.find_writer(output, name))
    form, given = detect_format(source), name or writers.format_of_ending(output)
    own, marker, write = _OWN.get(form.name, ("", "", _write_stillmap))
    own = detect_kind(source)[0] if form.name == "ROS bag" else own
    is_folder = _is_folder(source)
    writer = None if given is None else writers.find_writer(output, given)
    if writer is None and form.name != "CARMEN log":
        _require_ending(output, () if is_folder or not own else form.endings)
    if not own:
        note = f"a recording of the format {form.name} is not written again: it comes back as "
        return _convert_to(writer or writers.find_writer(output, "pcd"), note)
    if writer is not None and own in _ROS2 and writer.name in _ROS2:
        own, is_folder = writer.name, bool(writer.marker)
    elif writer is not None and (writer.name != own or bool(writer.marker) != is_folder):
        return _convert_to(writer)
    return FilterTarget(lambda job: write(replace(job, kind=own)), marker if is_folder else "")


def _convert_to(writer: writers.Writer, note: str = "") -> FilterTarget:
    """The target that another format than the recording's own is."""
    return FilterTarget(partial(_convert, writer=writer, note=note), writer.marker, writer)


def _is_folder(source: Path) -> bool:
    return source.is_dir() or source.name == stillmap_folder.HEADER


def _require_ending(output: Path, endings: tuple[str, ...]) -> None:
    """Refuse a name that ends as those of files of a format which would not be written.

    Raises:
        InputError: it does, and has none of the `endings`.
    """
    name = output.name.lower()
    known = (end for form in FORMATS for end in form.endings if end.startswith("."))
    if name.endswith(tuple(known)) and not name.endswith(endings or "/"):
        hint = f"other formats by name: {writers.ENDINGS}; or by name=FORMAT"
        raise InputError("is not written in the format of that name", where=str(output), hint=hint)


def require_outside(output: Path, source: Path) -> None:
    """Refuse an output that lies in the folder of the recording.

    Raises:
        InputError: it does.
    """
    if source.is_dir() and source.resolve() in output.resolve().parents:
        hint = "choose a place outside of it"
        raise InputError("lies in the folder of the recording", where=str(output), hint=hint)


def _convert(job: FilterJob, writer: writers.Writer, note: str) -> Omissions:
    """Write the recording without the blanked beams in another format."""
    if writer.name == "stillmap" or (job.recording.dimension == 2 and writer.name in _OF_RANGES):
        recording = _to_misses(job)
    else:
        recording = _without_beams(job)
    losses = writers.write(recording, job.output, name=writer.name, overwrite=job.overwrite)
    notes = [*([note + writer.description] if note else []), *losses]
    return Omissions(job.recording.source.n_skipped, tuple(notes))


def _to_misses(job: FilterJob) -> Recording:
    """The recording with blanked beams as misses of the same length."""
    hit = arrays.copy(job.recording.hit, workplace(job.output))
    for block in arrays.iter_blocks(hit, job.blank):
        hit[block] &= ~job.blank[block]
    return replace(job.recording, hit=hit)


def _without_beams(job: FilterJob) -> Recording:
    """The recording without the blanked beams."""
    recording, blank = job.recording, job.blank
    length = np.zeros(recording.n_scans + 1, np.int64)
    for scan in recording.iter_scans(range(recording.n_scans), blank):
        length[scan + 1] = np.count_nonzero(~blank[recording.beams_of(scan)])
    kept: dict[str, Any] = {"offset": np.cumsum(length)}
    for name in ("points", "hit", "beam_time"):
        column = getattr(recording, name)
        if column is not None:
            builder = ArrayBuilder(column.dtype, column.shape[1:], workplace(job.output))
            for block in arrays.iter_blocks(column, blank):
                builder.append(column[block][~blank[block]])
            kept[name] = builder.finish()
    return replace(recording, **kept)


def find_ending(source: Path | None, to: str | None) -> str:
    """The ending of a recording's own format, or of another one; "" of folders.

    Args:
        source: the recording; None: it is joined from parts.
        to: name of the other format; None: its own.
    """
    own = ""
    if source is not None and not _is_folder(source) and detect_format(source).name in _OWN:
        own = "".join(source.suffixes[-2 if source.suffix.lower() == ".gz" else -1 :])
    if to is None:
        return own
    endings = writers.find_writer(Path(), to).endings
    return own if own in endings else next(iter(endings), "")
