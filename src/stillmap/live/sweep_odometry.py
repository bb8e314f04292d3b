"""Causal scan matching in 3D: each sweep is registered to a map of the sweeps before it."""

from typing import Any

import numpy as np

from stillmap.core import se2, se3
from stillmap.core.array_types import Float, Float32
from stillmap.live.known_cloud import KnownPlanes
from stillmap.live.local_map import Labeller, MappedScan
from stillmap.live.registration import Crowd, Registration
from stillmap.live.scan import ScanBeams, take_beams
from stillmap.slam import constant_velocity, lidar_odometry
from stillmap.slam.constant_velocity import State
from stillmap.slam.lidar_odometry import Sweep, follow_sweep
from stillmap.slam.local_map import KEYFRAME_ANGLE
from stillmap.slam.loop_closure_3d import KEYFRAME_DISTANCE
from stillmap.slam.options import SlamOptions
from stillmap.slam.scan_hits import transform_points

# sweeps from which the motion during the first one is found; m/s and rad/s of it that matter
_FIRST_SWEEPS, _MIN_MOTION = 5, 0.05
_EXPLAINED_RATE = 0.1  # weight of one sweep in the running average of the explained share
# of the usual explained share, below which a sweep contradicts the local map: it is not added, for
# it would make the map agree with those that follow
_POOR_SHARE = 0.6
_CARRIED_AFTER = 5  # sweeps in a row that contradict the local map
_FOUND_STD = (0.1, 0.02)  # m and rad, of a pose in a known map that was found


