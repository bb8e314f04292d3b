"""Causal scan matching in 2D: each scan is matched (9) against a map of the scans before it."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float, Float32
from stillmap.live.dead_reckoning import DeadReckoning
from stillmap.live.local_map import Labeller, LocalMap, MappedScan
from stillmap.live.odometry_faults import Fault, OdometryFaults
from stillmap.live.registration import Crowd, Registration
from stillmap.live.scan import ScanBeams, deskew
from stillmap.slam import motion_model, scan_hits
from stillmap.slam.deskew import MAX_SPEED, MAX_TURN_RATE
from stillmap.slam.front_end import Evidence, FrontEnd
from stillmap.slam.heading_alignment import DirectionDensity, Directions, HeadingOffset
from stillmap.slam.motion_model import MotionPrior
from stillmap.slam.options import SlamOptions
from stillmap.slam.scan_hits import Scan
from stillmap.slam.scan_matching import ScanMatch, accept_prior

_MAX_REGISTERED = 600  # end points of a scan that are registered
_KERNEL = np.radians(1.0)  # std of the normals about the direction of a wall
_MIN_TRAVEL = 8.0  # m after which directions are known
# normals of one wall share their errors: evidence of each; std of a building's walls about its
# directions, rad, which one metre of travel shows once
_EVIDENCE, _MIN_STD = 0.1, np.radians(0.3)
# share of the usual explained one below which nothing of a scan is in the local map, though the
# robot moved on
_NOTHING = 0.15
_FAST = 0.05  # s between fast scans: work that is due for several ones would delay their poses


def select_hits(beams: ScanBeams) -> Scan:
    """The hits of a scan in the base frame with weight 1, and the normals of their surfaces."""
    points = scan_hits.transform_points(beams.points[beams.hit], beams.T_base_sensor)
    return scan_hits.make_scan(points, np.ones(len(points), np.float32), beams.T_base_sensor)


def thin(hits: Scan) -> Scan:
    """Hits for registration, of weights P(static): more than so many say no more."""
    every = slice(None, None, max(-(-len(hits.points) // _MAX_REGISTERED), 1))
    names = ("points", "weights", "normals", "isotropy")
    thinned = {name: np.ascontiguousarray(getattr(hits, name)[every]) for name in names}
    shares = scan_hits.evidence_shares(thinned["points"])
    return replace(hits, **thinned, shares=shares).reweight(thinned["weights"])


class WallDirections:
    """Directions of the walls so far, weighted by travel."""

    def __init__(self) -> None:
        self._seen, self._travelled = Directions(), 0.0

    def add(self, scan: Scan, T: Float, metres: float) -> None:
        """Add the normals of a scan at a pose (3, 3), `metres` after the last one."""
        directions = Directions.of_scan(scan, float(se2.parameters(T)[2]))
        self._seen.weights += min(metres, 1.0) * directions.weights
        self._travelled += min(metres, 1.0)

    def rotate(self, angle: float) -> None:
        """Rotate the frame, in which directions are, by `angle` rad."""
        self._seen = self._seen.rotate(angle)

    def measure(self, scan: Scan, T: Float) -> HeadingOffset | None:
        """Correction of the heading of a scan at a pose T (3, 3); None: it is not defined."""
        if self._travelled < _MIN_TRAVEL or not self._seen.weights.any():
            return None
        density = DirectionDensity(self._seen, _KERNEL)
        directions = Directions.of_scan(scan, float(se2.parameters(T)[2]))
        offset = density.measure(directions, _EVIDENCE)
        if offset is None:
            return None
        return offset._replace(variance=max(offset.variance, _MIN_STD**2))


def correct_heading(T: Float, covariance: Float, offset: HeadingOffset) -> Float:
    """A pose (3, 3) with covariance (3, 3) after a Kalman update by its heading's offset."""
    gain = covariance[:, 2] / (covariance[2, 2] + offset.variance)
    return np.asarray(se2.matrix(*(se2.parameters(T) + offset.value * gain)))


