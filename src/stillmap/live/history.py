"""All scans, and the poses and labels returned for them, in temporary files."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import ArrayBuilder
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.live.beam_store import BeamStore, join_parts
from stillmap.live.scan import ScanBeams

Float = NDArray[np.float64]

_IN_MEMORY = 1 << 18  # bytes of each array that are not yet in its file


@dataclass(frozen=True, eq=False)
class Answers(ShortRepr):
    """Poses and labels returned by `push` for T scans with M beams.

    Attributes:
        number: (T,) of the scans, as they were pushed: all, unless some were dropped.
        poses: (T, D+1, D+1) T_map_base as it was given.
        local: (T, D+1, D+1) in the frame of the odometry by scans, which never jumps.
        anchor: (T,) the last spaced scan at the time; -1: none yet.
        p_static: (M,) float32.
    """

    number: NDArray[np.int64]
    poses: Float
    local: Float
    anchor: NDArray[np.int64]
    p_static: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class KeptScans(ShortRepr):
    """The scans that are kept at a time, while more are appended.

    Attributes:
        number: (T,) of the scans, as they were pushed.
        load: returns them with the answers; takes long where some scans were dropped, and may be
            called in another thread.
    """

    number: NDArray[np.int64]
    load: Callable[[], tuple[Recording, Answers]]


class History:
    """Scans and answers, appended.

    Args:
        dimension: 2 or 3.
        folder: of the temporary files; None: the system's.
        max_bytes: about, of the beams, 17 bytes each, in 3D 21: beyond, every second one of the
            scans that lie most densely is dropped; None: unbounded.
    """

    def __init__(
        self, dimension: int, folder: Path | None = None, max_bytes: int | None = None
    ) -> None:
        D = dimension

        self._arrays: list[ArrayBuilder] = []

        def array(dtype: type, *row: int) -> ArrayBuilder:
            self._arrays.append(ArrayBuilder(dtype, row, folder, _IN_MEMORY))
            return self._arrays[-1]

        self._stamp_ns = array(np.int64)
        self._sensor, self._anchor = array(np.int32), array(np.int64)
        # points, hit, P(static), time of each beam
        fields = [(np.float32, (D,)), (np.bool_, ()), (np.float32, ()), (np.float32, ())]
        self._beams = BeamStore(fields, folder, max_bytes)
        self._T_odom_base = array(np.float64, D + 1, D + 1)
        self._poses, self._local = (array(np.float64, D + 1, D + 1) for _ in range(2))
        self._twist = array(np.float64, 3 if D == 2 else 6)
        self._mounts: dict[str | int, Float] = {}
        self._has_odometry, self._has_times = True, False
        self._folder = folder

    def close(self) -> None:
        """Remove the files."""
        self._beams.close()
        for array in self._arrays:
            array.close()

    def __len__(self) -> int:
        return len(self._stamp_ns)

    def append(
        self,
        beams: ScanBeams,
        p_static: NDArray[np.float32],
        T_odom_base: Float | None,
        pose: Float,
        local: Float,
        anchor: int,
        twist: Float,
    ) -> None:
        """Append a scan and the answer to it; see `Answers`.

        Args:
            beams: of the scan.
            p_static: (N,).
            T_odom_base: (D+1, D+1); None: without odometry.
            pose: (D+1, D+1).
            local: (D+1, D+1).
            anchor: a spaced scan.
            twist: (3,) or (6,) m/s and rad/s of the base during the scan, in its own frame.

        Raises:
            OSError: the disk is full.
        """
        self._mounts.setdefault(beams.sensor, beams.T_base_sensor)
        self._has_odometry &= T_odom_base is not None
        self._has_times |= beams.beam_time is not None
        times = beams.beam_time
        if times is None:
            times = np.zeros(len(beams.points), np.float32)
        self._beams.append(len(self), [beams.points, beams.hit, p_static, times])
        sensor = list(self._mounts).index(beams.sensor)
        for array, value in (
            (self._stamp_ns, beams.stamp_ns),
            (self._sensor, sensor),
            (self._anchor, anchor),
        ):
            array.append(np.array([value]))
        unknown = np.full(pose.shape, np.nan)
        odometry = unknown if T_odom_base is None else T_odom_base
        for array, T in (
            (self._T_odom_base, odometry),
            (self._poses, pose),
            (self._local, local),
            (self._twist, twist),
        ):
            array.append(T[None])

    def at(self, number: int) -> tuple[int, Float]:
        """Anchor and local pose of a scan, see `Answers`."""
        return int(self._anchor.view()[number]), np.array(self._local.view()[number])

    def twist_at(self, number: int) -> Float:
        """(3,) or (6,) m/s and rad/s of the base during a scan."""
        return np.array(self._twist.view()[number])

    def recording(self) -> Recording:
        """The scans that are kept. Odometry only if every scan had it."""
        return self.snapshot().load()[0]

    def snapshot(self) -> KeptScans:
        """The scans that are kept, and what `push` has returned for them."""
        kept, counts, parts = self._beams.kept, self._beams.counts, self._beams.parts()
        stamp_ns, sensor = self._stamp_ns.view()[kept], self._sensor.view()[kept]
        odometry = self._T_odom_base.view()[kept] if self._has_odometry else None
        mounts, has_times, folder = dict(self._mounts), self._has_times, self._folder
        poses, local, anchor = self.poses()
        poses, local, anchor = poses[kept], local[kept], anchor[kept]

        def load() -> tuple[Recording, Answers]:
            points, hit, p_static, times = join_parts(parts, folder)
            sensors = [{"name": str(name), "extrinsics": {"how": "given"}} for name in mounts]
            recording = Recording(
                stamp_ns=stamp_ns,
                offset=np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)]),
                points=points,
                hit=hit,
                T_base_sensor=np.array(list(mounts.values())),
                sensor=sensor,
                T_odom_base=odometry,
                source={"format": "live", "sensors": sensors, "warnings": []},
                beam_time=times if has_times else None,
                scratch=folder,
            )
            return recording, Answers(kept, poses, local, anchor, p_static)

        return KeptScans(kept, load)

    def poses(self) -> tuple[Float, Float, NDArray[np.int64]]:
        """`poses`, `local` and `anchor` of all scans, see `Answers`."""
        poses, local = np.array(self._poses.view()), np.array(self._local.view())
        return poses, local, np.array(self._anchor.view())
