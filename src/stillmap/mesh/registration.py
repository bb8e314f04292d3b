"""Object registration: partial scans of a rigid object aligned in its own frame.

Over a second a car moves evenly, so six parameters of its motion, common to all partial scans,
correct the track: the error of its velocity, turn rate and acceleration. Where scans do not
constrain them, as along a side without ends, the track's values hold.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from stillmap.core.array_types import Float
from stillmap.mesh.range_image import Patch, vertex_normals
from stillmap.mesh.triangle_mesh import Mesh

_COARSE_SPEEDS = (0.0, *(s * k for k in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0) for s in (-1.0, 1.0)))  # m/s
_FINE_SPEEDS = (0.0, *(k * s / 10.0 for k in range(1, 11) for s in (-1.0, 1.0)))  # m/s
_SPEED_PENALTY = 0.002  # m per m/s of the coarse search: the track's value wins ties
_SEARCH_POINTS = 500  # of a partial scan in the search over speeds
_MAX_DISTANCE = 0.3  # m at which a point counts as an outlier there
_SEARCH_ROUNDS = 2  # of refinement for each speed

# standard deviations of the motion around the track's, and around that of the speed search
_TRACK_STD = (0.7, 0.4, 0.2, 0.2, 2.0, 1.0)
_SEARCHED_STD = (0.1, 0.4, 0.2, 0.2, 2.0, 1.0)
_POINT_STD = 0.03  # m, of points from a surface
_RADII = (0.6, 0.3, 0.15)  # m, of correspondences, from stage to stage
_SPANS = (0.4, 0.7, 1.0)  # share of the time offsets that take part, likewise
_ROUNDS = 5  # Gauss-Newton steps per stage
_POINTS = 2000  # of a partial scan, at most
_MIN_POINTS = 20
_INDEPENDENT_POINTS = 100.0  # of a partial scan: errors of neighbors are correlated
_MIN_NORMAL_COSINE = 0.5  # between normals of corresponding points


@dataclass(frozen=True, eq=False)
class PartialSurface:
    """The surface of a partial scan, in the object's frame by its track.

    Attributes:
        mesh: the surface.
        normals: (V, 3) unit normals of its vertices, towards the sensor.
        sensor: (3,) sensor position.
        time_offset: s after the time at which the frame is known.
    """

    mesh: Mesh
    normals: Float
    sensor: Float
    time_offset: float

    @classmethod
    def from_mesh(cls, mesh: Mesh, sensor: Float, time_offset: float) -> "PartialSurface":
        """With area-weighted vertex normals."""
        spans = (mesh.normals() * mesh.areas()[:, None]).T
        normals = vertex_normals(spans, mesh.faces, len(mesh.vertices), 0).T
        return cls(mesh, np.ascontiguousarray(normals), sensor, time_offset)

    @cached_property
    def tree(self) -> "cKDTree[None]":
        """The vertices, for searches."""
        return cKDTree(self.mesh.vertices)

    def sample(self, most: int) -> "PartialSurface":
        """About `most` of the vertices, without faces."""
        every = max(1, len(self.mesh.vertices) // most)
        points = Mesh(self.mesh.vertices[::every], self.mesh.faces[:0])
        return replace(self, mesh=points, normals=self.normals[::every])

    def transform(self, motion: Float) -> "PartialSurface":
        """The surface corrected by a motion (6,) relative to the track."""
        R, t = motion_transform(motion, self.time_offset)
        mesh = Mesh(self.mesh.vertices @ R.T + t, self.mesh.faces)
        return replace(self, mesh=mesh, normals=self.normals @ R.T, sensor=R @ self.sensor + t)

    def to_patch(self) -> Patch:
        """The surface as input of TSDF integration."""
        points = self.mesh.vertices
        origin = np.tile(self.sensor, (len(points), 1))
        standoff = ((origin - points) * self.normals).sum(axis=1)
        return Patch(points, self.mesh.faces, np.arange(len(points)), origin, standoff)


def motion_transform(motion: Float, time_offset: float) -> tuple[Float, Float]:
    """(3, 3) and (3,) metres: correction of a partial scan at a time offset in seconds.

    Args:
        motion: (6,) metres per second ahead, to the left and up, rad per second to the left, metres
            per square second ahead and to the left.
        time_offset: s.
    """
    turn = motion[3] * time_offset
    c, s = np.cos(turn), np.sin(turn)
    t = motion[:3] * time_offset
    t[:2] += 0.5 * motion[4:] * time_offset**2
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), t


def register_surfaces(surfaces: Sequence[PartialSurface], best: int) -> Float:
    """(6,) the object's motion relative to its track, see `motion_transform`.

    A search over the forward speed point to point, then Gauss-Newton point to plane against the
    best partial surface, from the surfaces beside it to those far from it.
    """
    known = surfaces[best]
    motion = np.zeros(6)
    if len(known.mesh.vertices) < _MIN_POINTS:
        return motion
    some, few = ([one.sample(n) for one in surfaces] for n in (_POINTS, _SEARCH_POINTS))
    beside = [few[k] for k in (best - 1, best + 1) if 0 <= k < len(surfaces)]
    motion = _search_speed(beside, known, motion, _COARSE_SPEEDS, _SPEED_PENALTY)
    prior = motion * np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])  # the rest is better from the track
    others = [k for k in range(len(surfaces)) if k != best]
    farthest = max(abs(one.time_offset) for one in surfaces)
    for part, radius in zip(_SPANS, _RADII, strict=True):
        near = [some[k] for k in others if abs(some[k].time_offset) <= part * farthest + 1e-9]
        motion = _refine(near, known, motion, prior, _TRACK_STD, radius, _ROUNDS)
    motion = _search_speed([few[k] for k in others], known, motion, _FINE_SPEEDS, 0.0)
    far = [some[k] for k in others]
    return _refine(far, known, motion, motion, _SEARCHED_STD, _RADII[-1], _ROUNDS)


def _search_speed(
    surfaces: Sequence[PartialSurface],
    known: PartialSurface,
    motion: Float,
    speeds: tuple[float, ...],
    penalty: float,
) -> Float:
    """The motion (6,) with another forward speed, if surfaces lie nearer to the best one by that.

    Point to point, so that the ends of a car count, and not its sides only. The track of a part of
    a car may be wrong by half its velocity. For each speed the rest of the motion is refined first:
    along a side that is askew, a motion ahead is nearly as good as one to the left.

    Args:
        surfaces: the others.
        known: the best one.
        motion: initial.
        speeds: m/s that are added, 0 the first of them.
        penalty: m per m/s added.
    """
    found, cost = list[Float](), list[float]()
    for speed in speeds:
        prior = motion + np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0])
        tried = _refine(surfaces, known, prior, prior, _SEARCHED_STD, _RADII[1], _SEARCH_ROUNDS)
        found.append(tried)
        moved = [one.transform(tried).mesh.vertices for one in surfaces]
        at = np.concatenate([np.zeros((0, 3)), *moved])
        distance = np.asarray(known.tree.query(at, distance_upper_bound=_MAX_DISTANCE)[0])
        distance = np.minimum(distance, _MAX_DISTANCE)
        cost.append((float(distance.mean()) if len(distance) else 0.0) + penalty * abs(speed))
    return found[int(np.argmin(cost))]


def _refine(
    surfaces: Sequence[PartialSurface],
    known: PartialSurface,
    motion: Float,
    prior: Float,
    prior_std: tuple[float, ...],
    radius: float,
    rounds: int,
) -> Float:
    """The motion after Gauss-Newton steps with robust weights and a Gaussian prior."""
    information = np.diag(1.0 / np.square(prior_std))
    for _ in range(rounds):
        H, g = information.copy(), information @ (motion - prior)
        for one in surfaces:
            at, n, residual = _correspondences(one.transform(motion), known, radius)
            if len(at) < _MIN_POINTS:
                continue
            T = one.time_offset
            w = 1.0 / (1.0 + (residual / (3.0 * _POINT_STD)) ** 2) ** 2 / _POINT_STD**2
            w *= min(1.0, _INDEPENDENT_POINTS / len(at))
            around = at - motion_transform(motion, T)[1]
            turn = T * (n[:, 1] * around[:, 0] - n[:, 0] * around[:, 1])
            J = np.column_stack([T * n, turn, 0.5 * T**2 * n[:, :2]])
            H, g = H + J.T @ (w[:, None] * J), g + J.T @ (w * residual)
        motion = motion - np.linalg.solve(H, g)
    return motion


def _correspondences(
    one: PartialSurface, known: PartialSurface, radius: float
) -> tuple[Float, Float, Float]:
    """(n, 3) points with a nearest vertex, (n, 3) its normals, (n,) point-to-plane residuals."""
    at = one.mesh.vertices
    away, nearest = map(np.asarray, known.tree.query(at, distance_upper_bound=radius))
    near = np.flatnonzero(np.isfinite(away))
    normals = known.normals[nearest[near]]
    same = (one.normals[near] * normals).sum(axis=1) > _MIN_NORMAL_COSINE
    near, normals = near[same], normals[same]
    residual = ((at[near] - known.mesh.vertices[nearest[near]]) * normals).sum(axis=1)
    return at[near], normals, residual


def surface_distance(one: PartialSurface, known: PartialSurface) -> float:
    """Metres, third quartile of a surface's distances from another; NaN: too little in common."""
    if not len(known.mesh.vertices):
        return float("nan")
    residual = _correspondences(one.sample(_POINTS), known, _RADII[0])[2]
    if len(residual) < _MIN_POINTS:
        return float("nan")
    return float(np.quantile(np.abs(residual), 0.75))
