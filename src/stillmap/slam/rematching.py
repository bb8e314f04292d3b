"""Scans matched anew within short windows: a second opinion on poses, whoever estimated them."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from stillmap.core import se2, se3
from stillmap.core.array_types import Float, Index
from stillmap.core.recording import Recording
from stillmap.prepare.options import MAX_POINT_DISTANCE
from stillmap.slam.lidar_odometry import register_sweeps
from stillmap.slam.odometry_2d import register_scans
from stillmap.slam.options import SlamOptions
from stillmap.slam.scan_hits import beams_of_scans, sees_all_round, select_beams, thin_scans

_RESOLUTION = 0.1  # m, of the map that scans are matched against, whatever that of the result
_P_STATIC = 0.9  # of every return: labels are not asked
_WINDOW = {2: 360, 3: 48}  # scans of a window, by dimension
_MAX_SPACING, _MAX_STEP = 0.5, 0.5  # s and m between the scans of a window
_SCANS_PER_WINDOW = {2: 1500, 3: 480}  # of the recording, at that spacing
_MAX_WINDOWS = 4
_MAX_BEAMS = 20_000  # of a scan; of larger ones every so many beams are used
_MAX_POINTS = 1500  # of these in 3D that are registered: more are not needed for a median


class Window(NamedTuple):
    """Some scans of a recording.

    Attributes:
        scans: (n,) of the whole recording, rising.
        beams: (m,) of the whole recording, rising: all of these scans, or every so many.
        recording: these.
        poses: (n, D+1, D+1) T_map_base as given.
        rematched: (n, D+1, D+1) matched anew; the first one is that given. None of cameras and
            lidars in 3D that do not see all round: lidar odometry is not made for these.
    """

    scans: Index
    beams: Index
    recording: Recording
    poses: Float
    rematched: Float | None

    def disagreement(self) -> float | None:
        """Median distance in metres between given and new poses after half of the window."""
        if self.rematched is None:
            return None
        lag = len(self.poses) // 2
        given, new = (
            se2.inverse(T[: len(T) - lag]) @ T[lag:] for T in (self.poses, self.rematched)
        )
        apart = (se2.inverse(given) @ new)[:, :-1, -1]
        return float(np.median(np.linalg.norm(apart, axis=1)))

    def split(self, length: int) -> Iterator["Window"]:
        """Parts of about `length` scans each."""
        n = len(self.scans)
        for part in np.array_split(np.arange(n), max(1, round(n / length))):
            beams = beams_of_scans(self.recording, part, _MAX_BEAMS)
            yield Window(
                self.scans[part],
                self.beams[np.concatenate(beams)],
                select_beams(self.recording, part, beams, self.poses[part]),
                self.poses[part],
                None if self.rematched is None else self.rematched[part],
            )


def rematch_windows(recording: Recording, poses: Float, threads: int = 1) -> Iterator[Window]:
    """Yields windows spread over a recording.

    Each scan is matched to the map of those before it in its window; the poses given take the part
    of odometry.

    Args:
        recording: 2D or 3D, deskewed.
        poses: (T, D+1, D+1) T_map_base.
        threads: does not change the result.
    """
    can_match = recording.dimension == 2 or sees_all_round(recording)
    for selected in select_windows(recording, poses):
        scans = _drop_far(selected, poses)
        beams = beams_of_scans(recording, scans, _MAX_BEAMS)
        window = select_beams(recording, scans, beams, np.ascontiguousarray(poses[scans]))
        rematched = _rematch(window, poses[scans], threads) if can_match else None
        yield Window(scans, np.concatenate(beams), window, poses[scans], rematched)


def select_windows(recording: Recording, poses: Float) -> list[Index]:
    """The scans of each window, evenly spread over the recording."""
    T, D = recording.n_scans, recording.dimension
    every = _spacing(recording, poses)
    span = min(_WINDOW[D] * every, T)
    count = min(max(1, T // (every * _SCANS_PER_WINDOW[D])), _MAX_WINDOWS)
    first = np.linspace(0, T - span, count).astype(np.int64)
    return [np.arange(a, a + span, every) for a in first.tolist()]


def _drop_far(scans: Index, poses: Float) -> Index:
    """The scans whose poses are within reach of most others: no beam of the others is used."""
    xyz = poses[scans, :-1, -1]
    distance = np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)
    return np.asarray(scans[distance <= max(MAX_POINT_DISTANCE, float(distance.min()))])


def _spacing(recording: Recording, poses: Float) -> int:
    """Every so many scans are used: close ones show nothing new."""
    if recording.n_scans < 2:
        return 1
    seconds = 1e-9 * float(np.median(np.diff(recording.stamp_ns)))
    step = float(np.mean(np.linalg.norm(np.diff(poses[:, :-1, -1], axis=0), axis=1)))
    every = min(_MAX_SPACING / max(seconds, 1e-3), _MAX_STEP / max(step, 1e-3))
    return max(1, min(int(every), recording.n_scans // _WINDOW[recording.dimension]))


def _rematch(window: Recording, poses: Float, threads: int) -> Float:
    e = np.full(window.n_beams, _P_STATIC, np.float32)
    options = SlamOptions(resolution=_RESOLUTION)
    if window.dimension == 2:
        window, e = thin_scans(window, e)
        # a wider search would mend poses given that jump, and agree with none of their neighbours
        matched = register_scans(window, e, options, lambda *_: None, search_wider=False).poses
        return se2.normalize(poses[0] @ se2.inverse(matched[0]) @ matched)
    sweeps = register_sweeps(window, e, options.odometry, lambda *_: None, threads, _MAX_POINTS)
    return se3.normalize(poses[0] @ se2.inverse(sweeps.poses[0]) @ sweeps.poses)
