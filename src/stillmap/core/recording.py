"""Recording: flat arrays of scans and beams, 2D and 3D alike."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core import arrays
from stillmap.core.camera import Images
from stillmap.core.short_repr import ShortRepr
from stillmap.core.source import Source
from stillmap.core.timestamps import MAX_BEAM_TIME, are_dated

_BLOCK = 1 << 14  # end points transformed at once


@dataclass(frozen=True, eq=False)
class Recording(ShortRepr):
    """T scans with M beams in all, in D dimensions, taken by S sensors on one robot.

    Attributes:
        stamp_ns: (T,) int64, the recording's own stamps in nanoseconds, non-decreasing, from
            1824 to 2116: the time between any two fits into int64.
        offset: (T+1,) int64, scan t has the beams offset[t]:offset[t+1].
        points: (M, D) float32, end points in the sensor frame in metres. NaN marks an unusable
            beam; a maximum-range beam (not hit, finite) ends where known free space ends.
        hit: (M,) bool, True for beams with a return: zeta = 0 in equation (1), and usable.
        T_base_sensor: (S, D+1, D+1) float64, sensor poses on the robot.
        sensor: (T,) int32, sensor index of each scan.
        T_odom_base: (T, D+1, D+1) float64, odometry at each scan; None: no odometry.
        beam_time: (M,) float32, seconds after the stamp of the scan, at most `MAX_BEAM_TIME`;
            None: all beams of a scan have its stamp.
        source: notes of the reader: input, format, sensors, warnings, skipped records.
        T_recorded_base: (T, D+1, D+1) float64, poses stored in the recording, of a survey or other
            programs; used only on request. None: no poses.
        images: camera images; None: no images.
        record: (T,) int64, number of the record that each scan was read from: the message of its
            topic from 1, or the file (scan of a file) of a folder from 0; None: unknown.
        scratch: folder of memory-mapped per-beam arrays; None: the system's temporary folder.
    """

    stamp_ns: NDArray[np.int64]
    offset: NDArray[np.int64]
    points: NDArray[np.float32]
    hit: NDArray[np.bool_]
    T_base_sensor: NDArray[np.float64]
    sensor: NDArray[np.int32]
    T_odom_base: NDArray[np.float64] | None
    source: Source = field(default_factory=Source)
    beam_time: NDArray[np.float32] | None = None
    T_recorded_base: NDArray[np.float64] | None = None
    images: Images | None = None
    record: NDArray[np.int64] | None = None
    scratch: Path | None = None

    # constructors from arrays, which `stillmap.io` sets: it knows what readings mean
    from_scans: ClassVar[Callable[..., Recording]]
    from_clouds: ClassVar[Callable[..., Recording]]

    def __post_init__(self) -> None:
        T, M, D = self.n_scans, self.n_beams, self.dimension
        if D not in (2, 3) or self.points.shape != (M, D):
            raise ValueError(f"points: expected (M, 2) or (M, 3), got {self.points.shape}")
        S, pose = len(self.T_base_sensor), (D + 1, D + 1)
        for name, shape, dtype in (
            ("stamp_ns", (T,), np.int64),
            ("offset", (T + 1,), np.int64),
            ("points", (M, D), np.float32),
            ("hit", (M,), np.bool_),
            ("sensor", (T,), np.int32),
            ("T_base_sensor", (S, *pose), np.float64),
            ("T_odom_base", (T, *pose), np.float64),
            ("T_recorded_base", (T, *pose), np.float64),
            ("record", (T,), np.int64),
            ("beam_time", (M,), np.float32),
        ):
            array = getattr(self, name)
            if array is not None and (array.shape != shape or array.dtype != dtype):
                given = f"{array.shape} {array.dtype}"
                raise ValueError(f"{name}: expected {shape} {np.dtype(dtype)}, got {given}")
        if self.beam_time is not None:
            for block in arrays.iter_blocks(self.beam_time):
                if not np.all(np.abs(self.beam_time[block]) <= MAX_BEAM_TIME):
                    raise ValueError(f"beam_time: expected up to {MAX_BEAM_TIME:g} s")
        if not are_dated(self.stamp_ns):
            raise ValueError("stamp_ns: expected times from 1824 to 2116")
        ends = (self.offset[0], self.offset[-1])
        if ends != (0, M) or np.any(self.offset[1:] < self.offset[:-1]):
            raise ValueError(f"offset: must not decrease, from 0 to {M}")
        if T and (self.sensor.min() < 0 or self.sensor.max() >= S):
            raise ValueError(f"sensor: indices must lie in [0, {S})")

    def __repr__(self) -> str:
        seconds = float(self.stamp_ns[-1] - self.stamp_ns[0]) * 1e-9 if self.n_scans else 0.0
        odometry = "no odometry" if self.T_odom_base is None else "odometry"
        images = "" if self.images is None else f", {len(self.images)} images"
        return (
            f"<Recording: {self.n_scans} scans with {self.n_beams} beams in {self.dimension}D, "
            f"{seconds:.1f} s, {odometry}{images}>"
        )

    @property
    def n_scans(self) -> int:
        return len(self.stamp_ns)

    @property
    def n_beams(self) -> int:
        return len(self.points)

    @property
    def dimension(self) -> int:
        return int(self.points.shape[-1])

    def beams_of(self, scan: int) -> slice:
        """The beams of one scan as a slice of per-beam arrays."""
        return slice(int(self.offset[scan]), int(self.offset[scan + 1]))

    def allocate_per_beam(self, dtype: DTypeLike, row: tuple[int, ...] = ()) -> NDArray[Any]:
        """Allocate an uninitialized array (M, *row), memory-mapped where it is large.

        Raises:
            OSError: the disk is full.
        """
        return arrays.empty((self.n_beams, *row), dtype, self.scratch)

    def copy_beams(self) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Copies of `points` and `hit` to change, memory-mapped where they are large."""
        return arrays.copy(self.points, self.scratch), arrays.copy(self.hit, self.scratch)

    def release_pages(self, *more: NDArray[Any]) -> None:
        """Release the resident pages of the per-beam arrays, and of others."""
        for array in (self.points, self.hit, self.beam_time, *more):
            if array is not None:
                arrays.release_pages(array)

    def iter_scans(self, scans: Iterable[int], *more: NDArray[Any]) -> Iterator[int]:
        """Yield the scan indices, releasing pages of per-beam and other arrays on the way."""
        rows = self.n_beams / max(self.n_scans, 1)
        return arrays.release_periodically(scans, lambda: self.release_pages(*more), rows)

    def T_map_sensor(self, T_map_base: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sensor poses (T, D+1, D+1) of robot poses (T, D+1, D+1)."""
        return T_map_base @ self.T_base_sensor[self.sensor]

    def scans_of(self, beams: NDArray[np.intp]) -> NDArray[np.intp]:
        """(n,) scan indices of beams (n,)."""
        return np.searchsorted(self.offset, beams, side="right") - 1

    def end_points(
        self, beams: NDArray[np.intp], T_map_base: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(n, D) end points in the map frame (m) of ascending beams (n,), at robot poses
        (T, D+1, D+1)."""
        D, ends = self.dimension, np.empty((len(beams), self.dimension))
        for part in arrays.split_by_block(beams, _BLOCK):
            scan = self.scans_of(beams[part])
            if len(scan) < self.n_scans:  # few beams: only the poses of their scans
                T = T_map_base[scan] @ self.T_base_sensor[self.sensor[scan]]
            else:
                T = self.T_map_sensor(T_map_base)[scan]
            points = self.points.take(beams[part], axis=0).astype(np.float64)
            ends[part] = np.einsum("nij,nj->ni", T[:, :D, :D], points) + T[:, :D, D]
            self.release_pages()
        return ends

    def slice_scans(self, first: int, end: int) -> Recording:
        """Scans first:end, as views of the arrays, and all images."""
        rows, beams = slice(first, end), slice(int(self.offset[first]), int(self.offset[end]))
        of_scans = ("T_odom_base", "T_recorded_base", "record")
        given = {name: array for name in of_scans if (array := getattr(self, name)) is not None}
        return replace(
            self,
            stamp_ns=self.stamp_ns[rows],
            offset=self.offset[first : end + 1] - self.offset[first],
            points=self.points[beams],
            hit=self.hit[beams],
            sensor=self.sensor[rows],
            beam_time=None if self.beam_time is None else self.beam_time[beams],
            **{name: array[rows] for name, array in given.items()},
        )

    @property
    def beam_time_span(self) -> tuple[float, float]:
        """Seconds from a scan's stamp to its first and to its last beam, over all scans."""
        times = self.beam_time
        if times is None or not len(times):
            return 0.0, 0.0
        parts = [(float(times[b].min()), float(times[b].max())) for b in arrays.iter_blocks(times)]
        return min(low for low, _ in parts), max(high for _, high in parts)

    def without_odometry(self) -> Recording:
        """The recording without odometry."""
        return replace(self, T_odom_base=None)


def beam_stamps_ns(recording: Recording, scans: slice) -> NDArray[np.int64]:
    """(n,) stamp in nanoseconds of each beam of a slice of scans."""
    offset = recording.offset[scans.start : scans.stop + 1]
    stamps = np.repeat(recording.stamp_ns[scans], np.diff(offset))
    if recording.beam_time is None:
        return stamps
    seconds = recording.beam_time[offset[0] : offset[-1]].astype(np.float64)
    return np.asarray(stamps + np.round(1e9 * seconds).astype(np.int64))


def max_scan_duration_ns(recording: Recording) -> int:
    """Maximum time in nanoseconds from the stamp of a scan to its beams.

    Without beam times the median time between stamps (of all sensors, which may be interleaved).
    """
    steps, times = np.diff(recording.stamp_ns), recording.beam_time
    longest = float(np.median(steps)) if len(steps) else 0.0
    if times is not None:
        for block in arrays.iter_blocks(times):
            longest = max(longest, 1e9 * float(np.abs(times[block]).max()))
    return int(np.ceil(longest))
