"""Looks at one rigid thing that follow one another, laid over each other in its own frame.

Over a second a car goes evenly: what its track may be wrong by is its velocity, how fast it turns
and how it brakes, few numbers that all looks tell together. Where nothing tells, as along a side
without ends, its track counts.

What one look saw of a thing that moves: a scan in space, or planar ones that follow.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.marching_cubes import remove_small_components
from stillmap.mesh.objects.frame import ObjectFrame
from stillmap.mesh.objects.segmentation import (
    SPACING,
    DynamicReturns,
    beam_seconds,
    beams_in_frame,
    grow_segment,
    in_viewing_cone,
    scans_within,
)
from stillmap.mesh.objects.sweep_surface import ObjectBeams, triangulate_beams
from stillmap.mesh.options import MoverOptions
from stillmap.mesh.range_image import Patch
from stillmap.mesh.triangle_mesh import Mesh

Float = NDArray[np.float64]

Index = NDArray[np.intp]

_GUESSES = (0.0, -1.0, 1.0, -2.0, 2.0, -3.0, 3.0, -4.0, 4.0, -5.0, 5.0, -6.0, 6.0)  # m/s

_GUESSED = 500  # points of a look that tell which one is right

_NEAR = 0.3  # m, farther points are as good as none

_PER_SPEED = 0.002  # m for each m/s: where all are as good the track counts

_FINER = (0.0, *(k * s / 10.0 for k in range(1, 11) for s in (-1.0, 1.0)))  # m/s

_TRACK = (0.7, 0.4, 0.2, 0.2, 2.0, 1.0)  # what is known of `Motion` by its track

_TOLD = (0.1, 0.4, 0.2, 0.2, 2.0, 1.0)  # and by the ends

_SIGMA = 0.03  # m, by how much points lie off a surface

_REACHES = (0.6, 0.3, 0.15)  # m, within which points are of the same place, round by round less

_ROUNDS = 5  # with each of them

_SETTLED = 2  # rounds by which a velocity that is tried is made better

_POINTS = 2000  # of a look, at most: more do not make it better

_FEWEST = 20  # points that say anything

_TELL = 100.0  # points of a look that tell on their own: neighbours are off together

_SAME_SIDE = 0.5  # cosine between normals of one surface


class PartialSurface(NamedTuple):
    """What one look saw of a thing, in its own frame as its track has it.

    Attributes:
        mesh: its surface.
        normals: (V, 3) of length one, of its vertices, towards the sensor.
        place: (3,) where the sensor was.
        later: s after the time at which the frame is known.
    """

    mesh: Mesh
    normals: Float
    sensor: Float
    time_offset: float

    @classmethod
    def from_mesh(cls, mesh: Mesh, place: Float, later: float) -> "PartialSurface":
        """With the normals of the faces around each vertex."""
        spans = np.repeat(mesh.normals() * mesh.areas()[:, None], 3, axis=0)
        at, n = mesh.faces.ravel(), len(mesh.vertices)
        normals = np.stack([np.bincount(at, column, n) for column in spans.T], axis=1)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return cls(mesh, normals / np.maximum(length, 1e-12), place, later)

    def transform(self, motion: Float) -> "PartialSurface":
        """As it lies where the thing went otherwise than its track by `motion` (6,)."""
        R, t = motion_transform(motion, self.time_offset)
        mesh = Mesh(self.mesh.vertices @ R.T + t, self.mesh.faces)
        return self._replace(mesh=mesh, normals=self.normals @ R.T, place=R @ self.sensor + t)

    def to_patch(self) -> Patch:
        """To be fused."""
        points = self.mesh.vertices
        origin = np.tile(self.sensor, (len(points), 1))
        standoff = ((origin - points) * self.normals).sum(axis=1)
        return Patch(points, self.mesh.faces, np.arange(len(points)), origin, standoff)


class _Points(NamedTuple):
    """Some of the vertices of a look, (n, 3) metres, and (n, 3) where they face."""

    at: Float
    facing: Float
    later: float

    @classmethod
    def of(cls, one: PartialSurface, most: int) -> "_Points":
        every = max(1, len(one.mesh.vertices) // most)
        return cls(one.mesh.vertices[::every], one.normals[::every], one.time_offset)

    def moved(self, motion: Float) -> "_Points":
        R, t = motion_transform(motion, self.later)
        return _Points(self.at @ R.T + t, self.facing @ R.T, self.later)


def motion_transform(motion: Float, later: float) -> tuple[Float, Float]:
    """(3, 3) and (3,) metres by which a look has to be moved.

    Args:
        motion: (6,) metres per second ahead, to the left and up, rad per second to the left, metres
            per square second ahead and to the left.
        later: s.
    """
    turn = motion[3] * later
    c, s = np.cos(turn), np.sin(turn)
    t = motion[:3] * later
    t[:2] += 0.5 * motion[4:] * later**2
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), t


def register_surfaces(sweeps: Sequence[PartialSurface], best: int) -> Float:
    """(6,) how the thing went otherwise than its track, as `pose` has it.

    Point to plane against the best look, from the looks beside it to those far from it.
    """
    known = sweeps[best]
    motion = np.zeros(6)
    if len(known.mesh.vertices) < _FEWEST:
        return motion
    tree = cKDTree(known.mesh.vertices)
    some, few = ([_Points.of(one, most) for one in sweeps] for most in (_POINTS, _GUESSED))
    beside = [few[k] for k in (best - 1, best + 1) if 0 <= k < len(sweeps)]
    motion = _ends_meet(beside, known, tree, motion, _GUESSES, _PER_SPEED)
    guess = motion * np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])  # of the rest the track tells more
    others = [k for k in range(len(sweeps)) if k != best]
    farthest = max(abs(one.time_offset) for one in sweeps)
    for part, reach in zip((0.4, 0.7, 1.0), _REACHES, strict=True):
        near = [some[k] for k in others if abs(some[k].later) <= part * farthest + 1e-9]
        for _ in range(_ROUNDS):
            motion = _better(near, known, tree, motion, guess, _TRACK, reach)
    motion = guess = _ends_meet([few[k] for k in others], known, tree, motion, _FINER, 0.0)
    for _ in range(_ROUNDS):
        motion = _better([some[k] for k in others], known, tree, motion, guess, _TOLD, _REACHES[-1])
    return motion


def _ends_meet(
    looks: Sequence[_Points],
    known: PartialSurface,
    tree: "cKDTree[None]",
    motion: Float,
    speeds: tuple[float, ...],
    price: float,
) -> Float:
    """The motion (6,) with another velocity ahead, if by that looks lie nearer to the best one.

    Point to point, so that its ends tell, and not along its sides only. A track of a part of a car
    may be wrong by half its velocity. With each velocity ahead the rest of the motion is made
    better first: along a side that is askew one ahead is nearly as good as one to the left.

    Args:
        looks: the others.
        known: the best one.
        tree: its vertices.
        motion: where to begin.
        speeds: m/s that are tried beside, 0 the first of them.
        price: m for each m/s: where all are as good the track counts.
    """
    found, worth = list[Float](), list[float]()
    for speed in speeds:
        tried = guess = motion + np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0])
        for _ in range(_SETTLED):
            tried = _better(looks, known, tree, tried, guess, _TOLD, _REACHES[1])
        found.append(tried)
        at = np.concatenate([np.zeros((0, 3)), *(one.moved(tried).at for one in looks)])
        off = np.asarray(tree.query(at, distance_upper_bound=_NEAR)[0])
        far = np.minimum(off, _NEAR)
        worth.append((float(far.mean()) if len(far) else 0.0) + price * abs(speed))
    return found[int(np.argmin(worth))]


def _better(
    looks: Sequence[_Points],
    known: PartialSurface,
    tree: "cKDTree[None]",
    motion: Float,
    guess: Float,
    sigma: tuple[float, ...],
    reach: float,
) -> Float:
    """One step of Gauss and Newton from `motion`, held to `guess` by standard deviations."""
    hold = np.diag(1.0 / np.square(sigma))
    H, g = hold.copy(), hold @ (motion - guess)
    for one in looks:
        at, n, residual = _off(one.moved(motion), known, tree, reach)
        if len(at) < _FEWEST:
            continue
        T = one.later
        w = 1.0 / (1.0 + (residual / (3.0 * _SIGMA)) ** 2) ** 2 / _SIGMA**2
        w *= min(1.0, _TELL / len(at))
        around = at - motion_transform(motion, T)[1]
        J = np.stack(
            [
                T * n[:, 0],
                T * n[:, 1],
                T * n[:, 2],
                T * (n[:, 1] * around[:, 0] - n[:, 0] * around[:, 1]),
                0.5 * T**2 * n[:, 0],
                0.5 * T**2 * n[:, 1],
            ],
            axis=1,
        )
        H, g = H + J.T @ (w[:, None] * J), g + J.T @ (w * residual)
    return np.asarray(motion - np.linalg.solve(H, g))


def _off(
    one: _Points, known: PartialSurface, tree: "cKDTree[None]", reach: float
) -> tuple[Float, Float, Float]:
    """(n, 3) points that have a place on what is known, (n, 3) its normals, (n,) metres off it."""
    at, facing, _ = one
    away, nearest = map(np.asarray, tree.query(at, distance_upper_bound=reach))
    near = np.flatnonzero(np.isfinite(away))
    normals = known.normals[nearest[near]]
    same = (facing[near] * normals).sum(axis=1) > _SAME_SIDE
    near, normals = near[same], normals[same]
    residual = ((at[near] - known.mesh.vertices[nearest[near]]) * normals).sum(axis=1)
    return at[near], normals, residual


def surface_distance(one: PartialSurface, known: PartialSurface) -> float:
    """Metres, by which 3 of 4 places of a look lie off another one at most.

    NaN where they have little in common.
    """
    if not len(known.mesh.vertices):
        return float("nan")
    some = _Points.of(one, _POINTS)
    residual = _off(some, known, cKDTree(known.mesh.vertices), _REACHES[0])[2]
    return float(np.quantile(np.abs(residual), 0.75)) if len(residual) >= _FEWEST else float("nan")


_AROUND = 0.03  # s, in which a scan sees the rest of a car

_MOSTLY = 0.1  # of what hangs together is of a track: else another one follows it

DEEPEST = 3.0  # m, the side of a car from its middle to its end


class PartialScan(NamedTuple):
    """What one look saw of a thing.

    Attributes:
        own: beams that ended on it, in its own frame.
        others: those about then that went by it.
        span: s, from the first to the last.
    """

    own: ObjectBeams
    others: ObjectBeams
    span: tuple[float, float]


def extract_partial_scan(
    own: Index,
    span: tuple[float, float],
    way: ObjectFrame,
    fast: bool,
    sources: MeshInputs,
    moves: DynamicReturns,
    options: MoverOptions,
) -> PartialScan | None:
    """What was seen of a thing at a time; None where most of that is of another one.

    Args:
        own: numbers within `moves` of what ended on it at any time, rising.
        span: s, from when to when.
        way: where its own frame is.
        fast: whether all that hangs together with it is its own.
        sources, moves: the beams, and those on what moves.
        options: see MoverOptions.
    """
    around = _AROUND if fast else 0.0
    first, last = span[0] - around, span[1] + around
    scans, offset = scans_within(first, last, sources), sources.deskewed.offset
    beams = np.arange(offset[scans.start], offset[scans.stop])
    seconds = beam_seconds(beams, sources)
    then = (seconds >= first) & (seconds <= last)
    beams, seconds = beams[then], seconds[then]
    mine = within_time(own, moves.seconds, first, last)
    if fast:
        about = moves.in_beam_range(int(beams[0]), int(beams[-1]) + 1)
        every = within_time(np.arange(about.start, about.stop), moves.seconds, first, last)
        place = beams_in_frame(beams[:1], seconds[:1], way, sources).origin[0]
        whole = grow_segment(mine, every, way, place, moves, options)
        if not len(whole) or len(mine) < _MOSTLY * len(whole):
            return None
        mine = whole
        span = float(moves.seconds[mine].min()), float(moves.seconds[mine].max())
    seen = beams_in_frame(moves.beam[mine], moves.seconds[mine], way, sources)
    beside = ~np.isin(beams, moves.beam[mine], assume_unique=True)
    beams, seconds = beams[beside], seconds[beside]
    near = in_viewing_cone(moves.beam[mine], beams, sources)
    return PartialScan(seen, beams_in_frame(beams[near], seconds[near], way, sources), span)


def triangulate_partial_scan(
    look: PartialScan, rigid: bool, deepest: float, options: MoverOptions
) -> Mesh:
    """Triangles between its beams.

    Args:
        look: the beams.
        rigid: whether it keeps its shape, as cars do: their sides are seen at flat angles.
        deepest: metres along the line of sight between beams on the side of such a thing.
        options: see MoverOptions.
    """
    stretch, longest = options.stretch, options.longest
    if rigid:
        away = np.linalg.norm(look.own.points - look.own.origin, axis=1)
        stretch, longest = np.inf, max(longest, SPACING * float(np.median(away)))
    mesh = triangulate_beams(look.own, look.others, stretch, longest, deepest if rigid else 0.0)
    return remove_small_components(mesh, options.island)


def within_time(some: Index, seconds: Float, first: float, last: float) -> Index:
    """Those of numbers (n,) whose times lie between two."""
    return some[(seconds[some] >= first) & (seconds[some] <= last)]