class ScanOdometry:
    """Poses of scans as they arrive.

    Args:
        options: see SlamOptions.

    Attributes:
        crowd: people who move along with the robot.
    """

    def __init__(self, options: SlamOptions) -> None:
        self.options = options
        self.local_map = LocalMap(options.resolution)
        self.left_behind = self.local_map  # the one before the robot was carried
        self.travelled = 0.0
        self.crowd = Crowd()
        self._front_end = FrontEnd(options.odometry)
        self._stamp_ns, self._seconds = 0, 0.0
        self._reckoning = DeadReckoning()
        self._is_adrift = False  # after a blind stretch no scan showed yet where the robot is
        self._walls: WallDirections | None = WallDirections()
        self._is_first = True
        self._faults = OdometryFaults(options.odometry)

    def predict(self, beams: ScanBeams, increment: Float | None) -> MotionPrior:
        """The prior of the next scan, see `OdometryFaults.predict`.

        Args:
            beams: of the scan.
            increment: (3, 3) of odometry since the last scan; None: there is none.
        """
        if self._is_first:
            return motion_model.gaussian_prior(self._front_end.pose, 1e-3, 1e-3)
        ns, seconds, front_end = beams.stamp_ns, self._seconds_to(beams), self._front_end
        prior = None if increment is None else front_end.follow_odometry(increment, learned=False)
        return self._faults.predict(prior, front_end.predict(), increment, ns, seconds)

    def select(self, beams: ScanBeams, prior: MotionPrior) -> Scan:
        """The hits of a scan with weight 1, without the motion that is predicted during it.

        The crowd observes them.
        """
        hits = select_hits(deskew(beams, self._twist_to(prior.T_map_base, beams)))
        self.crowd.observe(hits.points, self._faults.increment, beams.stamp_ns)
        return hits

    def end_points(self, hits: Scan, prior: MotionPrior) -> tuple[Float32, Float]:
        """(N, 2) points in the base frame at the stamp, and its pose, as predicted."""
        return hits.points, prior.T_map_base

    def register(
        self, beams: ScanBeams, hits: Scan, prior: MotionPrior, increment: Float | None
    ) -> Registration:
        """Register a scan.

        Args:
            beams: of the scan.
            hits: with weights P(static).
            prior: of `predict`.
            increment: as of `predict`.
        """
        scan, twist = thin(hits), self._twist_to(prior.T_map_base, beams)
        front_end = self._front_end
        learned = self._learned_prior(prior, increment)
        match = self._match(beams, scan, prior, learned)
        is_carried, is_slipping = front_end.is_carried, False
        if is_carried:
            self._start_anew()
            match = accept_prior(prior)
        elif not self._is_first:
            is_rejected = increment is not None and not prior.is_odometry
            is_slipping = match.contradicts_odometry or is_rejected
            fault = self._detect_fault(beams, scan, match)
            if fault is not None:
                front_end.pose, match, is_slipping = fault.before, fault.match, True
                learned = self._learned_prior(prior, increment)  # the last pose has changed
        if not is_carried:
            match = self._correct_heading(scan, match)
        is_blind = not len(scan.points) or float(scan.weights.sum()) <= 0.0 or self._is_adrift
        learned = learned or prior
        drift = motion_model.blind_drift(learned, match.covariance)
        is_known = not (is_blind or self._is_contradicted or self._reckoning.is_far)
        if is_known and self.local_map.has_sensor(beams.sensor):
            front_end.learn(beams.sensor, learned, match, self._seconds)
        if is_blind:
            self._reckoning.move(front_end.pose, match.T_map_base, drift)
        else:
            self._reckoning.reset()
        self._advance(beams, match.T_map_base, is_slipping)
        is_contradicted = self._is_contradicted or self._is_adrift
        doubts = is_slipping, is_blind, is_carried, is_contradicted, prior.is_odometry
        T, covariance = match.T_map_base, match.covariance + self._reckoning.covariance
        return Registration(T, covariance, match.explained, drift, twist, *doubts)

    def add(
        self, beams: ScanBeams, e: Float32, recent: Float32, label: Labeller
    ) -> MappedScan | None:
        """Add the last scan to the local map, unless it contradicts it or is too close to the one
        before; the scan if it was added.

        Args:
            beams: of the scan.
            e: (N,) P(static).
            recent: (N,) the same with the prior of what was only just seen, for the local map.
            label: labels an earlier scan again, after a second.
        """
        if self._is_contradicted or self._is_adrift:
            return None
        scan = MappedScan(beams, e, self._front_end.pose, self.travelled)
        added = self.local_map.add(replace(scan, e=recent))
        most = math.inf if self._seconds >= _FAST else float(not added)
        self.local_map.tend(beams.stamp_ns, self.travelled, label, most)
        return scan if added else None

    def enter(self, local_map: Any, T: Float) -> None:
        """Go on in another map, in whose frame the frame so far has the pose T (3, 3)."""
        self.local_map = local_map
        front_end = self._front_end
        front_end.pose, front_end.before = T @ front_end.pose, T @ front_end.before
        front_end.agree()
        self._reckoning.reset()
        self._walls = None  # that map has the heading

    def correct(self, local_map: Any, motion: Float) -> None:
        """Go on with a local map made anew, after the map has moved (3, 3)."""
        if self.left_behind is self.local_map:  # nothing was: its memory is free
            self.left_behind = local_map
        self.local_map = local_map
        if self._walls is not None:
            self._walls.rotate(-float(se2.parameters(motion)[2]))

    def _correct_heading(self, scan: Scan, match: ScanMatch) -> ScanMatch:
        """The match with the heading that the walls so far suggest, too."""
        if self._walls is None:
            return match
        T = match.T_map_base
        metres = 0.0 if self._is_first else float(np.hypot(*(T - self._front_end.pose)[:2, 2]))
        offset = self._walls.measure(scan, T)
        if offset is not None:
            T = correct_heading(T, match.covariance, offset)
        self._walls.add(scan, T, metres)
        return replace(match, T_map_base=T)

    def _match(
        self, beams: ScanBeams, scan: Scan, prior: MotionPrior, learned: MotionPrior | None
    ) -> ScanMatch:
        self._is_adrift = False
        front_end, sensor, grid = self._front_end, beams.sensor, self.local_map.grid
        if not self.local_map.has_sensor(sensor) or not len(scan.points):
            return accept_prior(learned or prior)
        if self._reckoning.is_far and prior.is_odometry:
            return self._find_again(beams, scan, learned or prior)
        guess = front_end.predict() if prior.is_odometry else None
        match, poor = front_end.match(grid, scan, sensor, prior, learned, guess)
        evidence = Evidence.AGREES
        if poor:
            match, evidence = front_end.search_wider(grid, scan, sensor, prior, guess, match)
            if match.explained < _NOTHING * front_end.usual.get(sensor, 1.0):
                evidence = Evidence.CONTRADICTS
        front_end.weigh(beams.stamp_ns, match.T_map_base, self._seconds_to(beams), evidence)
        return match

    def _find_again(self, beams: ScanBeams, scan: Scan, prior: MotionPrior) -> ScanMatch:
        """The match after a stretch in which no scan met anything."""
        front_end, usual = self._front_end, self._front_end.usual.get(beams.sensor, 1.0)
        grid = self.local_map.grid
        match, evidence = self._reckoning.search(grid, scan, prior, front_end.pose, usual)
        if match is not None:
            # it was there before, too: the step is that of odometry
            front_end.pose = match.T_map_base @ se2.inverse(prior.T_map_base) @ front_end.pose
            front_end.agree()
            return match
        self._is_adrift = not self._reckoning.is_over
        if not self._is_adrift:  # from here on scans are added to the map again
            front_end.agree()
        if evidence is Evidence.CONTRADICTS:
            front_end.weigh(beams.stamp_ns, prior.T_map_base, self._seconds_to(beams), evidence)
        return accept_prior(prior)

    def _detect_fault(self, beams: ScanBeams, scan: Scan, match: ScanMatch) -> Fault | None:
        """The fault of odometry, if any; scans since it began are removed from the local map."""
        has_map = self.local_map.has_sensor(beams.sensor) and not self._is_contradicted
        fault = self._faults.detect(
            self.local_map.grid,
            scan,
            self._front_end.pose,
            match,
            has_map=has_map,
            may_stand=not (self.crowd.walks_along or self.crowd.may_walk_along),
        )
        if fault is not None:
            self.local_map.remove_since(fault.first_ns)
        return fault

    def _start_anew(self) -> None:
        self.left_behind, self.local_map = self.local_map, LocalMap(self.options.resolution)
        self._front_end.agree()
        self._is_adrift = False
        self._walls = WallDirections()
        self._faults.reset()
        self._reckoning.reset()

    def _learned_prior(self, prior: MotionPrior, increment: Float | None) -> MotionPrior | None:
        """The odometry prior with the noise learned so far; None: use `prior`."""
        if not prior.is_odometry or increment is None:
            return None
        return self._front_end.follow_odometry(increment, learned=True)

    @property
    def _is_contradicted(self) -> bool:
        """True from a scan that contradicts the local map on, until others agree with it."""
        return self._front_end.first_contradicting is not None

    def _seconds_to(self, beams: ScanBeams) -> float:
        """From the last scan."""
        return 1e-9 * (beams.stamp_ns - self._stamp_ns)

    def _twist_to(self, T: Float, beams: ScanBeams) -> Float:
        """(3,) m/s and rad/s from the last pose to that of a scan; 0 for a leap, and where all
        beams have the stamp of the scan."""
        seconds = self._seconds_to(beams)
        if self._is_first or seconds <= 0.0 or beams.beam_time is None:
            return np.zeros(3)
        twist: Float = se2.log((se2.inverse(self._front_end.pose) @ T)[None])[0] / seconds
        is_leap = np.hypot(*twist[:2]) > MAX_SPEED or abs(twist[2]) > MAX_TURN_RATE
        return np.zeros(3) if is_leap else twist

    def _advance(self, beams: ScanBeams, T: Float, is_fault: bool) -> None:
        if not self._is_first:
            seconds = self._seconds_to(beams)
            self._seconds = seconds if self._seconds == 0.0 else 0.9 * self._seconds + 0.1 * seconds
        self.travelled += self._front_end.advance(T, is_fault=is_fault, is_first=self._is_first)
        self._stamp_ns, self._is_first = beams.stamp_ns, False
