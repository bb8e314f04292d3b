"""Moving objects while they are seen: dynamic end points, associated with Kalman filters."""

from dataclasses import dataclass

import numpy as np

from stillmap.core import kalman
from stillmap.core.array_types import Bool, Float, Float32, Index, Int64
from stillmap.core.arrays import unique_cells
from stillmap.core.short_repr import ShortRepr
from stillmap.core.square_box import adjacent_pairs, component_labels
from stillmap.live.scan import ScanBeams

_MAX_POINTS = 1200  # of a scan: every k-th of more
_LINK = 0.35  # m between neighbours of one cluster in a planar scan
_CELL = 0.25  # m: in 3D end points in a cell count as their mean, neighbouring cells are connected
# m around a cluster within which so many end points are its own: some beams of walls whose cells
# are not known well are dynamic
_AMID, _MIN_SHARE = 0.3, 0.35
_POSITION_STD = 0.12  # m, of the centre as seen in one scan: legs swing, and one side is visible
_ACCELERATION = 1.0  # m2/s3: spectral density of the random acceleration
_MAX_UNSEEN_NS = 1_000_000_000  # after which a mover is forgotten
_MAX_UNSEEN_EARLY_NS = 400_000_000  # the same before it is confirmed
# m from a track's edge within which points are its own; m from its centre within which no other one
# begins, and more per metre of range: beams lie apart
_GATE, _SPACING, _SPACING_PER_METRE = 0.2, 0.5, 0.02
_GATE_SIGMAS, _MAX_GATE = 2.0, 1.0  # standard deviations of the prediction in addition; m
_MIN_RADIUS, _MAX_RADIUS = 0.2, 2.5  # m: a person, a car
_GROWTH, _SHRINKAGE = 0.3, 0.03  # gains of the radius per scan: objects are often half hidden
# beyond which a displacement is one; scans with two end points: a single beam slides along a wall
_SIGMAS, _MIN_SCANS = 3.0, 4
_HEIGHT_WEIGHT = 0.3  # of vertical distances: objects are taller than wide, and seen in part


@dataclass(frozen=True, eq=False)
class Mover(ShortRepr):
    """A moving object.

    Attributes:
        number: of its track; no other one gets it.
        position: (D,) m, center in the map frame.
        velocity: (D,) m/s.
        covariance: (2D, 2D) of position and velocity.
        radius: m, half its width.
        age: s since it was first seen.
    """

    number: int
    position: Float
    velocity: Float
    covariance: Float
    radius: float
    age: float


