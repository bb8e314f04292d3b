"""Facts that decide whether recordings are parts of one run: stamps, odometry, sensors, ranges."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr

Float = NDArray[np.float64]

_BEAMS = 8  # of each scan, spread over it: enough to tell equal scans from others
_BLOCK = 1 << 12  # scans at a time
_STATED = ("TF", "PARAM", "given", "scan lines")  # how the pose of a sensor is known


@dataclass(frozen=True, eq=False)
class SensorFacts(ShortRepr):
    """A sensor of a recording.

    Attributes:
        name: topic or kind; "": without a name.
        n_beams: usual number of beams of its scans in 2D; None: it varies.
        T_base_sensor: (D+1, D+1) pose on the robot; None: the recording does not state it, or the
            sensor moves on the robot.
    """

    name: str
    n_beams: int | None
    T_base_sensor: Float | None


@dataclass(frozen=True, eq=False)
class RecordingFacts(ShortRepr):
    """A recording of T scans in D dimensions, without its beams.

    Attributes:
        path: as the user named it.
        dimension: D.
        stamp_ns: (T,) not decreasing, T > 0.
        ranges: (T, 8) metres, of hits spread over each scan; NaN: no hit.
        T_odom_base: (T, D+1, D+1); None: no odometry.
        sensors: by name.
    """

    path: str
    dimension: int
    stamp_ns: NDArray[np.int64]
    ranges: NDArray[np.float32]
    T_odom_base: Float | None
    sensors: tuple[SensorFacts, ...]

    @property
    def first_ns(self) -> int:
        return int(self.stamp_ns[0])

    @property
    def last_ns(self) -> int:
        return int(self.stamp_ns[-1])


def measure_facts(recording: Recording, path: str) -> RecordingFacts:
    """The facts of a recording with at least one scan."""
    return RecordingFacts(
        path,
        recording.dimension,
        np.array(recording.stamp_ns),
        _sample_ranges(recording),
        None if recording.T_odom_base is None else np.array(recording.T_odom_base),
        _describe_sensors(recording),
    )


def _sample_ranges(recording: Recording) -> NDArray[np.float32]:
    """(T, 8) lengths of beams spread over each scan; NaN where they hit nothing."""
    out = np.full((recording.n_scans, _BEAMS), np.nan, np.float32)
    n_beams = np.diff(recording.offset)
    for first in range(0, recording.n_scans, _BLOCK):
        scans = first + np.flatnonzero(n_beams[first : first + _BLOCK])
        if not len(scans):
            continue
        share = (2 * np.arange(_BEAMS) + 1) * n_beams[scans, None] // (2 * _BEAMS)
        beams = recording.offset[scans, None] + share
        length = np.linalg.norm(recording.points[beams].astype(np.float64), axis=-1)
        out[scans] = np.where(recording.hit[beams], length, np.nan)
        recording.release_pages()
    return out


def _describe_sensors(recording: Recording) -> tuple[SensorFacts, ...]:
    """The sensors by name; a moving one has several poses and one note."""
    noted = recording.source.get("sensors")
    noted = noted if isinstance(noted, list) else []
    n_beams = np.diff(recording.offset)
    out: list[SensorFacts] = []
    first, number, count = 0, 0, len(recording.T_base_sensor)
    while first < count:
        notes = noted[number] if number < len(noted) and isinstance(noted[number], dict) else {}
        places = notes.get("places", 1)
        places = places if isinstance(places, int) and places > 0 else 1
        of_sensor = (recording.sensor >= first) & (recording.sensor < first + places)
        counts = np.unique(n_beams[of_sensor])
        usual = int(np.median(n_beams[of_sensor])) if len(counts) == 1 else None
        fixed = places == 1 and _is_pose_stated(notes)
        T = np.array(recording.T_base_sensor[first]) if fixed else None
        name = str(notes.get("name", ""))
        out.append(SensorFacts(name, usual if recording.dimension == 2 else None, T))
        first, number = first + places, number + 1
    return tuple(sorted(out, key=lambda one: one.name))


def _is_pose_stated(notes: dict[str, Any]) -> bool:
    """True if the pose of a sensor comes from the recording or the user, not from a default."""
    place = notes.get("extrinsics")
    if not isinstance(place, dict):
        return True
    return str(place.get("how", "")).startswith(_STATED)
