"""The spaced scans of a whole run, in temporary files: loops may lead back to any of them."""

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
    """Spaced scans, appended.

    Args:
        dimension: 2 or 3.
        folder: of the temporary files; None: the system's.
    """

    def __init__(self, dimension: int, folder: Path | None = None) -> None:
        D = dimension
        scan = [
            ("stamp_ns", np.int64),
            ("count", np.int64),
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
        self._mounts: dict[str | int, Float] = {}

    def __len__(self) -> int:
        return len(self._scans)

    def append(self, scan: MappedScan, explained: float, drift: Float) -> None:
        """Append a scan; see `SpacedView`. While the disk is full it stays in memory."""
        beams = scan.beams
        self._mounts.setdefault(beams.sensor, beams.T_base_sensor)
        row = np.zeros(1, self._scan)
        row["stamp_ns"], row["count"] = beams.stamp_ns, len(beams.points)
        row["sensor"] = list(self._mounts).index(beams.sensor)
        row["pose"], row["travelled"] = scan.T_map_base, scan.travelled
        row["explained"], row["drift"] = explained, drift
        with suppress(OSError):
            append_together(zip(self._arrays, (row, beams.points, beams.hit, scan.e), strict=True))

    def view(self) -> SpacedView:
        """All scans so far."""
        scans = self._scans.view()
        offset = np.concatenate([np.zeros(1, np.int64), np.cumsum(scans["count"])])
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
        for array in self._arrays:
            array.close()
