"""Joins recordings that are parts of one run, one after the other, in memory-mapped arrays."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.arrays import ArrayBuilder
from stillmap.core.camera import Images
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io.builder import MAX_LINE_NUMBERS, reorder_scans
from stillmap.io.parts.facts import measure_facts
from stillmap.io.parts.images import join_images
from stillmap.io.parts.seams import Seam, compare

Float = NDArray[np.float64]

_DAMAGE = ("skipped", "skipped_odometry", "damage")
_LISTS = ("warnings", "duplicates")
_ODOMETRY_LOST = "some parts have no odometry: it is not used"
_POSES_LOST = "the recorded poses of the parts do not continue each other: not used"


class _Scans(NamedTuple):
    """The scans of a part that are kept: t scans in D dimensions."""

    stamp_ns: NDArray[np.int64]
    length: NDArray[np.int64]
    sensor: NDArray[np.int32]
    T_odom_base: Float | None
    T_recorded_base: Float | None


def join_recordings(
    parts: Iterable[Recording], names: list[str], scratch: Path | None
) -> Recording:
    """Join the parts of one run; scans that an earlier part holds already are left out.

    Args:
        parts: in order of time, each read when the one before has been copied.
        names: of the parts, for messages.
        scratch: folder of memory-mapped arrays; None: the system's temporary folder.

    Raises:
        InputError: the parts have other dimensions, or clouds of other origins.
    """
    joiner: _Joiner | None = None
    for name, part in zip(names, parts, strict=True):
        joiner = joiner or _Joiner(part, scratch)
        joiner.add(part, name)
    assert joiner is not None
    return joiner.finish()


class _Joiner:
    """Appends recordings to one; `first` decides about dimension and origin."""

    def __init__(self, first: Recording, scratch: Path | None) -> None:
        self._dimension, self._scratch = first.dimension, scratch
        self._points = ArrayBuilder(np.float32, (first.dimension,), scratch)
        self._hit = ArrayBuilder(np.bool_, (), scratch)
        self._times = ArrayBuilder(np.float32, (), scratch)
        self._has_times = False
        self._scans: list[_Scans] = []
        self._sensors: list[Float] = []
        self._images: list[Images] = []
        self._source: dict[str, Any] = {}
        self._tail: Recording | None = None
        self._poses_continue = True

    def add(self, part: Recording, name: str) -> None:
        """Copy a part."""
        self._require_fit(part, name)
        numbers = self._number_sensors(part)
        repeated = np.zeros(part.n_scans, np.bool_)
        if self._tail is not None:
            repeated = _find_repeated_scans(self._tail, part)
            self._poses_continue &= _continues_recorded_poses(self._tail, part)
        kept = np.flatnonzero(~repeated)
        self._copy_beams(part, kept)
        T_odom, T_recorded = part.T_odom_base, part.T_recorded_base
        self._scans.append(
            _Scans(
                part.stamp_ns[kept],
                np.diff(part.offset)[kept],
                numbers[part.sensor[kept]],
                None if T_odom is None else T_odom[kept],
                None if T_recorded is None else T_recorded[kept],
            )
        )
        if part.images is not None:
            self._images.append(part.images)
        self._source = _merge_notes(self._source, part.source, name, int(repeated.sum()))
        if self._tail is None or _end(part) >= _end(self._tail):
            self._tail = part

    def _require_fit(self, part: Recording, name: str) -> None:
        if part.dimension != self._dimension:
            what = f"is {part.dimension}D, the parts before it are {self._dimension}D"
            raise InputError(what, where=name)
        if self._tail is not None and part.source.get("origin") != self._source.get("origin"):
            what = "has points about another origin than the parts before it"
            hint = "move the files of all parts into one folder"
            raise InputError(what, where=name, hint=hint)

    def _number_sensors(self, part: Recording) -> NDArray[np.int32]:
        """(S,) the joined number of each sensor of a part."""
        T = part.T_base_sensor
        known = np.concatenate([np.zeros((0, *T.shape[1:])), *self._sensors])
        noted = part.source.get("sensors")
        moves = isinstance(noted, list) and len(noted) < len(T)
        if len(known) == len(T) and not moves:
            return np.arange(len(T), dtype=np.int32)  # those of the first part, to the bit
        self._sensors.append(np.array(T))
        return np.arange(len(known), len(known) + len(T), dtype=np.int32)

    def _copy_beams(self, part: Recording, kept: NDArray[np.intp]) -> None:
        self._has_times |= part.beam_time is not None
        runs = np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1) if len(kept) else []
        for run in runs:
            first, stop = int(part.offset[run[0]]), int(part.offset[run[-1] + 1])
            for start in range(first, stop, arrays.BLOCK):
                beams = slice(start, min(start + arrays.BLOCK, stop))
                self._points.append(part.points[beams])
                self._hit.append(part.hit[beams])
                n = beams.stop - beams.start
                times = np.zeros(n, np.float32) if part.beam_time is None else part.beam_time[beams]
                self._times.append(times)
                part.release_pages()

    def finish(self) -> Recording:
        """The joined recording, in order of stamps."""
        self._tail = None
        stamp_ns = np.concatenate([one.stamp_ns for one in self._scans])
        length = np.concatenate([one.length for one in self._scans])
        order = np.argsort(stamp_ns, kind="stable")
        T_odom, lost = _concatenate([one.T_odom_base for one in self._scans])
        warnings = [*self._source.get("warnings", []), *[_ODOMETRY_LOST] * lost]
        T_recorded, lost = _concatenate([one.T_recorded_base for one in self._scans])
        if T_recorded is not None and not self._poses_continue:
            T_recorded, lost = None, True
        warnings += [_POSES_LOST] * lost
        points = reorder_scans(self._points.finish(), length, order, self._scratch)
        hit = reorder_scans(self._hit.finish(), length, order, self._scratch)
        times = reorder_scans(self._times.finish(), length, order, self._scratch)
        return Recording(
            stamp_ns=stamp_ns[order],
            offset=np.concatenate([[0], np.cumsum(length[order])]).astype(np.int64),
            points=points,
            hit=hit,
            T_base_sensor=np.concatenate(self._sensors),
            sensor=np.concatenate([one.sensor for one in self._scans])[order],
            T_odom_base=None if T_odom is None else T_odom[order],
            source={**self._source, "warnings": warnings},
            beam_time=times if self._has_times else None,
            T_recorded_base=None if T_recorded is None else T_recorded[order],
            images=join_images(self._images),
            scratch=self._scratch,
        )


def _end(recording: Recording) -> int:
    return int(recording.stamp_ns[-1]) if recording.n_scans else -(1 << 63)


def _find_repeated_scans(earlier: Recording, later: Recording) -> NDArray[np.bool_]:
    """(T,) which scans of a part have the stamp and the beams of one of the part before."""
    repeated = np.zeros(later.n_scans, np.bool_)
    if not earlier.n_scans or not later.n_scans:
        return repeated
    taken = set[int]()
    for k in range(int(np.searchsorted(later.stamp_ns, _end(earlier), side="right"))):
        stamp = later.stamp_ns[k]
        for n in range(*np.searchsorted(earlier.stamp_ns, [stamp, stamp + 1]).tolist()):
            if n not in taken and _has_same_beams(earlier, n, later, k):
                taken.add(n)
                repeated[k] = True
                break
    return repeated


def _has_same_beams(a: Recording, n: int, b: Recording, k: int) -> bool:
    """True if scan n of one recording is scan k of another.

    What is beyond the maximum range, or on the robot, may have been judged differently in each.
    """
    of_a, of_b = a.beams_of(n), b.beams_of(k)
    if of_a.stop - of_a.start != of_b.stop - of_b.start:
        return False
    both = a.hit[of_a] & b.hit[of_b]
    if not both.any():
        return bool(not a.hit[of_a].any() and not b.hit[of_b].any())
    return bool(np.array_equal(a.points[of_a][both], b.points[of_b][both]))


def _continues_recorded_poses(earlier: Recording, later: Recording) -> bool:
    """True if the recorded poses of a part go on where those of the part before end."""
    if earlier.T_recorded_base is None or later.T_recorded_base is None:
        return False
    a, b = (
        measure_facts(replace(part, T_odom_base=part.T_recorded_base), "")
        for part in (earlier, later)
    )
    return isinstance(compare(a, b), Seam)


def _concatenate(parts: list[Float | None]) -> tuple[Float | None, bool]:
    """Poses of all parts, and whether those of some are lost: others have none."""
    found = [one for one in parts if one is not None]
    if found and len(found) == len(parts):
        return np.concatenate(found), False
    return None, bool(found)


def _merge_notes(
    known: dict[str, Any], new: dict[str, Any], name: str, repeated: int
) -> dict[str, Any]:
    """The notes of the parts before with those of another one."""
    out = {**new, **known}
    for key in _LISTS:
        before = list(known.get(key) or [])
        out[key] = before + [text for text in new.get(key) or [] if text not in before]
    if repeated:
        scans = "1 scan" if repeated == 1 else f"{repeated} scans"
        out["duplicates"].append(f"{name}: {scans} that the parts before it hold already")
    for key in _DAMAGE:
        counts = dict(known.get(key) or {})
        for reason, damage in (new.get(key) or {}).items():
            counts[f"{reason} (in {Path(name).name})"] = {
                **damage,
                "lines": damage.get("lines", [])[:MAX_LINE_NUMBERS],
            }
        out[key] = counts
    if known and known.get("format") != new.get("format"):
        out["format"] = f"{known.get('format')}, {new.get('format')}"
    out["sensors"] = _merge_sensor_notes(known.get("sensors"), new.get("sensors"))
    return {key: value for key, value in out.items() if value is not None}


def _merge_sensor_notes(known: Any, new: Any) -> Any:
    """Notes on the sensors of all parts, with their scans in all."""
    if not isinstance(known, list) or not isinstance(new, list):
        return known or new
    if len(known) != len(new) or any(one.get("places", 1) > 1 for one in (*known, *new)):
        return known + new
    return [
        {**a, "scans": a["scans"] + b["scans"]} if "scans" in a and "scans" in b else a
        for a, b in zip(known, new, strict=True)
    ]