class SweepOdometry:
    """Poses of sweeps as they arrive.

    Args:
        options: see SlamOptions.
        threads: the result does not depend on it.
        spacing: m between keyframes; None: as the options say.
    """

    def __init__(self, options: SlamOptions, threads: int, spacing: float | None = None) -> None:
        self.local_map = self.left_behind = lidar_odometry.make_local_map()
        self.travelled = 0.0
        self.crowd = Crowd()  # observes nothing: people do not hide all that a lidar sees
        self._options, self._threads = options, threads
        self._spacing = spacing or options.keyframe_distance or KEYFRAME_DISTANCE
        self._state = lidar_odometry.initial_state()
        self._stamp_ns: int | None = None
        self._kept = np.zeros(0, np.int64)  # beams of the last sweep that are registered
        self._usual, self._contradictions = 0.0, 0
        self._is_slipping = False
        self._cropped_at = np.zeros(3)
        self._since = np.inf  # travel since the last keyframe, in units of their spacing
        self._known: KnownPlanes | None = None  # the local map is that of a known one
        self._first, self._knows_first = list[tuple[int, Sweep]](), False  # stamps and sweeps

    def predict(self, beams: ScanBeams, increment: Float | None) -> State:
        """The prior of the next sweep: constant velocity, corrected by odometry.

        Args:
            beams: of the sweep.
            increment: (4, 4) of odometry since the last sweep; None: there is none.
        """
        self._is_slipping = False
        if self._stamp_ns is None:
            return self._state
        seconds, state = 1e-9 * (beams.stamp_ns - self._stamp_ns), self._state
        if increment is not None:
            state = constant_velocity.update_with_odometry(
                state, increment, seconds, self._options.odometry
            )
            self._is_slipping = state is self._state  # gated
        return constant_velocity.predict(state, seconds)

    def select(self, beams: ScanBeams, _prior: State) -> Sweep:
        """The hits of a sweep, one for each voxel, with weight 1."""
        every = np.ones(len(beams.points), np.float32)
        sweep, self._kept = lidar_odometry.make_sweep(
            beams.points, beams.hit, every, beams.beam_time, beams.T_base_sensor
        )
        return sweep

    def end_points(self, hits: Sweep, prior: State) -> tuple[Float32, Float]:
        """(N, 3) points in the base frame at the stamp, and its pose, as predicted."""
        return hits.deskew(prior.twist), prior.T_map_base

    def register(
        self, beams: ScanBeams, hits: Sweep, prior: State, _increment: Float | None
    ) -> Registration:
        """Register a sweep by its hits with weights P(static)."""
        state, explained, is_blind = prior, 1.0, not float(hits.weights.sum()) > 0.0
        if self._stamp_ns is not None and not is_blind:
            state, explained = follow_sweep(self.local_map, hits, prior, self._threads)
        is_carried = not is_blind and self._is_carried(explained)
        if is_carried:
            self._start_anew()
            state = prior
        self._advance(state, beams.stamp_ns)
        if not is_blind:
            self._note_first(beams.stamp_ns, hits)
        T = self._state.T_map_base
        covariance = se2.rotate_covariance(self._state.covariance[:6, :6], T)
        return Registration(
            T,
            covariance,
            explained,
            drift=np.zeros((3, 3)),
            twist=self._state.twist,
            is_slipping=self._is_slipping,
            is_blind=is_blind,
            is_carried=is_carried,
            is_contradicted=self._contradictions > 0,
        )

    def add(
        self, beams: ScanBeams, e: Float32, _recent: Float32, _label: Labeller
    ) -> MappedScan | None:
        """Add the last sweep to the local map, unless it contradicts it; the sweep if it is a
        keyframe.

        Args:
            beams: as if taken at the stamp.
            e: (N,) P(static).
        """
        if self._contradictions:
            return None
        kept, state = take_beams(beams, self._kept), self._state
        in_base, weights = transform_points(kept.points, kept.T_base_sensor), e[self._kept]
        if self._known is not None:
            self._known.add(in_base, weights, state.T_map_base)
        else:
            self.local_map.add(in_base, weights, state.T_map_base)
            here = state.T_map_base[:3, 3]
            if np.linalg.norm(here - self._cropped_at) > lidar_odometry.CROP_STEP:
                self._cropped_at = here.copy()
                self.local_map.crop(state.T_map_base, lidar_odometry.MAX_RANGE)
        if self._since < 1.0 or not weights.any():
            return None
        self._since = 0.0
        return MappedScan(kept, weights, state.T_map_base, self.travelled)

    def enter(self, known: Any, T: Float) -> None:
        """Go on in a known map, in whose frame the frame so far has the pose T (4, 4)."""
        self.local_map, self._known, self._knows_first = known.planes, known, True
        state, covariance = self._state, self._state.covariance.copy()
        covariance[:6, :6] += np.diag(np.square(np.repeat(_FOUND_STD, 3)))
        self._state = State(T @ state.T_map_base, state.twist, covariance)

    def correct(self, _local_map: Any, _motion: Float) -> None:
        """The local map stays as it is: it holds what is near, not what loops tie to it."""

    def _advance(self, state: State, stamp_ns: int) -> None:
        step = se2.inverse(self._state.T_map_base) @ state.T_map_base
        metres = float(np.linalg.norm(step[:3, 3]))
        self.travelled += metres
        self._since += metres / self._spacing
        self._since += float(np.linalg.norm(se3.log_rotation(step[:3, :3]))) / KEYFRAME_ANGLE
        self._state, self._stamp_ns = state, stamp_ns

    def _is_carried(self, explained: float) -> bool:
        """True when so many sweeps in a row contradicted the local map."""
        if self._stamp_ns is None:
            return False
        if explained < _POOR_SHARE * self._usual:
            self._contradictions += 1
        else:
            self._contradictions = 0
            rate = _EXPLAINED_RATE if self._usual > 0.0 else 1.0  # 0: the first sweep of a map
            self._usual += rate * (explained - self._usual)
        return self._contradictions >= _CARRIED_AFTER

    def _start_anew(self) -> None:
        self.left_behind, self.local_map = self.local_map, lidar_odometry.make_local_map()
        self._usual, self._contradictions, self._since = 0.0, 0, np.inf
        self._known = None

    def _note_first(self, stamp_ns: int, hits: Sweep) -> None:
        """Register the first sweeps again once the motion during the first one is known: it was
        distorted, and all later ones would be distorted to match it."""
        if self._knows_first:
            return
        self._first.append((stamp_ns, hits))
        if len(self._first) < _FIRST_SWEEPS:
            return
        first, self._first, self._knows_first = self._first, [], True
        if np.abs(self._state.twist).max() < _MIN_MOTION or not hits.times.any():
            return
        start = lidar_odometry.initial_state(self._state.twist)
        self.local_map = lidar_odometry.make_local_map()
        before = first[0][0]
        for stamp, sweep in first:
            if stamp != before:
                prior = constant_velocity.predict(start, 1e-9 * (stamp - before))
                start, _ = follow_sweep(self.local_map, sweep, prior, self._threads)
            if sweep is not hits:  # `add` adds the last one
                self.local_map.add(sweep.deskew(start.twist), sweep.weights, start.T_map_base)
            before = stamp
        self._state = start