class MoverTracker:
    """Tracks of what moves, scan by scan, in a frame that never jumps.

    A cluster of dynamic end points that no track claims begins one. It is a mover once it is
    farther from where it began than its uncertainty explains.

    Args:
        dimension: 2 or 3.
    """

    def __init__(self, dimension: int) -> None:
        self._weights = np.array([1.0, 1.0, _HEIGHT_WEIGHT])[:dimension]
        self._count, self._now_ns = 0, 0
        self._states = kalman.initialize(np.zeros((0, dimension)), _POSITION_STD)
        self._tracks = _Tracks.begin(np.zeros((0, dimension)), np.zeros(0), 0, 0)

    def add(self, beams: ScanBeams, T: Float, p_static: Float32) -> None:
        """Update the tracks with a scan.

        Args:
            beams: of the scan; stamps do not fall.
            T: (D+1, D+1) pose of the base in the frame of the tracks.
            p_static: (N,) of the beams; NaN: unusable.
        """
        step_ns, self._now_ns = beams.stamp_ns - self._now_ns, beams.stamp_ns
        limit = np.where(self._tracks.is_mover, _MAX_UNSEEN_NS, _MAX_UNSEEN_EARLY_NS)
        limit = np.maximum(limit, min(step_ns, _MAX_UNSEEN_NS))  # scans may be rare
        self._keep(beams.stamp_ns - self._tracks.seen_ns <= limit)
        self._states = kalman.predict(self._states, 1e-9 * step_ns, _ACCELERATION)
        T_sensor = T @ beams.T_base_sensor
        sensor = T_sensor[:-1, -1]
        points, cluster = _find_clusters(beams, T_sensor, p_static)
        if not len(points):
            return
        claims = self._associate(points, cluster)
        self._update(points, claims, sensor)
        self._begin(points[claims < 0], cluster[claims < 0], sensor)

    def movers(self, T_map_frame: Float) -> list[Mover]:
        """The confirmed tracks, in the map, given the pose (D+1, D+1) of their frame there."""
        states, tracks = self._states, self._tracks
        chosen = np.flatnonzero(tracks.is_mover)
        if not len(chosen):
            return []
        R = T_map_frame[:-1, :-1]
        x, v = states.x[chosen] @ R.T + T_map_frame[:-1, -1], states.v[chosen] @ R.T
        covariance = _to_covariances(states.P[chosen], len(R))
        number, radius = tracks.number[chosen].tolist(), tracks.radius[chosen].tolist()
        age = (1e-9 * (self._now_ns - tracks.begin_ns[chosen])).tolist()
        return list(map(Mover, number, x, v, covariance, radius, age))

    def move(self, T: Float) -> None:
        """Go on in another frame, in which the frame so far has the pose T (D+1, D+1)."""
        R, t = T[:-1, :-1], T[:-1, -1]
        self._states = kalman.TrackStates(
            self._states.x @ R.T + t, self._states.v @ R.T, self._states.P
        )
        self._tracks.origin = self._tracks.origin @ R.T + t

    def clear(self) -> None:
        """Forget all tracks."""
        self._keep(np.zeros(len(self._states), np.bool_))

    def _associate(self, points: Float, cluster: Index) -> Index:
        """(n,) the track that claims each point; -1: none."""
        n_tracks = len(self._states)
        if not n_tracks:
            return np.full(len(points), -1)
        distance = self._distance(points[:, None] - self._states.x)
        sigma = self._states.position_std
        gate = self._tracks.radius + np.minimum(_GATE + _GATE_SIGMAS * sigma, _MAX_GATE)
        share = distance / gate
        claims: Index = np.where(share.min(axis=1) < 1.0, share.argmin(axis=1), -1)
        # the rest of a cluster belongs to the track that claims most of it
        if (claims < 0).any() and (claims >= 0).any():
            in_cluster = (cluster == np.arange(int(cluster.max()) + 1)[:, None]).astype(np.float64)
            votes = in_cluster @ (claims[:, None] == np.arange(n_tracks))
            most = np.where(votes.max(axis=1) > 0, votes.argmax(axis=1), -1)
            claims = np.where(claims >= 0, claims, most[cluster])
        return claims

    def _update(self, points: Float, claims: Index, sensor: Float) -> None:
        """Update the tracks with the points that they claim."""
        own = claims >= 0
        if not own.any():
            return
        tracks = self._tracks
        seen, mean, half = _measure(points[own], claims[own], len(self._states), sensor)
        gain = np.where(half > tracks.radius, _GROWTH, _SHRINKAGE) * seen
        radius = tracks.radius + gain * (half - tracks.radius)
        tracks.radius = radius.clip(_MIN_RADIUS, _MAX_RADIUS)
        center = mean + _offset(mean, sensor, tracks.radius)
        self._states = kalman.update(self._states, seen, center, _POSITION_STD)
        tracks.seen_ns[seen] = self._now_ns
        tracks.scans += np.bincount(claims[own], minlength=len(seen)) >= 2
        moved = self._distance(self._states.x - tracks.origin)
        noise = np.sqrt(self._states.P[:, 0] + _POSITION_STD**2)
        tracks.is_mover |= (moved > _SIGMAS * noise) & (tracks.scans >= _MIN_SCANS)

    def _begin(self, points: Float, cluster: Index, sensor: Float) -> None:
        """Begin a track for each cluster that is far enough from the others, the largest first."""
        if not len(points):
            return
        _, cluster, count = np.unique(cluster, return_inverse=True, return_counts=True)
        _, mean, half = _measure(points, cluster, len(count), sensor)
        radius = half.clip(_MIN_RADIUS, _MAX_RADIUS)
        center = mean + _offset(mean, sensor, radius)
        spacing = _SPACING + _SPACING_PER_METRE * np.linalg.norm(mean - sensor, axis=1)
        offsets = center[:, None] - self._states.x
        free = self._distance(offsets) > spacing[:, None] + self._tracks.radius - _MIN_RADIUS
        kept = list[int]()
        for k in np.argsort(-count, kind="stable").tolist():
            gaps = self._distance(center[kept] - center[k])
            if free[k].all() and (gaps > spacing[k]).all():
                kept.append(k)
        begun = _Tracks.begin(center[kept], radius[kept], self._count, self._now_ns)
        self._count += len(kept)
        self._tracks = self._tracks.append(begun)
        new = kalman.initialize(center[kept], _POSITION_STD)
        self._states = kalman.concatenate(self._states, new)

    def _distance(self, difference: Float) -> Float:
        """Lengths of differences (..., D)."""
        return np.asarray(np.sqrt(np.square(difference) @ np.square(self._weights)))

    def _keep(self, kept: Bool) -> None:
        if not kept.all():
            self._states, self._tracks = self._states.select(kept), self._tracks.select(kept)


