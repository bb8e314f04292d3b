"""The table of formats that are written again with beams blanked (`FILTER_WRITERS`).

A recording is written in its own format with all that is not a blanked beam as it was, or in
another one by a writer of `writers.py`.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stillmap.core import arrays
from stillmap.core.arrays import ArrayBuilder
from stillmap.core.errors import InputError
from stillmap.core.files import require_new, require_new_file, workplace
from stillmap.core.json import count_skipped
from stillmap.core.recording import Recording
from stillmap.io import stillmap_folder, writers
from stillmap.io.filtered_copy import FilterJob, Mask, Omissions
from stillmap.io.point_cloud import signatures
from stillmap.io.registry import FORMATS, Format, detect_format
from stillmap.io.ros.messages import detect_kind
from stillmap.prepare.beam_times import SPIN_KEY

Write = Callable[[FilterJob], Omissions]

_ROS2 = ("ros2", "db3", "mcap")  # kinds of bags that hold the same messages
_OF_RANGES = ("stillmap", "carmen", "ros2", "bag", "db3", "mcap")  # they hold misses of 2D lasers


class FilterWriter(NamedTuple):
    """A format that is written again.

    Attributes:
        write: writes the copy.
        markers: patterns of files, one of which every folder of the format holds.
        check: refuses a recording that cannot be written to a path, before it is read.
    """

    write: Write
    markers: tuple[str, ...] = ()
    check: Callable[[Path, Path], None] = lambda source, output: None  # noqa: ARG005


class FilterTarget(NamedTuple):
    """Format and writer of a filtered recording.

    Attributes:
        description: of the format, in words.
        marker: see FilterJob.
        is_folder: whether it is a folder.
        write: writes it.
        writer: of another format than the recording's own; None: its own.
    """

    description: str
    marker: str
    is_folder: bool
    write: Write
    writer: writers.Writer | None

    @property
    def takes_poses(self) -> bool:
        """True of formats of points at poses: those of the map, where none are recorded."""
        if self.writer is None or self.writer.name == "stillmap":
            return False
        return "T_recorded_base" in self.writer.fields


def _writer(module: str, function: str = "write_filtered") -> Write:
    """A function of a module of this room, which is loaded when it is called."""

    def write(job: FilterJob) -> Omissions:
        omissions: Omissions = getattr(import_module(f"stillmap.io.{module}"), function)(job)
        return omissions

    return write


def _write_stillmap(job: FilterJob) -> Omissions:
    recording = _to_misses(job)
    folder = job.source if job.source.is_dir() else job.source.parent
    if not stillmap_folder.has_beam_times(folder):  # times that were estimated stay out
        source = {key: value for key, value in recording.source.items() if key != SPIN_KEY}
        recording = replace(recording, beam_time=None, source=source)
    stillmap_folder.write(recording, job.output, overwrite=job.overwrite)
    return Omissions()


def _check_depth(source: Path, output: Path) -> None:  # noqa: ARG001
    from stillmap.io import filtered_depth

    filtered_depth.check(source)


def _check_e57(source: Path, output: Path) -> None:  # noqa: ARG001
    from stillmap.io.point_cloud.filtered import e57

    e57.check(source)


def _check_las(source: Path, output: Path) -> None:
    ending = source.suffix.lower()
    if source.is_file() and output.suffix.lower() not in (ending, ""):
        hint = f"name it {output.stem}{ending}: `laszip` packs and unpacks such files"
        raise InputError("a LAS file is not packed or unpacked", where=str(output), hint=hint)


def _patterns(extensions: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"*{case}" for one in extensions for case in (one, one.upper()))


_KITTI_MARKERS = ("velodyne", "velodyne_points")
_RGBD_MARKERS = ("depth.txt", "frame-*.depth.*")

FILTER_WRITERS = {
    "stillmap recording": FilterWriter(_write_stillmap, (stillmap_folder.HEADER,)),
    "ROS bag": FilterWriter(_writer("ros.filtered"), ("metadata.yaml",)),
    "KITTI folder": FilterWriter(_writer("point_cloud.filtered.kitti"), _KITTI_MARKERS),
    "RGB-D folder": FilterWriter(_writer("filtered_depth"), _RGBD_MARKERS, _check_depth),
    "PCD": FilterWriter(_writer("point_cloud.filtered.pcd"), _patterns(signatures.PCD_EXTENSIONS)),
    "3DTK": FilterWriter(
        _writer("point_cloud.filtered.threedtk"), _patterns(signatures.THREEDTK_EXTENSIONS)
    ),
    "E57": FilterWriter(
        _writer("point_cloud.filtered.e57"), _patterns(signatures.E57_EXTENSIONS), _check_e57
    ),
    "LAS": FilterWriter(
        _writer("point_cloud.filtered.las"), _patterns(signatures.LAS_EXTENSIONS), _check_las
    ),
    "PLY": FilterWriter(_writer("point_cloud.filtered.ply"), _patterns(signatures.PLY_EXTENSIONS)),
    "CARMEN log": FilterWriter(_writer("carmen.writer")),
}


def find_target(source: Path, output: Path, name: str | None = None) -> FilterTarget:
    """Find how a filtered recording is written.

    Args:
        source: the recording.
        output: its filtered copy, of the recording's own format unless its ending is that of
            another one.
        name: of the format, as in `writers.py`; None: by the output's ending.

    Raises:
        InputError: there is no such format, or the recording cannot be written again.
    """
    form = detect_format(source).name
    own = _own_writer_name(source, form)
    wanted = name or writers.format_of_ending(output)
    is_folder = source.is_dir() or source.name == stillmap_folder.HEADER
    if wanted is not None:
        writer = writers.find_writer(output, wanted)
        if own in _ROS2 and writer.name in _ROS2:
            return _own_target(source, output, form, bool(writer.marker), writer.name)
        if writer.name != own or bool(writer.marker) != is_folder:
            write = partial(_convert, writer=writer)
            folder = bool(writer.marker)
            return FilterTarget(writer.description, writer.marker, folder, write, writer)
    elif is_folder or form != "CARMEN log":
        _require_own_ending(output, source, form, is_folder)
    return _own_target(source, output, form, is_folder, own)


def find_joined_target(output: Path, name: str | None = None) -> FilterTarget:
    """Find how a filtered recording is written whose parts are several inputs: as one recording.

    Args:
        output: the recording; a recording folder where it has no ending.
        name: of the format, as in `writers.py`; None: by the output's ending.

    Raises:
        InputError: there is no such format.
    """
    writer = writers.find_writer(output, name)
    write, is_folder = partial(_convert, writer=writer), bool(writer.marker)
    return FilterTarget(writer.description, writer.marker, is_folder, write, writer)


def _own_target(source: Path, output: Path, form: str, is_folder: bool, kind: str) -> FilterTarget:
    entry = FILTER_WRITERS.get(form)
    if entry is None:
        hint = f"other formats by name=FORMAT: {', '.join(w.name for w in writers.WRITERS)}"
        raise InputError(f"a {form} cannot be written again", where=str(source), hint=hint)
    entry.check(source, output)
    marker = ""
    if is_folder:
        of_source = (m for m in entry.markers if source.is_dir() and any(source.glob(m)))
        marker = next(of_source, entry.markers[0])

    def write(job: FilterJob) -> Omissions:
        return entry.write(replace(job, kind=kind))

    return FilterTarget(form, marker, is_folder, write, None)


def _own_writer_name(source: Path, form: str) -> str:
    """The name that `writers.py` has for the format of a recording; "" where it has none."""
    if form == "ROS bag":
        return detect_kind(source)[0]
    names = {
        "stillmap recording": "stillmap",
        "CARMEN log": "carmen",
        "KITTI folder": "kitti",
        "PCD": "pcd",
        "PLY": "ply",
        "LAS": "las",
    }
    return names.get(form, "")


def _require_own_ending(output: Path, source: Path, form: str, is_folder: bool) -> None:
    """Refuse a name that ends as those of files of a format which is not written.

    Raises:
        InputError: it does.
    """
    ends_as = {known.name: output.name.lower().endswith(_file_endings(known)) for known in FORMATS}
    if (ends_as[form] and not is_folder) or not any(ends_as.values()):
        return
    what = f"would be a {form}{' folder' * is_folder} like {source.name}, but has another ending"
    others = "; ".join(", ".join(w.endings) for w in writers.WRITERS if w.endings)
    raise InputError(
        what, where=str(output), hint=f"other formats by name: {others}; or by name=FORMAT"
    )


def _file_endings(form: Format) -> tuple[str, ...]:
    return tuple(one for one in form.endings if one.startswith("."))


def require_free(target: FilterTarget, output: Path, source: Path, overwrite: bool) -> None:
    """Refuse an output that is taken, or that lies in the folder which is copied.

    Raises:
        InputError: it is.
    """
    if target.is_folder:
        require_new(output, target.marker, overwrite)
    else:
        require_new_file(output, overwrite)
    require_outside(output, source)


def require_outside(output: Path, source: Path) -> None:
    """Refuse an output that lies in the folder of the recording.

    Raises:
        InputError: it does.
    """
    if source.is_dir() and source.resolve() in output.resolve().parents:
        hint = "choose a place outside of it"
        raise InputError("lies in the folder of the recording", where=str(output), hint=hint)


def _convert(job: FilterJob, writer: writers.Writer) -> Omissions:
    """Write the recording without the blanked beams in another format."""
    if writer.name == "stillmap" or (job.recording.dimension == 2 and writer.name in _OF_RANGES):
        recording = _to_misses(job)
    else:
        recording = _without_beams(job)
    losses = writers.write(recording, job.output, name=writer.name, overwrite=job.overwrite)
    return Omissions(count_skipped(job.recording.source), tuple(losses))


def _to_misses(job: FilterJob) -> Recording:
    """The recording with blanked beams as misses of the same length."""
    hit = arrays.copy(job.recording.hit, workplace(job.output))
    for block in arrays.iter_blocks(hit, job.blank):
        hit[block] &= ~job.blank[block]
    return replace(job.recording, hit=hit)


def _without_beams(job: FilterJob) -> Recording:
    """The recording without the blanked beams."""
    recording, scratch = job.recording, workplace(job.output)
    points = ArrayBuilder(np.float32, (recording.dimension,), scratch)
    hit = ArrayBuilder(np.bool_, (), scratch)
    times = ArrayBuilder(np.float32, (), scratch)
    length = np.zeros(recording.n_scans + 1, np.int64)
    for scan in recording.iter_scans(range(recording.n_scans), job.blank):
        beams = recording.beams_of(scan)
        kept: Mask = ~job.blank[beams]
        points.append(recording.points[beams][kept])
        hit.append(recording.hit[beams][kept])
        if recording.beam_time is not None:
            times.append(recording.beam_time[beams][kept])
        length[scan + 1] = np.count_nonzero(kept)
    return replace(
        recording,
        offset=np.cumsum(length),
        points=points.finish(),
        hit=hit.finish(),
        beam_time=None if recording.beam_time is None else times.finish(),
    )
