"""Motion of a laser from its scans alone, over short segments of a recording.

Every segment has a local map of its own. Its scans are matched at constant velocity, or by a search
as wide as odometry's step is long: odometry decides how far is searched, never where. The segments
are those in which odometry says that the robot turns or travels most.
"""

import itertools
from dataclasses import dataclass

import numpy as np

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Float32, Index
from stillmap.core.recording import Recording
from stillmap.slam import scan_hits, scan_matching
from stillmap.slam.local_map import LocalMap
from stillmap.slam.motion_model import compute_odometry_steps, gaussian_prior
from stillmap.slam.scan_hits import FREE_SPACE_MARGIN, Scan
from stillmap.slam.scan_matching import ScanMatch

WINDOW = 0.8  # m or rad of motion that make a window
_SEGMENT_UNITS, _SEGMENT_SCANS = 4.0, 36  # motion and scans of a segment, at most
_MIN_UNITS = 1.0  # motion of a segment, at least
_MIN_INTERVAL = 0.12  # s between scans: of faster lasers not every scan is used
_MAX_GAP = 10.0  # s between two scans of a segment
# half width of the search: share of odometry's step, m per rad that it turns (the laser may be that
# far off the centre), m and rad beyond
_SEARCH_RATIO, _LEVER, _SEARCH_MARGIN = 1.4, 0.6, 0.1
_MAX_SEARCH = 3.0  # m; where odometry starts again elsewhere its step says nothing
_LONG_STEP = 0.4  # m or rad: constant velocity says little about a step as long
_VELOCITY_STD = 0.3  # m, rad: prior around constant velocity, hardly any
_USUAL_SHARE, _USUAL_RATE = 0.9, 0.2  # as of following; of the running mean of the explained share
_MIN_EXPLAINED = 0.35  # share of a scan that the map explains; less: lost
_PROFILE_STEP = 0.1  # m along the weakest direction by which a match is tested
_FLOOR_STD = (0.005, 0.002)  # m, rad of a match, at least


@dataclass(frozen=True, eq=False)
class MotionWindows:
    """Motions of one laser between pairs of scans, W windows in all.

    Attributes:
        first, last: (W,) scans.
        segment: (W,) the segment of each window.
        motion: (W, 3) x, y (m) and heading (rad) of the last scan in the frame of the first.
        covariance: (W, 3, 3) in that frame.
    """

    first: Index
    last: Index
    segment: Index
    motion: Float
    covariance: Float


def select_segments(recording: Recording, sensor: int, windows: int) -> list[Index]:
    """Segments of successive scans of one laser with much motion, spread over the recording.

    Args:
        recording: 2D, with odometry.
        sensor: the laser.
        windows: motion windows in all, about.
    """
    scans = np.flatnonzero(recording.sensor == sensor)
    if recording.T_odom_base is None or len(scans) < 2:
        return []
    interval = 1e-9 * float(np.median(np.diff(recording.stamp_ns[scans])))
    scans = scans[:: max(1, round(_MIN_INTERVAL / max(interval, 1e-3)))]
    steps = compute_odometry_steps(recording.T_odom_base[scans], recording.stamp_ns[scans])
    x, y, turn = np.abs(se2.parameters(steps.increments)).T
    travel = np.hypot(x, y)
    seconds = 1e-9 * np.diff(recording.stamp_ns[scans])
    parts = _split(travel + turn, steps.plausible & (seconds < _MAX_GAP))
    if not parts:
        return []
    units = float(np.mean([(travel + turn)[a : b - 1].sum() for a, b in parts])) / WINDOW
    chosen = _spread(parts, turn, travel, max(2, round(windows / max(units, 1.0))))
    return [scans[a:b] for a, b in chosen]


