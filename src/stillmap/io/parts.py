"""Parts of one run, read as one recording in the order of their stamps."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays, se2
from stillmap.core.arrays import ArrayBuilder
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io.builder import MAX_LINE_NUMBERS, ReadContext, part_context, reorder_scans
from stillmap.io.cameras import merge_images
from stillmap.io.reader import explain_failure, prepare
from stillmap.io.registry import Format, detect_format
from stillmap.io.text_lines import Progress
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.time_window import TimeWindow, select_time

Float = NDArray[np.float64]

_MAX_PAUSE = 60.0  # s between parts: recorders take less to begin a new file
_MAX_OVERLAP = 3  # scans, of several sensors, that precede the end of the part before
# odometry from one part to the next: faster than usual, but within reach
_SPEED_FACTOR, _USUAL_SHARE, _MIN_SPEED = 1.5, 0.98, 1.0  # m/s, rad/s
_SPEED_SPAN = 0.5  # s over which speed is measured, and more than readings lie from the scans
_ROUNDING = 0.05  # m, rad


def read_parts(
    paths: Sequence[str | Path],
    options: ReadOptions | None = None,
    *,
    progress: Progress | None = None,
    scratch: Path | None = None,
    in_order: bool = False,
) -> Recording:
    """Read the parts of one run as one recording; `source["parts"]` notes them in order of time.

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
    context = ReadContext(options, progress, scratch)
    with explain_failure(files[0]):
        forms = [detect_format(path) for path in files]
        read_all = forms[0].read_parts if all(form is forms[0] for form in forms) else None
        notes: list[dict[str, Any]] = [{"path": str(path)} for path in files]
        if read_all is None or not in_order:
            parts = [_read_part(files, forms, k, context) for k in range(len(files))]
            order = sorted(range(len(files)), key=lambda k: parts[k].stamp_ns[[0, -1]].tolist())
            files, parts = [files[k] for k in order], [parts[k] for k in order]
            _require_run(files, parts)
            notes = [_describe(*part) for part in zip(files, parts, strict=True)]
        if read_all is not None:
            recording = read_all(files, context, ())
        else:
            recording = join_recordings(parts, [str(path) for path in files], scratch)
            window = TimeWindow(options)
            recording = select_time(recording, window, str(files[0])) if window else recording
            recording = replace(recording, scratch=scratch)
        recording = prepare(recording, options, scratch, str(files[0]))
    recording.source.update(path=notes[0]["path"], parts=notes)
    return recording


def _read_part(
    files: list[Path], forms: list[Format], number: int, context: ReadContext
) -> Recording:
    """One of several inputs, of which others of its format may state what it lacks."""
    path, form = files[number], forms[number]
    context = part_context(context, number, len(files))
    if form.read_parts is None:
        recording = form.read(path, context)
    else:
        same = [file for file, of in zip(files, forms, strict=True) if of is form and file != path]
        recording = form.read_parts([path], context, same)
    if not recording.n_scans:
        raise InputError("holds no scan", where=str(path))
    return recording


def _describe(path: Path, part: Recording) -> dict[str, Any]:
    first, last = part.stamp_ns[[0, -1]].tolist()
    return {
        "path": str(path),
        "scans": part.n_scans,
        "first_stamp_ns": first,
        "last_stamp_ns": last,
    }


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
    if _sensor_names(before) != _sensor_names(after):
        return "it has other sensors"
    if (before.T_odom_base is None) != (after.T_odom_base is None):
        return "one of them has no odometry"
    pause = (int(after.stamp_ns[0]) - int(before.stamp_ns[-1])) / 1e9
    if pause > _MAX_PAUSE:
        return f"it begins {pause:.0f} s later"
    overlap = int(np.searchsorted(after.stamp_ns, before.stamp_ns[-1], side="right"))
    if overlap and (overlap > _MAX_OVERLAP or 2 * overlap >= min(before.n_scans, after.n_scans)):
        return "it is of the same time"
    if before.T_odom_base is None or after.T_odom_base is None:
        return ""
    return _find_jump(before, after, before.T_odom_base, after.T_odom_base)


def _sensor_names(recording: Recording) -> list[str]:
    return [str(sensor.get("name")) for sensor in recording.source.get("sensors") or []]


def _find_jump(before: Recording, after: Recording, A: Float, B: Float) -> str:
    """How poses of one part do not go on with those of the one before; "" where they do."""
    step = _measure_motions(A[-1:], B[:1])[0]
    seconds = abs(int(after.stamp_ns[0]) - int(before.stamp_ns[-1])) / 1e9 + _SPEED_SPAN
    fastest = np.maximum(_usual_speed(before, A), _usual_speed(after, B))
    reach = np.maximum(_SPEED_FACTOR * fastest, _MIN_SPEED) * seconds + _ROUNDING
    starts_anew = np.allclose(B[0], np.eye(len(B[0]))) and step.max() > _ROUNDING
    if starts_anew or (step > reach).any():
        return f"its odometry begins {step[0]:.2f} m and {np.degrees(step[1]):.0f} degrees apart"
    return ""


