"""Results of the front ends of live mapping, in 2D and 3D: registered scans, and crowds."""

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float, Float32
from stillmap.core.short_repr import ShortRepr

# hits that labels call moving a second later: weight of a scan in their running share; share from
# which people may walk along
_LABEL_RATE, _CROWDED = 0.3, 0.15
# m of odometry between the two scans that are compared: people keep their place for so long
_BASELINE, _MAX_BASELINE = 0.3, 1.0
_MAX_AGE_NS = 3 * 10**9  # between the two
_SPACING_NS = 10**8  # between scans that are kept
_BODY = 0.5  # m from the base, within which hits are on the robot
_MAX_HITS = 150  # of a scan, which are compared with all of another one
_NEAR, _OFF = 0.1, 0.15  # m to the nearest hit of the other scan: fits; does not
_RATE = 0.15  # weight of a scan in the running shares
# running share of the hits that keep their place beside the robot, from which people walk along;
# and of those that are where odometry says in the same scans, below which rather the wheels spin;
# both while nobody walks along, and while people do
_ALONG, _STATIC = (0.12, 0.05), (0.05, 0.003)
_MAY_WALK = 0.04  # the first of them, from which people may walk along


class _Kept(NamedTuple):
    stamp_ns: int
    points: Float32
    T_odom_base: Float


class Crowd:
    """The share of hits on what moves, and of those on what moves along with the robot.

    Attributes:
        walks_along: people walk along with the robot.
    """

    def __init__(self) -> None:
        from scipy.spatial import cKDTree  # slow to load: not while a pose is waited for

        self._make_tree = cKDTree
        self.walks_along = False
        self._moving = 0.0  # share of the hits, as labels say a second later
        self._along, self._both = 0.0, 0.0
        self._kept = deque[_Kept]()
        self._T_odom_base = np.eye(3)

    @property
    def is_dense(self) -> bool:
        """True if people may walk along with the robot: many move, or some do that."""
        return self._moving > _CROWDED or self.walks_along

    @property
    def may_walk_along(self) -> bool:
        """True if people may walk along, too few as yet to be sure: some hits keep their place, and
        others are where odometry says."""
        return self._along > _MAY_WALK and self._both > _STATIC[0] * self._along

    def learn(self, e: Float32) -> None:
        """Take the labels of an earlier scan.

        Args:
            e: (N,) P(static) of its hits.
        """
        if len(e):
            self._moving += _LABEL_RATE * (float((e < 0.5).mean()) - self._moving)

    def observe(self, points: Float32, increment: Float | None, stamp_ns: int) -> None:
        """Compare a scan with one that was taken a little before.

        Hits on people who walk along are where they were beside the robot, those on what stands
        where odometry says.

        Args:
            points: (N, 2) hits in the base frame, m.
            increment: (3, 3) of odometry since the last scan; None: there is none.
            stamp_ns: of the scan.
        """
        if increment is None:
            self._kept.clear()
            return
        self._T_odom_base = self._T_odom_base @ increment
        if self._kept and 0 <= stamp_ns - self._kept[-1].stamp_ns < _SPACING_NS:
            return
        points = points[np.hypot(*points.T) > _BODY]
        earlier = self._find_other(stamp_ns)
        if earlier is not None and len(points) and len(earlier.points):
            self._compare(points, earlier)
        self._kept.append(_Kept(stamp_ns, points, self._T_odom_base))

    def _find_other(self, stamp_ns: int) -> _Kept | None:
        """The last scan from far enough away."""
        while self._kept and not 0 <= stamp_ns - self._kept[0].stamp_ns <= _MAX_AGE_NS:
            self._kept.popleft()
        for kept in reversed(self._kept):
            metres = float(np.hypot(*(kept.T_odom_base[:2, 2] - self._T_odom_base[:2, 2])))
            if metres >= _BASELINE:
                return kept if metres <= _MAX_BASELINE else None
        return None

    def _compare(self, points: Float32, earlier: _Kept) -> None:
        tree = self._make_tree(earlier.points, balanced_tree=False, compact_nodes=False)
        thin = points[:: -(-len(points) // _MAX_HITS)].astype(np.float64)
        T = se2.inverse(earlier.T_odom_base) @ self._T_odom_base
        moved = thin @ T[:2, :2].T + T[:2, 2]
        along, static = (np.asarray(tree.query(at)[0], np.float64) for at in (thin, moved))
        share = _share(along, static)
        self._along += _RATE * (share - self._along)
        self._both += _RATE * (share * _share(static, along) - self._both)
        least, least_static = (limits[self.walks_along] for limits in (_ALONG, _STATIC))
        self.walks_along = self._along > least and self._both > least_static * self._along


def _share(fits: Float, not_fits: Float) -> float:
    """Share of the hits that have one near in the one place, and none in the other."""
    return float(((fits < _NEAR) & (not_fits > _OFF)).mean())


@dataclass(frozen=True, eq=False)
class Registration(ShortRepr):
    """A registered scan.

    Attributes:
        T: (D+1, D+1) pose of the base in the frame of the odometry by scans, which never jumps.
        covariance: of the pose against the local map: (3, 3) of x, y (axes of that frame) and
            heading, in 3D (6, 6) of translation and rotation.
        explained: share of the beams that the local map explains.
        drift: (3, 3) covariance that the step adds where the scan says nothing; in 3D 0.
        twist: (3,) or (6,) m/s and rad/s of the base in its own frame during the scan.
        is_slipping: odometry disagrees with the scans.
        is_blind: no beam met anything that the local map knows.
        is_carried: the scans contradict the local map, which begins anew.
        is_contradicted: the last ones do, or nothing of them is in it; not enough of them yet.
        has_odometry: the prior is that of odometry.
    """

    T: Float
    covariance: Float
    explained: float
    drift: Float
    twist: Float
    is_slipping: bool = False
    is_blind: bool = False
    is_carried: bool = False
    is_contradicted: bool = False
    has_odometry: bool = False
