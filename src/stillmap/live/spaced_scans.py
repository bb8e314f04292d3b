"""The spaced scans of a whole run, in temporary files: loops may lead back to any of them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import ArrayBuilder
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.live.local_map import MappedScan
from stillmap.live.scan import ScanBeams

Float = NDArray[np.float64]

_IN_MEMORY = 1 << 18  # bytes of each array that are not yet in its file


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
        self._arrays: list[ArrayBuilder] = []

        def array(dtype: type, *row: int) -> ArrayBuilder:
            self._arrays.append(ArrayBuilder(dtype, row, folder, _IN_MEMORY))
            return self._arrays[-1]

        D = dimension
        self._stamp_ns, self._count, self._sensor = array(np.int64), array(np.int64), array(int)
        self._points, self._hit = array(np.float32, D), array(np.bool_)
        self._e, self._poses = array(np.float32), array(np.float64, D + 1, D + 1)
        self._travelled, self._explained = array(np.float64), array(np.float64)
        self._drift = array(np.float64, 3, 3)
        self._mounts: dict[str | int, Float] = {}

    def __len__(self) -> int:
        return len(self._stamp_ns)

    def append(self, scan: MappedScan, explained: float, drift: Float) -> None:
        """Append a scan; see `SpacedView`.

        Raises:
            OSError: the disk is full.
        """
        beams = scan.beams
        self._mounts.setdefault(beams.sensor, beams.T_base_sensor)
        for array, value in (
            (self._stamp_ns, beams.stamp_ns),
            (self._count, len(beams.points)),
            (self._sensor, list(self._mounts).index(beams.sensor)),
            (self._travelled, scan.travelled),
            (self._explained, explained),
        ):
            array.append(np.array([value]))
        for array, rows in (
            (self._points, beams.points),
            (self._hit, beams.hit),
            (self._e, scan.e),
            (self._poses, scan.T_map_base[None]),
            (self._drift, drift[None]),
        ):
            if len(rows):
                array.append(rows)

    def view(self) -> SpacedView:
        """All scans so far."""
        offset = np.concatenate([np.zeros(1, np.int64), np.cumsum(self._count.view())])
        recording = Recording(
            stamp_ns=np.array(self._stamp_ns.view()),
            offset=offset.astype(np.int64),
            points=self._points.view(),
            hit=self._hit.view(),
            T_base_sensor=np.array(list(self._mounts.values())),
            sensor=self._sensor.view().astype(np.int32),
            T_odom_base=None,
        )
        arrays = (self._poses, self._travelled, self._explained, self._drift)
        return SpacedView(recording, self._e.view(), *(np.array(a.view()) for a in arrays))

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