def _split(motion: Float, joined: Bool) -> list[tuple[int, int]]:
    """Half-open ranges of scans, cut after so much motion (T - 1,) or so many scans, without those
    in which too little happens."""
    parts, start, units = [], 0, 0.0
    for k, step in enumerate(motion, start=1):
        if not joined[k - 1]:
            if units >= _MIN_UNITS * WINDOW:
                parts.append((start, k))
            start, units = k, 0.0
            continue
        units += float(step)
        if units >= _SEGMENT_UNITS * WINDOW or k - start + 1 >= _SEGMENT_SCANS:
            if units >= _MIN_UNITS * WINDOW:
                parts.append((start, k + 1))
            start, units = k, 0.0
    if units >= _MIN_UNITS * WINDOW:
        parts.append((start, len(motion) + 1))
    return parts


def _spread(
    parts: list[tuple[int, int]], turn: Float, travel: Float, count: int
) -> list[tuple[int, int]]:
    """About `count` of the parts: of each stretch of time those that turn and travel most."""
    if count >= len(parts):
        return parts
    turned, travelled = (
        np.array([float(v[a : b - 1].sum()) for a, b in parts]) for v in (turn, travel)
    )
    chosen = set[int]()
    for stretch in np.array_split(np.arange(len(parts)), max(1, count // 2)):
        chosen.add(int(stretch[np.argmax(turned[stretch])]))
        rest = [k for k in stretch.tolist() if k not in chosen]
        if rest:
            chosen.add(max(rest, key=lambda k: (travelled[k], -k)))
    return [parts[k] for k in sorted(chosen)]


def measure_motion(
    recording: Recording, e: Float32, segments: list[Index], resolution: float
) -> MotionWindows:
    """Motion windows of a laser along segments of its scans.

    Args:
        recording: 2D, with odometry; the laser's pose on the robot does not matter.
        e: (M,) P(static) of every beam.
        segments: scans of each.
        resolution: m, edge of a map cell.
    """
    found = [_Tracker(recording, e, scans, resolution).run(k) for k, scans in enumerate(segments)]
    if not found:
        none = np.zeros(0, np.intp)
        return MotionWindows(none, none, none, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    return MotionWindows(
        *(np.concatenate([getattr(one, name) for one in found]) for name in _FIELDS)
    )


_FIELDS = tuple(MotionWindows.__dataclass_fields__)


class _Tracker:
    """Follows one segment; poses are those of the laser, the first one is the identity."""

    def __init__(self, recording: Recording, e: Float32, scans: Index, resolution: float) -> None:
        assert recording.T_odom_base is not None
        self.recording, self.e, self.scans = recording, e, scans
        self.grid = _core.OccupancyGrid2D(resolution, FREE_SPACE_MARGIN)
        self.local_map = LocalMap(self.grid, recording, e)
        self.seconds = 1e-9 * (recording.stamp_ns[scans] - recording.stamp_ns[scans[0]])
        self.poses = np.tile(np.eye(3), (len(scans), 1, 1))
        self.information = np.zeros((len(scans), 3, 3))
        self.explained = np.ones(len(scans))
        self.radius, self.angle = _search_windows(recording, scans)
        steps = se2.inverse(recording.T_odom_base[scans[:-1]]) @ recording.T_odom_base[scans[1:]]
        x, y, turn = np.abs(se2.parameters(steps)).T
        self.step_size = np.hypot(x, y) + turn

    def run(self, segment: int) -> MotionWindows:
        """Motion between scans about a unit of odometry's motion apart."""
        self.local_map.add(int(self.scans[0]), self.poses[0], 0.0)
        ends, covariances, since, usual = [0], [np.zeros((3, 3))], 0.0, 0.0
        for k in range(1, len(self.scans)):
            scan = scan_hits.select_hits(self.recording, self.e, int(self.scans[k]))
            match = self._match(k, scan, usual)
            if match.explained < _MIN_EXPLAINED:
                break  # lost: what follows is worth nothing
            usual += (_USUAL_RATE if k > 1 else 1.0) * (match.explained - usual)
            since += float(self.step_size[k - 1])
            if since >= WINDOW:
                ends.append(k)
                covariances.append(self._covariance(k, scan))
                since = 0.0
            self.local_map.add(int(self.scans[k]), self.poses[k], 0.0)
        return self._windows(ends, covariances, segment)

    def _match(self, k: int, scan: Scan, usual: float) -> ScanMatch:
        """The match of scan k, near constant velocity or by a search."""
        prior = gaussian_prior(self._predict(k), _VELOCITY_STD, _VELOCITY_STD)
        match = None
        if k > 1:
            match = scan_matching.refine_pose(self.grid, scan, prior, prior.T_map_base)
        if (
            match is None
            or match.explained < _USUAL_SHARE * usual
            or self.step_size[k - 1] > _LONG_STEP
        ):
            radius, angle = self.radius[k - 1], self.angle[k - 1]
            wide = gaussian_prior(self.poses[k - 1], radius, angle)
            found = scan_matching.search_pose(self.grid, scan, wide, radius, angle)
            if match is None or found.cost < match.cost:
                match, prior = found, wide
        self.poses[k], self.explained[k] = match.T_map_base, match.explained
        self.information[k] = np.linalg.inv(match.covariance) - prior.information
        return match

    def _predict(self, k: int) -> Float:
        last: Float = self.poses[k - 1]
        if k < 2:
            return last
        before = max(float(self.seconds[k - 1] - self.seconds[k - 2]), 1e-3)
        ahead = float(self.seconds[k] - self.seconds[k - 1])
        twist = se2.log(se2.inverse(self.poses[k - 2]) @ last)
        return last @ se2.exp(twist * min(ahead / before, 3.0))

    def _covariance(self, k: int, scan: Scan) -> Float:
        """(3, 3) of a match in the frame of the segment.

        Along the weakest direction the cost a step aside counts as well: the curvature takes the
        residual pattern of end points for information, along a bare corridor above all.
        """
        information = self.information[k] + np.diag([1.0, 1.0, 1.0])
        covariance = np.linalg.inv(information)
        variances, axes = np.linalg.eigh(covariance[:2, :2])
        weak = axes[:, 1]
        cost = scan_matching.registration_cost(self.grid, scan, self.poses[k])
        aside = []
        for side in (-_PROFILE_STEP, _PROFILE_STEP):
            pose = self.poses[k].copy()
            pose[:2, 2] += side * weak
            aside.append(scan_matching.registration_cost(self.grid, scan, pose) - cost)
        variance = _PROFILE_STEP**2 / (2.0 * max(min(aside), 5e-3))
        if variance > variances[1]:
            covariance[:2, :2] += (variance - variances[1]) * np.outer(weak, weak)
        floor = np.diag(np.square([_FLOOR_STD[0], _FLOOR_STD[0], _FLOOR_STD[1]]))
        return np.asarray(covariance + floor)

    def _windows(self, ends: list[int], covariances: list[Float], segment: int) -> MotionWindows:
        first, last = np.array(ends[:-1], np.intp), np.array(ends[1:], np.intp)
        motion = se2.parameters(se2.inverse(self.poses[first]) @ self.poses[last])
        both = np.array([a + b for a, b in itertools.pairwise(covariances)])
        in_frame = se2.rotate_covariance(both.reshape(-1, 3, 3), se2.inverse(self.poses[first]))
        return MotionWindows(
            self.scans[first],
            self.scans[last],
            np.full(len(first), segment),
            motion,
            in_frame,
        )


def _search_windows(recording: Recording, scans: Index) -> tuple[Float, Float]:
    """(N - 1,) half widths in m and rad that hold the step to each next scan of the laser,
    whichever way it is mounted."""
    odometry = recording.T_odom_base
    assert odometry is not None
    x, y, turn = np.abs(se2.parameters(se2.increments(odometry))).T
    metres, radians = (
        np.diff(np.append(0.0, size.cumsum())[scans]) for size in (np.hypot(x, y), turn)
    )
    radius = _SEARCH_RATIO * metres + _LEVER * radians + _SEARCH_MARGIN
    angle = np.minimum(_SEARCH_RATIO * radians + _SEARCH_MARGIN, np.pi)
    return np.minimum(radius, _MAX_SEARCH), angle
