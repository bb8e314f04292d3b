"""Incremental scan matching in 2D: each scan is matched (9), then added to the local map (10)."""

import numpy as np

import stillmap._core as _core
from stillmap.core.array_types import Float, Float32, Index
from stillmap.core.recording import Recording
from stillmap.slam import motion_model
from stillmap.slam.front_end import Evidence, FrontEnd
from stillmap.slam.local_map import LocalMap, travelled_distance
from stillmap.slam.motion_model import MotionPrior
from stillmap.slam.options import SlamOptions
from stillmap.slam.relocalization import is_gap
from stillmap.slam.scan_hits import FREE_SPACE_MARGIN, select_hits
from stillmap.slam.scan_matching import ScanMatch, accept_prior, is_inconsistent
from stillmap.slam.types import BareStretch, Diagnostics, MStepResult, ScanProgress

# featureless stretches: m, from which a step is hardly measured; scans that are measured within one
# of them; m, std of the length from which one is named
_MIN_STEP_STD, _MAX_GAP, _MIN_STD = 0.04, 10, 0.3


def register_scans(
    recording: Recording,
    e: Float32,
    options: SlamOptions,
    progress: ScanProgress,
    max_travel: float = np.inf,
    free_space_margin: float = FREE_SPACE_MARGIN,
    *,
    search_wider: bool = True,
    faults: Index | None = None,
) -> MStepResult:
    """Poses by incremental maximum likelihood.

    The grid of the result is empty: the local map lacks beams without a return and most scans.

    Args:
        recording: 2D.
        e: (M,) P(static) of every beam.
        options: see SlamOptions.
        progress: called with the number of scans done and their total.
        max_travel: m of travel after which a scan leaves the local map.
        free_space_margin: m before its end in which a beam is not used as free space.
        search_wider: whether a scan that does not fit near its prior is searched for.
        faults: (n,) scans at which odometry fails.
    """
    T = recording.n_scans
    odometry = _ScanOdometry(recording, e, options, max_travel, free_space_margin, search_wider)
    if odometry.steps is not None and faults is not None:
        odometry.steps.plausible[faults - 1] = False
    progress(1, T)
    first = 1
    while first < T:
        for t in recording.iter_scans(range(first, T), e):
            odometry.register(t)
            progress(t + 1, T)
            if odometry.front_end.is_carried:
                break
        first = odometry.go_back() if odometry.front_end.is_carried else T
    return odometry.result()


