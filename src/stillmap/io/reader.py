"""Reads a recording of any format, or the parts of one run, and prepares it for mapping."""

import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.array_types import Float, Int32
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.source import Part, SensorNotes, Skipped, Source
from stillmap.io import builder, cameras
from stillmap.io.registry import Format, detect_format
from stillmap.io.text_lines import Progress
from stillmap.io.trajectory import MAX_MOUNT, is_rigid
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.prepare import complete, interpret
from stillmap.prepare.time_window import TimeWindow, select_time

_MAX_PAUSE = 60.0  # s between parts: recorders take less to begin a new file
_MAX_OVERLAP = 3  # scans, of several sensors, that precede the end of the part before
_SAME_POSE = 0.05  # m, rad between poses that are one


def read(
    path: str | Path,
    options: ReadOptions | None = None,
    *,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> Recording:
    """Read a recording of any format.

    Args:
        path: a file or a folder, see `registry.FORMATS`.
        options: read options, None for the defaults. A recording folder, whose readings are already
            interpreted, is narrowed by them.
        progress: called with the share of the file that is read, 0 to 1.
        scratch: folder for memory-mapped buffers; None: the system's temporary folder.

    Raises:
        InputError: there is no readable recording.
    """
    path, options = Path(path), options or ReadOptions()
    with builder.explain_failure(path):
        raw = detect_format(path).read([path], builder.ReadContext(options, progress, scratch), ())
        return _finish(interpret(raw, options, scratch), options, scratch, str(path))


def read_parts(
    paths: Sequence[str | Path],
    options: ReadOptions | None = None,
    *,
    progress: Progress | None = None,
    scratch: Path | None = None,
    in_order: bool = False,
) -> Recording:
    """Read the parts of one run as one recording; `source.parts` notes them in order of time.

    Args:
        paths: of the parts.
        options, progress, scratch: see `stillmap.io.read`; the time window counts from the start
            of the first part.
        in_order: that they follow each other in this order is known.

    Raises:
        InputError: a part cannot be read, or they do not follow each other.
    """
    files, options = [Path(path) for path in paths], options or ReadOptions()
    if not files:
        raise InputError("no recording is named")
    context = builder.ReadContext(options, progress, scratch)
    with builder.explain_failure(files[0]):
        forms = [detect_format(path) for path in files]
        joins = forms[0].joins and all(form is forms[0] for form in forms)
        notes = [Part(path=str(path)) for path in files]
        if not (joins and in_order):
            parts = [_read_part(files, forms, k, context) for k in range(len(files))]
            order = sorted(range(len(files)), key=lambda k: parts[k].stamp_ns[[0, -1]].tolist())
            files, parts = [files[k] for k in order], [parts[k] for k in order]
            _require_run(files, parts)
            notes = [_describe(*part) for part in zip(files, parts, strict=True)]
        if joins:
            recording = interpret(forms[0].read(files, context, ()), options, scratch)
        else:
            recording = join_recordings(parts, [str(path) for path in files], scratch)
            window = TimeWindow(options)
            recording = select_time(recording, window, str(files[0])) if window else recording
            recording = replace(recording, scratch=scratch)
        recording = _finish(recording, options, scratch, str(files[0]))
    recording.source.path, recording.source.parts = notes[0].path, notes
    return recording


def _finish(
    recording: Recording, options: ReadOptions, scratch: Path | None, where: str
) -> Recording:
    """A recording with what follows from all of its scans, and with the given cameras.

    Raises:
        InputError: options are for recordings of another dimension, or a sensor is far from the
            robot.
    """
    require_mounts(recording, where)
    recording = complete(recording, options, scratch)
    if options.cameras is not None:
        recording = cameras.apply_camera_file(recording, Path(options.cameras))
    return recording


def require_mounts(recording: Recording, where: str) -> None:
    """Refuse sensors that are far from the robot, or whose pose on it is none: a kernel could not.

    Raises:
        InputError: a sensor with scans is.
    """
    D = recording.dimension
    for sensor in np.unique(recording.sensor).tolist():
        mount = recording.T_base_sensor[sensor]
        distance = float(np.hypot.reduce(mount[:D, D]))
        if not is_rigid(mount[None]).all():
            raise InputError(f"the mount of sensor {sensor} is no rigid transform", where=where)
        if not distance <= MAX_MOUNT:
            what = f"sensor {sensor} is mounted {distance:.4g} m from the robot's base"
            hint = f"at most {MAX_MOUNT:.0f} m: poses in a map are no mounts"
            raise InputError(what, where=where, hint=hint)


def require_plausible(recording: Recording, where: str) -> None:
    """Refuse what no reader returns, but who makes a `Recording` himself may have put there.

    Raises:
        InputError: stamps fall, or a mount or an odometry pose is none.
    """
    require_mounts(recording, where)
    if np.any(recording.stamp_ns[1:] < recording.stamp_ns[:-1]):
        raise InputError("stamps must not fall", where=where, hint="sort the scans by time")
    if recording.T_odom_base is not None and not is_rigid(recording.T_odom_base).all():
        what = "odometry: expected finite rigid transforms within a million km"
        raise InputError(what, where=where, hint="odometry=False does without")


def _read_part(
    files: list[Path], forms: list[Format], number: int, context: builder.ReadContext
) -> Recording:
    """One of several inputs, of which others of its format may state what it lacks."""
    path, form = files[number], forms[number]
    context = builder.part_context(context, number, len(files))
    others = [file for file, of in zip(files, forms, strict=True) if of is form and file != path]
    raw = form.read([path], context, others)
    recording = interpret(raw, context.options, context.scratch)
    if not recording.n_scans:
        raise InputError("holds no scan", where=str(path))
    return recording


def _describe(path: Path, part: Recording) -> Part:
    first, last = part.stamp_ns[[0, -1]].tolist()
    return Part(first, last, str(path), part.n_scans)


def _require_run(files: list[Path], parts: list[Recording]) -> None:
    """Refuse recordings that do not follow each other.

    Raises:
        InputError: one does not go on where the one before ends.
    """
    for path, (before, after), (file, _) in zip(
        files[1:], pairwise(parts), pairwise(files), strict=True
    ):
        if why := _find_break(before, after):
            hint = f"sessions of one place: stillmap merge {shlex.join(map(str, files))} -o DIR"
            raise InputError(f"does not follow {file}: {why}", where=str(path), hint=hint)


def _find_break(before: Recording, after: Recording) -> str:
    """Why a recording is no part of the run of the one before; "" where it goes on with it."""
    if before.dimension != after.dimension:
        return f"it is {after.dimension}D"
    names = ([sensor.name for sensor in part.source.sensors] for part in (before, after))
    if next(names) != next(names):
        return "it has other sensors"
    if (before.T_odom_base is None) != (after.T_odom_base is None):
        return "one of them has no odometry"
    pause = (int(after.stamp_ns[0]) - int(before.stamp_ns[-1])) / 1e9
    if pause > _MAX_PAUSE:
        return f"it begins {pause:.0f} s later"
    overlap = int(np.searchsorted(after.stamp_ns, before.stamp_ns[-1], side="right"))
    if overlap and (overlap > _MAX_OVERLAP or 2 * overlap >= min(before.n_scans, after.n_scans)):
        return "it is of the same time"
    if _starts_anew(before.T_odom_base, after.T_odom_base):
        return "its odometry begins anew"
    return ""


def _starts_anew(before: Float | None, after: Float | None) -> bool:
    """True if poses (T, D+1, D+1) begin at zero again, elsewhere than those before end."""
    if before is None or after is None:
        return False
    is_zero = np.allclose(after[0], np.eye(len(after[0])))
    return is_zero and not np.allclose(after[0], before[-1], atol=_SAME_POSE)


def join_recordings(
    parts: Sequence[Recording], names: Sequence[str], scratch: Path | None
) -> Recording:
    """Join the parts of one run, in order of time.

    Args:
        parts: with at least one scan each.
        names: of the parts, for messages.
        scratch: folder of memory-mapped arrays; None: the system's temporary folder.

    Raises:
        InputError: the clouds of one have another origin.
    """
    for name, part in zip(names, parts, strict=True):
        if part.source.origin != parts[0].source.origin:
            hint = "move the files of all parts into one folder"
            raise InputError("has points about another origin", where=name, hint=hint)
    stamp_ns = np.concatenate([part.stamp_ns for part in parts])
    length = np.concatenate([np.diff(part.offset) for part in parts])
    order = np.argsort(stamp_ns, kind="stable")
    T_base_sensor, sensor, sensors = _join_sensors(parts)
    source = _join_notes(parts, names, sensors)

    def columns_of(name: str) -> list[NDArray[Any]] | None:
        columns = [getattr(part, name) for part in parts]
        return None if any(column is None for column in columns) else columns

    def join(name: str) -> Any:
        columns = columns_of(name)
        return None if columns is None else np.concatenate(columns)[order]

    def join_beams(name: str) -> Any:
        columns = columns_of(name)
        if columns is None:
            return None
        joined = ArrayBuilder(columns[0].dtype, columns[0].shape[1:], scratch)
        for column in columns:
            for block in arrays.iter_blocks(column):
                joined.append(column[block])
        return builder.reorder_scans(joined.finish(), length, order, scratch)

    posed = [part.T_recorded_base for part in parts]
    is_posed = not any(_starts_anew(*pair) for pair in pairwise(posed))
    if not is_posed:
        text = "the recorded poses of the parts do not continue each other: not used"
        source.warnings.append(text)
    images = [part.images for part in parts if part.images is not None]
    return Recording(
        stamp_ns=stamp_ns[order],
        offset=np.concatenate([[0], np.cumsum(length[order])]).astype(np.int64),
        points=join_beams("points"),
        hit=join_beams("hit"),
        T_base_sensor=T_base_sensor,
        sensor=sensor[order],
        T_odom_base=join("T_odom_base"),
        source=source,
        beam_time=join_beams("beam_time"),
        T_recorded_base=join("T_recorded_base") if is_posed else None,
        images=cameras.merge_images(images) if images else None,
        scratch=scratch,
    )


def _join_sensors(parts: Sequence[Recording]) -> tuple[Float, Int32, list[SensorNotes]]:
    """Poses of the sensors of all parts, that of each scan, and the notes on them.

    Those of the first part, unless one moves: then it has a pose per place, and one note.
    """
    poses, sensor = [part.T_base_sensor for part in parts], [part.sensor for part in parts]
    notes = [note for part in parts for note in part.source.sensors]
    if any(note.places > 1 for note in notes) or len({len(T) for T in poses}) > 1:
        first = np.cumsum([0, *map(len, poses[:-1])]).tolist()
        shifted = [(own + n).astype(np.int32) for own, n in zip(sensor, first, strict=True)]
        return np.concatenate(poses), np.concatenate(shifted), notes
    scans: Counter[str] = Counter()
    for note in notes:
        scans[note.name] += note.scans or 0
    joined = [replace(s, scans=scans[s.name] or None) for s in parts[0].source.sensors]
    return poses[0], np.concatenate(sensor), joined


def _join_notes(
    parts: Sequence[Recording], names: Sequence[str], sensors: list[SensorNotes]
) -> Source:
    """The notes of the first part, with the warnings and the damage of all."""
    noted = [part.source for part in parts]

    def join(key: str) -> dict[str, Skipped]:
        return {
            f"{reason} (in {Path(name).name})": own
            for name, source in zip(names, noted, strict=True)
            for reason, own in getattr(source, key).items()
        }

    return replace(
        noted[0],
        format=", ".join(dict.fromkeys(str(source.format) for source in noted)),
        warnings=list(dict.fromkeys(text for source in noted for text in source.warnings)),
        sensors=sensors,
        skipped=join("skipped"),
        skipped_odometry=join("skipped_odometry"),
        damage=join("damage"),
    )
