"""The spaced scans of a whole run, in temporary files: loops may lead back to any of them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.live.growing_array import GrowingArray
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
        fields = [
            ("stamp_ns", np.int64),
            ("sensor", np.int64),
            ("pose", np.float64, (D + 1, D + 1)),
            ("travelled", np.float64),
            ("explained", np.float64),
            ("drift", np.float64, (3, 3)),
        ]
        self._scans = GrowingArray(np.dtype(fields), scratch=folder)
        self._points = GrowingArray(np.float32, (D,), scratch=folder)
        self._hit = GrowingArray(np.bool_, scratch=folder)
        self._e = GrowingArray(np.float32, scratch=folder)
        self._offset = GrowingArray(np.int64, scratch=folder)
        self._offset.append(np.zeros(1, np.int64))
        self._mounts: dict[str | int, Float] = {}

    def __len__(self) -> int:
        return len(self._scans)

    def append(self, scan: MappedScan, explained: float, drift: Float) -> None:
        """Append a scan; see `SpacedView`.

        Raises:
            OSError: the disk is full.
        """
        beams = scan.beams
        self._mounts.setdefault(beams.sensor, beams.T_base_sensor)
        row = np.zeros(1, self._scans.dtype)
        row["stamp_ns"] = beams.stamp_ns
        row["sensor"] = list(self._mounts).index(beams.sensor)
        row["pose"], row["travelled"] = scan.T_map_base, scan.travelled
        row["explained"], row["drift"] = explained, drift
        self._points.append(beams.points)
        self._hit.append(beams.hit)
        self._e.append(scan.e)
        self._offset.append(np.array([len(self._e)]))
        self._scans.append(row)

    def view(self) -> SpacedView:
        """All scans so far."""
        scans = self._scans.view()
        recording = Recording(
            stamp_ns=scans["stamp_ns"].copy(),
            offset=np.array(self._offset.view()),
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
        for array in (self._scans, self._points, self._hit, self._e, self._offset):
            array.close()