def _usual_speed(recording: Recording, T: Float) -> Float:
    """(2,) m/s and rad/s of fast motion along poses (T, D+1, D+1)."""
    stamps = recording.stamp_ns
    ahead = np.searchsorted(stamps, stamps + int(1e9 * _SPEED_SPAN))
    start = np.flatnonzero(ahead < len(stamps))
    if not len(start):
        return np.zeros(2)
    seconds = (stamps[ahead[start]] - stamps[start]) / 1e9
    motions = _measure_motions(T[start], T[ahead[start]]) / seconds[:, None]
    return np.asarray(np.quantile(motions, _USUAL_SHARE, axis=0))


def _measure_motions(A: Float, B: Float) -> Float:
    """(n, 2) distances, m, and angles, rad, between poses (n, D+1, D+1)."""
    step, D = se2.inverse(A) @ B, A.shape[-1] - 1
    # the angle of a rotation in any dimension follows from its trace
    cosine = (np.trace(step[:, :D, :D], axis1=1, axis2=2) - (D - 2)) / 2.0
    metres = np.linalg.norm(step[:, :D, D], axis=1)
    return np.stack([metres, np.arccos(np.clip(cosine, -1.0, 1.0))], axis=1)


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
        if part.source.get("origin") != parts[0].source.get("origin"):
            hint = "move the files of all parts into one folder"
            raise InputError("has points about another origin", where=name, hint=hint)
    stamp_ns = np.concatenate([part.stamp_ns for part in parts])
    length = np.concatenate([np.diff(part.offset) for part in parts])
    order = np.argsort(stamp_ns, kind="stable")
    source = _join_notes(parts, names)
    notes = [part.source.get("sensors") or [] for part in parts]
    T_base_sensor, sensor, joined = _join_sensors(parts, notes)
    source.update({"sensors": joined} if joined else {})

    def join_beams(columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
        builder = ArrayBuilder(columns[0].dtype, columns[0].shape[1:], scratch)
        for column in columns:
            for block in arrays.iter_blocks(column):
                builder.append(column[block])
        return reorder_scans(builder.finish(), length, order, scratch)

    odometry = [part.T_odom_base for part in parts if part.T_odom_base is not None]
    recorded = [part.T_recorded_base for part in parts if part.T_recorded_base is not None]
    if recorded and not _are_continuous(parts, recorded):
        text = "the recorded poses of the parts do not continue each other: not used"
        source["warnings"].append(text)
        recorded = []
    times = [part.beam_time for part in parts if part.beam_time is not None]
    images = [part.images for part in parts if part.images is not None]
    return Recording(
        stamp_ns=stamp_ns[order],
        offset=np.concatenate([[0], np.cumsum(length[order])]).astype(np.int64),
        points=join_beams([part.points for part in parts]),
        hit=join_beams([part.hit for part in parts]),
        T_base_sensor=T_base_sensor,
        sensor=sensor[order],
        T_odom_base=np.concatenate(odometry)[order] if odometry else None,
        source=source,
        beam_time=join_beams(times) if len(times) == len(parts) else None,
        T_recorded_base=np.concatenate(recorded)[order] if recorded else None,
        images=merge_images(images) if images else None,
        scratch=scratch,
    )


def _are_continuous(parts: Sequence[Recording], poses: Sequence[Float]) -> bool:
    """True if all parts have poses, which go on from one to the next."""
    if len(poses) < len(parts):
        return False
    pairs = zip(pairwise(parts), pairwise(poses), strict=True)
    return not any(_find_jump(*pair, *ends) for pair, ends in pairs)


def _join_sensors(
    parts: Sequence[Recording], notes: Sequence[list[dict[str, Any]]]
) -> tuple[Float, NDArray[np.int32], list[dict[str, Any]]]:
    """Poses of the sensors of all parts, that of each scan, and the notes on them.

    Those of the first part, unless one moves: then it has a pose per place, and one note.
    """
    poses, sensor = [part.T_base_sensor for part in parts], [part.sensor for part in parts]
    all_notes = [note for of_part in notes for note in of_part]
    moves = any(note.get("places", 1) > 1 for note in all_notes)
    if moves or len({len(T) for T in poses}) > 1:
        first = np.cumsum([0, *map(len, poses[:-1])]).tolist()
        shifted = [(one + n).astype(np.int32) for one, n in zip(sensor, first, strict=True)]
        return np.concatenate(poses), np.concatenate(shifted), all_notes
    joined = [dict(note) for note in notes[0]]
    for number, note in enumerate(joined):
        if "scans" in note:
            note["scans"] = sum(of_part[number].get("scans", 0) for of_part in notes)
    return poses[0], np.concatenate(sensor), joined


def _join_notes(parts: Sequence[Recording], names: Sequence[str]) -> dict[str, Any]:
    """The notes of the first part, with the warnings and the damage of all."""
    source: dict[str, Any] = {}
    for part in reversed(parts):
        source.update(part.source)
    formats = dict.fromkeys(str(part.source.get("format")) for part in parts)
    texts = (text for part in parts for text in part.source.get("warnings") or [])
    source.update(format=", ".join(formats), warnings=list(dict.fromkeys(texts)))
    for key in ("skipped", "skipped_odometry", "damage"):
        source[key] = {
            f"{reason} (in {Path(name).name})": {
                **damage,
                "lines": damage["lines"][:MAX_LINE_NUMBERS],
            }
            for name, part in zip(names, parts, strict=True)
            for reason, damage in (part.source.get(key) or {}).items()
        }
    return source