class _ScanOdometry:
    """State of incremental scan matching; arguments as of `register_scans`."""

    def __init__(
        self,
        recording: Recording,
        e: Float32,
        options: SlamOptions,
        max_travel: float,
        free_space_margin: float,
        search_wider: bool,
    ) -> None:
        T, odometry = recording.n_scans, recording.T_odom_base
        self.recording, self.e, self.options = recording, e, options
        self.max_travel, self.search_wider = max_travel, search_wider
        grid = _core.OccupancyGrid2D(options.resolution, free_space_margin)
        self.local_map = LocalMap(grid, recording, e)
        self.front_end = FrontEnd(options.odometry)
        self.poses = np.tile(np.eye(3), (T, 1, 1))
        self.covariance, self.explained = np.zeros((T, 3, 3)), np.ones(T)
        self.drift, self.unmeasured = np.zeros((T, 3, 3)), np.zeros(T)
        self.widened, self.odometry_faults, self.possible_faults = np.zeros((3, T), np.bool_)
        self.breaks = list[int]()
        self.steps = (
            None
            if odometry is None
            else motion_model.compute_odometry_steps(odometry, recording.stamp_ns)
        )
        self.seconds_before = np.append(0.0, 1e-9 * np.diff(recording.stamp_ns))
        self.seconds = float(np.median(self.seconds_before[1:])) if T > 1 else 0.0
        self.travelled = 0.0
        self.local_map.add(0, self.poses[0], 0.0)

    def register(self, t: int) -> None:
        """Matches scan t and adds it to the local map."""
        front_end = self.front_end
        prior, learned, alternative = self._priors(t)
        scan, s = select_hits(self.recording, self.e, t), int(self.recording.sensor[t])
        seconds, grid = float(self.seconds_before[t]), self.local_map.grid
        # without odometry, the first scan of a sensor with another view has nothing to match
        has_map = prior.is_odometry or self.local_map.has_sensor(s)
        is_seen = len(scan.points) > 0 and self.local_map.has_sensor(s)
        match, poor = accept_prior(prior), False
        evidence = Evidence.AGREES if is_seen else Evidence.UNKNOWN
        if has_map:
            match, poor = front_end.match(grid, scan, s, prior, learned, alternative)
            poor = poor and is_seen
        motion = learned or prior
        is_off = is_inconsistent(motion, match.T_map_base)
        is_off = is_off or (is_seen and not front_end.confirms(motion, match, s))
        after_gap = is_gap(seconds, self.seconds, motion.translation_std)
        if is_off and after_gap and self.search_wider:
            # one scan that fits somewhere near does not say where the robot went, or was carried,
            # while nothing was recorded: all that follow decide
            self._start_segment(t, motion)
            return
        if poor and self.search_wider:
            match, evidence = front_end.search_wider(grid, scan, s, prior, alternative, match)
        front_end.weigh(t, match.T_map_base, seconds, evidence)
        leaps = self.steps is not None and not self.steps.plausible[t - 1]
        is_fault = leaps or match.contradicts_odometry
        self._record(t, match, is_fault=is_fault)
        self._note_drift(t, motion, match, seconds)
        if is_seen:
            front_end.learn(s, motion, match, self.seconds)
        self.travelled += front_end.advance(match.T_map_base, is_fault=is_fault)
        if evidence is not Evidence.CONTRADICTS:
            self.local_map.add(t, match.T_map_base, self.travelled)
        self.local_map.remove_before(self.travelled - self.max_travel)

    def go_back(self) -> int:
        """Start a segment before which the robot was carried; the first scan after its first."""
        t = self.front_end.first_contradicting
        assert t is not None
        self.front_end.pose = self.front_end.before = self.poses[t - 1]
        prior, learned, _ = self._priors(t)
        self._start_segment(t, learned or prior)
        return t + 1

    def _priors(self, t: int) -> tuple[MotionPrior, MotionPrior | None, MotionPrior | None]:
        """Of scan t: the prior, the same with the odometry noise learned so far, and the
        alternative to it: odometry and prediction."""
        guess = self.front_end.predict()
        if self.steps is None:
            return guess, None, None
        increment = self.steps.increments[t - 1]
        measured = self.front_end.follow_odometry(increment, learned=False)
        if not self.steps.plausible[t - 1]:
            return guess, None, measured
        return measured, self.front_end.follow_odometry(increment, learned=True), guess

    def _start_segment(self, t: int, prior: MotionPrior) -> None:
        """Starts a new local map where the prior leads: loop closure decides where it belongs."""
        match = accept_prior(prior)
        self.breaks.append(t)
        self.local_map.clear()
        self.front_end.agree()
        self._record(t, match, is_fault=False)
        self._note_drift(t, prior, match, float(self.seconds_before[t]))
        self.travelled += self.front_end.advance(match.T_map_base, is_first=True)
        self.local_map.add(t, match.T_map_base, self.travelled)

    def _record(self, t: int, match: ScanMatch, *, is_fault: bool) -> None:
        self.poses[t], self.covariance[t] = match.T_map_base, match.covariance
        self.explained[t], self.widened[t] = match.explained, match.widened
        self.odometry_faults[t] = is_fault
        self.possible_faults[t] = match.may_be_fault

    def _note_drift(self, t: int, prior: MotionPrior, match: ScanMatch, seconds: float) -> None:
        self.drift[t] = motion_model.blind_drift(prior, match.covariance)
        self.unmeasured[t] = motion_model.unmeasured_variance(prior, match.covariance, seconds)

    def result(self) -> MStepResult:
        """Poses and diagnostics of all scans."""
        diagnostics = Diagnostics(
            np.flatnonzero(self.widened).tolist(),
            np.flatnonzero(self.odometry_faults).tolist(),
            np.flatnonzero(self.possible_faults).tolist(),
            self.breaks,
            bare_stretches=_find_bare_stretches(self.unmeasured, self.poses, self.breaks),
        )
        grid = _core.OccupancyGrid2D(self.options.resolution)
        return MStepResult(
            self.poses, self.covariance, grid, self.explained, self.drift, diagnostics
        )


def _find_bare_stretches(variance: Float, poses: Float, breaks: list[int]) -> list[BareStretch]:
    """Stretches whose length the scans do not show, as along the bare walls of a corridor.

    There a pose is where the motion model predicts it. Without odometry that is constant velocity,
    which inherits the error of every pose, so that the errors of the steps add up.

    Args:
        variance: (T,) m^2 of the step to each scan.
        poses: (T, 3, 3) T_map_base.
        breaks: scans at which a stretch ends.
    """
    steps = np.flatnonzero(variance > _MIN_STEP_STD**2)
    travelled = travelled_distance(poses)
    ends = np.flatnonzero(np.diff(steps) > _MAX_GAP) + 1
    stretches = []
    for part in np.split(steps, np.union1d(ends, np.searchsorted(steps, sorted(breaks)))):
        std = float(np.sqrt(variance[part].sum()))
        if std >= _MIN_STD:
            first, last = int(part[0]) - 1, int(part[-1])
            metres = float(travelled[last] - travelled[first])
            stretches.append(BareStretch(first, last, metres, std))
    return stretches
