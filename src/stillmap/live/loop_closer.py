"""Loop closure while the robot drives: the stages of `slam.loop_closure`, one after another."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.core.short_repr import ShortRepr
from stillmap.live.graph_sparsification import AnchoredPoses, select_scans, select_state
from stillmap.live.local_map import MappedScan, SpacedScans
from stillmap.slam import local_map, loop_candidates, loop_closure
from stillmap.slam.loop_closure import LoopState
from stillmap.slam.options import SlamOptions
from stillmap.slam.types import LoopContext

_EVERY = 2.0  # m of travel between two searches for loops
_NEAR_TRAVEL = 25.0  # m of drift up to which earlier scans are part of the local map
_HEADING = 0.8  # rad between two earlier scans of one place in the local map
_NEAR_DISTANCE = 25.0  # m from the robot up to which they are
# m that any spaced scan and that the last one move, and rad that it turns, up to which the map
# stays as it is: constraints of loops have such errors themselves
_SMALL = 0.1, 0.03, 0.005
_REPEATED_AFTER = 25.0  # m after which small corrections are reported: one may have been lost
# spaced scans, a kilometre of travel, before which none leaves the graph; how many times as many as
# were left the last time there are when some leave again
_MIN_SCANS, _GROWTH = 6000, 1.5


@dataclass(frozen=True, eq=False)
class Correction(ShortRepr):
    """Poses after loop closure.

    Attributes:
        T_map_local: (3, 3) of the frame of the odometry by scans in the new map.
        poses: (S, 3, 3) T_map_base of the spaced scans in the new map.
        near: scans of the new local map, in the frame of the odometry by scans.
        untied: spaced scans that were the first ones after the robot was carried, whose place in
            the map no loop shows.
    """

    T_map_local: Float
    poses: Float
    near: list[MappedScan]
    untied: tuple[int, ...] = ()


def is_small(before: Float, after: Float, motion: Float) -> bool:
    """True if a correction leaves the map as it is.

    Args:
        before: (S, D+1, D+1) poses of the spaced scans.
        after: (S, D+1, D+1) the same after the correction.
        motion: (D+1, D+1) of the map where the robot is.
    """
    D = before.shape[-1] - 1
    shift = np.linalg.norm((after - before)[:, :D, D], axis=1)
    # of a small rotation: that of R - I is the square root of two times as much
    turn = float(np.linalg.norm(motion[:D, :D] - np.eye(D))) / np.sqrt(2.0)
    return bool(shift.max() < _SMALL[0] and shift[-1] < _SMALL[1] and turn < _SMALL[2])


class LoopCloser:
    """Spaced scans of the whole run, and the loops between them. Where the robot drives through
    the same places again and again, scans leave the graph: it grows with the area.

    Args:
        options: see SlamOptions.
        folder: of temporary files; None: the system's.
    """

    def __init__(self, options: SlamOptions, folder: Path | None = None) -> None:
        self._scans, self._folder = SpacedScans(2, options, folder), folder
        self._options = options
        self._last: MappedScan | None = None
        self._keyframes: list[int] = []
        self._since = np.inf  # travel since the last keyframe, in units of their spacing
        self._state = LoopState(np.zeros((0, 3, 3)))
        self._centers = np.zeros((0, 2))
        self._poses = np.zeros((0, 3, 3))  # T_map_base of the spaced scans up to the last search
        self._T_map_local = np.eye(3)
        self._anchored = AnchoredPoses()
        self._searched_until = 0.0
        # the last large correction: poses of the spaced scans up to now, T_map_local
        self._reported, self._reported_T_map_local = np.zeros((0, 3, 3)), np.eye(3)
        self._reported_at = 0.0  # m of travel at the last correction
        self._due = _MIN_SCANS  # spaced scans from which some leave

    def add(self, scan: MappedScan, explained: float, drift: Float) -> None:
        """Add a spaced scan, see `SpacedScans.add`."""
        if self._last is not None:
            step = se2.parameters(se2.inverse(self._last.T_map_base) @ scan.T_map_base)
            self._since += float(np.hypot(*step[:2])) / self._scans.keyframe_distance
            self._since += abs(float(step[2])) / local_map.KEYFRAME_ANGLE
        if self._since >= 1.0:
            self._keyframes.append(len(self._scans))
            self._since = 0.0
        self._last = scan
        self._scans.add(scan, explained, drift)

    def poll(self) -> Correction | None:
        """Search loops where the robot has driven so far that they are worth it; None: hardly
        anything changed."""
        is_due = (
            self._last is not None
            and len(self._keyframes) > len(self._state.poses) + 1
            and self._last.travelled >= self._searched_until + _EVERY
        )
        return self._close() if is_due else None

    def stop(self) -> None:
        """Remove temporary files."""
        self._scans.close()

    def _close(self) -> Correction | None:
        """Search loops of the keyframes since the last search."""
        context = self._scans.context(np.array(self._keyframes, np.intp))
        first, last = len(self._state.poses), len(context.keyframes)
        self._searched_until = float(context.travelled[-1])
        self._poses = _extend(self._poses, self._T_map_local, context.poses)
        self._reported = _extend(self._reported, self._reported_T_map_local, context.poses)
        chain = loop_candidates.odometry_constraints(context, [])
        new = context.keyframes[first:]
        added = loop_candidates.view_centers(replace(context, keyframes=new))
        self._centers = np.concatenate([self._centers, added])
        before = self._state
        poses = _extend(before.poses, self._T_map_local, context.poses[context.keyframes])
        state = replace(before, poses=poses)
        self._state = loop_closure.close_stage(context, chain, self._centers, state, first, last)
        is_changed = not np.array_equal(self._state.poses, poses)
        correction = self._correct(context) if is_changed else None
        if len(self._scans) >= self._due:
            self._sparsify(context)
        return correction

    def _correct(self, context: LoopContext) -> Correction | None:
        keyframes, poses, end = context.keyframes, self._state.poses, len(context.poses) - 1
        self._T_map_local = poses[-1] @ se2.inverse(context.poses[keyframes[-1]])
        last = self._T_map_local @ context.poses[-1]
        if keyframes[-1] < end:
            keyframes, poses = np.append(keyframes, end), np.concatenate([poses, last[None]])
        corrected = local_map.propagate_corrections(context.poses, keyframes, poses)
        self._poses = corrected
        is_large = not is_small(self._reported, corrected, last @ se2.inverse(self._reported[-1]))
        now = float(context.travelled[-1])
        if not is_large and now < self._reported_at + _REPEATED_AFTER:
            return None
        self._reported_at = now
        if is_large:
            self._reported, self._reported_T_map_local = corrected, self._T_map_local
        near = self._find_near(context)
        return Correction(self._T_map_local, self._anchored.place(corrected), near)

    def _sparsify(self, context: LoopContext) -> None:
        """Take scans out of the graph. The others stay as they are in the map."""
        stay, keyframes = select_scans(context, self._state), context.keyframes
        local = se2.inverse(self._T_map_local) @ self._poses
        scans = SpacedScans(2, self._options, self._folder)
        for s in context.recording.iter_scans(np.flatnonzero(stay).tolist(), context.e):
            scan = replace(self._scans.scan(context, s), T_map_base=local[s])
            scans.add(scan, float(context.explained[s]), context.drift[s])
        self._scans.close()
        self._scans = scans
        self._anchored.remove(stay, self._poses)
        self._state = select_state(self._state, keyframes, stay)
        self._centers = self._centers[stay[keyframes]]
        self._keyframes = (np.cumsum(stay) - 1)[keyframes[stay[keyframes]]].tolist()
        self._poses, self._reported = self._poses[stay], self._reported[stay]
        self._due = max(_MIN_SCANS, round(_GROWTH * len(scans)))

    def _find_near(self, context: LoopContext) -> list[MappedScan]:
        """The scans of the local map: near the robot along the graph and in the map.

        Of earlier travel one, the last, for each metre and heading.
        """
        k, travelled = len(context.keyframes) - 1, context.travelled
        metres = loop_candidates.graph_distances(context, k, self._state.fitting)
        scans = np.arange(len(context.poses))
        of = np.clip(np.searchsorted(context.keyframes, scans, side="right") - 1, 0, k)
        away = np.hypot(*(self._poses[:, :2, 2] - self._poses[-1, :2, 2]).T)
        now = float(travelled[-1])
        is_near = (metres[of] <= _NEAR_TRAVEL) & (away <= _NEAR_DISTANCE)
        is_recent = travelled >= now - _NEAR_TRAVEL
        local = se2.inverse(self._T_map_local) @ self._poses
        earlier = np.flatnonzero(is_near & ~is_recent)
        places = np.floor(se2.parameters(local[earlier]) / (1.0, 1.0, _HEADING)).astype(np.int64)
        last_of = dict(zip(map(tuple, places.tolist()), earlier.tolist(), strict=True))
        recent = np.flatnonzero(is_near & is_recent).tolist()
        return [
            replace(
                self._scans.scan(context, s),
                T_map_base=local[s],
                travelled=float(travelled[s]) if is_recent[s] else now,
            )
            for s in (*recent, *last_of.values())
        ]


def _extend(poses: Float, T_map_local: Float, local: Float) -> Float:
    """(S, 3, 3) poses in the map, of which the last are known by those in the local frame alone."""
    return np.concatenate([poses, T_map_local @ local[len(poses) :]])