@dataclass(eq=False)
class _Tracks:
    """Attributes of K tracks beside their states: origin, time of the first and last detection."""

    number: Index
    origin: Float
    radius: Float
    begin_ns: Int64
    seen_ns: Int64
    scans: Index
    is_mover: Bool

    @classmethod
    def begin(cls, center: Float, radius: Float, number: int, now_ns: int) -> "_Tracks":
        n = len(center)
        now = np.full(n, now_ns, np.int64)
        ones, no = np.ones(n, np.intp), np.zeros(n, np.bool_)
        return cls(number + np.arange(n), center.copy(), radius, now, now.copy(), ones, no)

    def select(self, kept: Bool) -> "_Tracks":
        return _Tracks(*(column[kept] for column in vars(self).values()))

    def append(self, further: "_Tracks") -> "_Tracks":
        columns = zip(vars(self).values(), vars(further).values(), strict=True)
        return _Tracks(*(np.concatenate(pair) for pair in columns))


def _find_clusters(beams: ScanBeams, T_sensor: Float, p_static: Float32) -> tuple[Float, Index]:
    """Dynamic end points (n, D), in 3D one per cell, and the cluster (n,) of each.

    Clusters amid static end points are left out: parts of walls whose cells are not known well.
    """
    dynamic, weight = _thin(np.flatnonzero(beams.hit & (p_static < 0.5)))
    ends = _transform(beams.points[dynamic], T_sensor)
    if not len(ends):
        return ends, dynamic
    points, cluster, count = _connect_cells(ends) if beams.dimension == 3 else _connect(ends)
    mean, radius = _measure(points, cluster, len(count), T_sensor[:-1, -1])[1:]
    static, static_weight = _thin(np.flatnonzero(beams.hit & (p_static >= 0.5)))
    still = _transform(beams.points[static], T_sensor)
    squared = np.square(still).sum(axis=1) - 2.0 * mean @ still.T
    near = squared < (np.square(radius + _AMID) - np.square(mean).sum(axis=1))[:, None]
    own, amid = weight * count, static_weight * near.sum(axis=1)
    kept = (own >= _MIN_SHARE * (own + amid))[cluster]
    return points[kept], cluster[kept]


def _thin(chosen: Index) -> tuple[Index, int]:
    """Every k-th of them, and k."""
    k = max(-(-len(chosen) // _MAX_POINTS), 1)
    return chosen[::k], k


def _transform(points: Float32, T: Float) -> Float:
    """(n, D) points moved by a pose (D+1, D+1)."""
    return np.asarray(points @ T[:-1, :-1].T + T[:-1, -1])


def _connect(ends: Float) -> tuple[Float, Index, Index]:
    """End points along a planar scan (n, 2), the cluster of each, and the sizes of clusters: one
    ends at a gap."""
    gaps = np.abs(np.diff(ends, axis=0)).max(axis=1) > _LINK
    cluster = np.concatenate([[0], np.cumsum(gaps)])
    return ends, cluster, np.bincount(cluster)


def _connect_cells(ends: Float) -> tuple[Float, Index, Index]:
    """The means (m, D) of the end points in each cell, the cluster of each cell, and how many end
    points each cluster has: neighbouring cells are connected."""
    cells, of = unique_cells(np.floor(ends / _CELL).astype(np.int64))
    sums = [np.bincount(of, x) for x in ends.T]
    cluster = component_labels(adjacent_pairs(cells), len(cells))
    return np.stack(sums, axis=1) / np.bincount(of)[:, None], cluster, np.bincount(cluster[of])


def _to_covariances(P: Float, dimension: int) -> Float:
    """(K, 2D, 2D) of positions and velocities from those (K, 3) that all axes share."""
    out, axis = np.zeros((len(P), 2, dimension, 2, dimension)), np.arange(dimension)
    out[:, :, axis, :, axis] = P[:, [[0, 1], [1, 2]]]
    return out.reshape(len(P), 2 * dimension, 2 * dimension)


def _measure(points: Float, of: Index, n: int, sensor: Float) -> tuple[Bool, Float, Float]:
    """A mask of the n groups that have points, their means (n, D), and half their widths (n,)
    across the view from the sensor, horizontally."""
    member = of == np.arange(n)[:, None]
    count = member.sum(axis=1)
    seen = count > 0
    mean = member @ points / np.maximum(count, 1)[:, None]
    away = _direction(mean, sensor)
    across = away[:, :1] * points[:, 1] - away[:, 1:2] * points[:, 0]
    low = np.where(member, across, np.inf).min(axis=1)
    high = np.where(member, across, -np.inf).max(axis=1)
    return seen, mean, 0.5 * np.where(seen, high - low, 0.0)


def _direction(mean: Float, sensor: Float) -> Float:
    """(K, D) horizontal unit vectors away from the sensor."""
    away = mean - sensor
    away[:, 2:] = 0.0
    return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1), 1e-9)[:, None])


def _offset(mean: Float, sensor: Float, radius: Float) -> Float:
    """(K, D) from the mean of visible points to the centre: on average pi / 4 of the radius."""
    return np.pi / 4.0 * radius[:, None] * _direction(mean, sensor)
