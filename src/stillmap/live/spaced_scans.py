"""The spaced scans of a whole run, in temporary files: loops may lead back to any of them."""

from array import array
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core.array_builder import QUICKLY_WRITTEN, ArrayBuilder, append_together
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.live.local_map import MappedScan
from stillmap.live.scan import ScanBeams

Float = NDArray[np.float64]

_IN_MEMORY_IF_FULL = 128 << 20  # bytes, about, while the disk is full
_LITTLE = 4 << 20  # bytes: no more wait in memory where they can be written
_UNLIMITED = 1 << 30


@dataclass(frozen=True, eq=False)
class SpacedView(ShortRepr):
    """S spaced scans with M beams.

    Attributes:
        recording: the scans, without odometry.
        e: (M,) float32, P(static).
        poses: (S, D+1, D+1) in the frame of the odometry by scans.
        travelled: (S,) m up to each.
        explained: (S,) share of each that the local map explained.
        drift: (S, 3, 3) covariance that the steps since the one before add, where scans say
            nothing.
    """

    recording: Recording
    e: NDArray[np.float32]
    poses: Float
    travelled: Float
    explained: Float
    drift: Float


class SpacedScans:
    """Spaced scans, appended. While the disk is full they are in memory: beyond 128 MB, every
    second beam of those is dropped.

    Args:
        dimension: 2 or 3.
        folder: of the temporary files; None: the system's.
    """

    def __init__(self, dimension: int, folder: Path | None = None) -> None:
        D = dimension
        scan = [
            ("stamp_ns", np.int64),
            ("sensor", np.int64),
            ("pose", np.float64, (D + 1, D + 1)),
            ("travelled", np.float64),
            ("explained", np.float64),
            ("drift", np.float64, (3, 3)),
        ]
        fields: list[tuple[DTypeLike, tuple[int, ...]]]
        fields = [(np.dtype(scan), ()), (np.float32, (D,)), (np.bool_, ()), (np.float32, ())]
        self._arrays = [ArrayBuilder(t, row, folder, QUICKLY_WRITTEN) for t, row in fields]
        self._scans, self._points, self._hit, self._e = self._arrays
        self._scan = np.dtype(scan)
        self._counts = array("q")  # of beams: those of scans in memory become fewer
        self._most = _UNLIMITED  # beams of such a scan
        self._mounts: dict[str | int, Float] = {}

    def __len__(self) -> int:
        return len(self._scans)

    def append(self, scan: MappedScan, explained: float, drift: Float) -> None:
        """Append a scan; see `SpacedView`. While the disk is full it stays in memory."""
        beams = scan.beams
        self._mounts.setdefault(beams.sensor, beams.T_base_sensor)
        row = np.zeros(1, self._scan)
        row["stamp_ns"] = beams.stamp_ns
        row["sensor"] = list(self._mounts).index(beams.sensor)
        row["pose"], row["travelled"] = scan.T_map_base, scan.travelled
        row["explained"], row["drift"] = explained, drift
        if self._memory_bytes < _LITTLE:  # there is room on the disk again
            self._most = _UNLIMITED
        some = slice(None, None, -(-max(len(scan.e), 1) // self._most))
        self._counts.append(len(scan.e[some]))
        rows = row, beams.points[some], beams.hit[some], scan.e[some]
        with suppress(OSError):
            append_together(zip(self._arrays, rows, strict=True))
        if self._memory_bytes > _IN_MEMORY_IF_FULL:
            self._make_room()

    @property
    def _memory_bytes(self) -> int:
        return sum(one.memory_bytes for one in self._arrays[1:])

    def _make_room(self) -> None:
        """Write what is in memory; if there is no room, keep half as many beams of a scan there."""
        with suppress(OSError):
            for one in self._arrays:
                one.write()
            return
        counts = np.array(self._counts)
        end = np.cumsum(counts)
        # not whole in the files: of small arrays more may be written
        scans = np.flatnonzero(end - counts >= min(one.written for one in self._arrays[1:]))
        most = int(counts[scans].max(initial=0)) // 2
        if most == 0:
            return
        self._most = most
        counts, stride = counts[scans], -(-counts[scans] // most)
        number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        kept = number % np.repeat(np.maximum(stride, 1), counts) == 0
        for one in self._arrays[1:]:
            one.select_last(kept)
        for k, count in zip(scans.tolist(), -(-counts // np.maximum(stride, 1)), strict=True):
            self._counts[k] = int(count)

    def view(self) -> SpacedView:
        """All scans so far."""
        scans = self._scans.view()
        offset = np.concatenate([np.zeros(1, np.int64), np.cumsum(self._counts)])
        recording = Recording(
            stamp_ns=scans["stamp_ns"].copy(),
            offset=offset.astype(np.int64),
            points=self._points.view(),
            hit=self._hit.view(),
            T_base_sensor=np.array(list(self._mounts.values())),
            sensor=scans["sensor"].astype(np.int32),
            T_odom_base=None,
        )
        fields = (scans[name].copy() for name in ("pose", "travelled", "explained", "drift"))
        return SpacedView(recording, self._e.view(), *fields)

    def scan(self, view: SpacedView, number: int) -> MappedScan:
        """One of the scans of a view."""
        recording = view.recording
        beams, sensor = recording.beams_of(number), int(recording.sensor[number])
        return MappedScan(
            ScanBeams(
                int(recording.stamp_ns[number]),
                np.array(recording.points[beams]),
                np.array(recording.hit[beams]),
                recording.T_base_sensor[sensor],
                list(self._mounts)[sensor],
            ),
            np.array(view.e[beams]),
            view.poses[number],
            float(view.travelled[number]),
        )

    def close(self) -> None:
        """Remove the files."""
        for one in self._arrays:
            one.close()
