"""Models of what moved (Sect. 4.5): what ended on a thing, in its own frame, as a surface.

Whether what was followed moved: what ended there was dynamic, not some of it only.

Of what stands still, as a hedge or the edge of a wall, some beams are now and then taken for
dynamic, and followed; others ended right beside them, at the same time, on what is static.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.objects.frame import ObjectFrame
from stillmap.mesh.objects.merging import ObjectTrack
from stillmap.mesh.objects.registration import (
    DEEPEST,
    PartialScan,
    PartialSurface,
    extract_partial_scan,
    motion_transform,
    register_surfaces,
    surface_distance,
    triangulate_partial_scan,
    within_time,
)
from stillmap.mesh.objects.segmentation import DynamicReturns, beam_seconds, scans_within
from stillmap.mesh.objects.sweep_surface import find_best_interval
from stillmap.mesh.options import MoverOptions, SurfaceOptions
from stillmap.mesh.range_image import Patch
from stillmap.mesh.simplification import subdivide
from stillmap.mesh.texture.occluders import TrackedBox
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.mesh.tsdf import integrate_patches

Float = NDArray[np.float64]

Index = NDArray[np.intp]

_GROUND = 0.1  # m above the foot of a thing, up to where beams may have met the ground

_FINE = 0.5  # of the distance that counts, between points of the surface


def mean_p_dynamic(
    mesh: Mesh, way: ObjectFrame, span: tuple[float, float], sources: MeshInputs, reach: float
) -> float:
    """Mean P(c = 0) of the beams that ended at a thing when it was seen, but for the ground's.

    Args:
        mesh: its surface, in its own frame.
        way: where that frame was.
        span: s, from when to when it was seen.
        sources: the beams.
        reach: metres from its surface.

    Returns:
        NaN where no beam ended there, 0.1 m above its foot or higher.
    """
    seen = sources.deskewed
    fine, _ = subdivide(mesh, _FINE * reach)
    tree = cKDTree(fine.vertices)
    low, high = fine.vertices.min(axis=0) - reach, fine.vertices.max(axis=0) + reach
    low[2] = max(low[2], _GROUND)
    total, count = 0.0, 0
    scans = scans_within(*span, sources)
    for scan in range(scans.start, scans.stop):  # all of a second's would be too many at once
        beams = np.arange(seen.offset[scan], seen.offset[scan + 1])
        seconds = beam_seconds(beams, sources)
        then = (seconds >= span[0]) & (seconds <= span[1]) & seen.hit[beams]
        beams, seconds = beams[then], seconds[then]
        at = way.to_object(seconds, seen.end_points(beams, sources.poses))
        some = np.flatnonzero(((at > low) & (at < high)).all(axis=1))
        off = tree.query(at[some], distance_upper_bound=reach)[0]
        near = sources.p_static[beams[some[np.isfinite(off)]]]
        total += float(near.sum(dtype=np.float64))
        count += len(near)
    return 1.0 - total / count if count else float("nan")


_LONGER = (1.0, 2.0, 4.0)  # times a sweep, one after the other, until there is a surface

_FINEST, _COARSEST = 0.03, 0.06  # m, edges of voxels

_OF_SPACING = 0.7  # of how far beams lie apart

_BEFORE, _BEHIND = 6.0, 5.0  # voxels about a surface: looks are a few of them apart

_SEEN_TWICE = 1.5  # looks that a voxel must be of, where there are many

_OF_LOOKS = 0.4  # or this share of them, where there are few

_DEEP = 1.0  # m along the line of sight that one look of several may bridge

_TOLD = 200  # points of the best look: of fewer nobody can tell how others lie on it

_MOST = 0.5  # of the looks must fit, and of the best one's area be there


@dataclass(frozen=True, eq=False)
class ObjectShape:
    """The surface of a thing that moved.

    Attributes:
        id: of the object.
        mesh: in the thing's own frame: x ahead, y left, z up, on the ground below its middle.
        way: where that frame was.
        rigid: whether it kept its shape.
        seconds: when it was of this shape: of one that is not rigid the middle of the sweep, of a
            rigid one when most of it was seen; by the time of its box.
        span: s, from the first beam of that sweep to the last; what is rigid: of all of them.
    """

    id: int
    mesh: Mesh
    frame: ObjectFrame
    rigid: bool
    seconds: float
    span: tuple[float, float]


def reconstruct_object(
    followed: Sequence[ObjectTrack],
    sources: MeshInputs,
    moves: DynamicReturns,
    options: MoverOptions,
    pictures: Sequence[Float],
) -> ObjectShape | None:
    """The surface of something that moved; None where too little of it was seen, or it stood still.

    Args:
        followed: the objects as which it was followed.
        sources: the beams.
        moves: those on what moves.
        options: see MoverOptions.
        pictures: of each (N,) s, when pictures show it, by the time of its box.
    """
    own = np.unique(np.concatenate([one.returns for one in followed]))
    if not len(own):
        return None
    fast = any(one.is_fast for one in followed)
    rigid = fast or any(one.is_large for one in followed)
    # who is seen by few beams is looked at longer
    for moment in [k * options.sweep for k in _LONGER] if moves.is_planar else [0.0]:
        one, span = _best(followed, pictures, moment, sources, moves, options)
        way = ObjectFrame.from_track(one.box)
        look = extract_partial_scan(own, span, way, fast, sources, moves, options)
        if look is None:
            continue
        mesh = triangulate_partial_scan(look, rigid, DEEPEST, options)
        if not _enough(mesh, options.least, options):
            continue
        now = 0.5 * sum(look.span)
        if rigid and not moves.is_planar and len(mesh.vertices) >= _TOLD:
            whole = _put_together(one, own, now, fast, sources, moves, options)
            if whole is not None:
                return _moving(whole, sources, options)
        shape = ObjectShape(one.object.id, mesh, way, False, now, look.span)
        return _moving(shape, sources, options)
    return None


def _moving(shape: ObjectShape, sources: MeshInputs, options: MoverOptions) -> ObjectShape | None:
    """The shape; None where most of what is there stands still."""
    if options.dynamic == 0.0:
        return shape
    p = mean_p_dynamic(shape.mesh, shape.frame, shape.span, sources, options.about)
    return shape if p >= options.dynamic else None


def _put_together(
    one: ObjectTrack,
    own: Index,
    now: float,
    fast: bool,
    sources: MeshInputs,
    moves: DynamicReturns,
    options: MoverOptions,
) -> ObjectShape | None:
    """What the looks about a time saw of a rigid thing; None: they do not lie over each other."""
    way = ObjectFrame.from_track(straighten_track(one.box, now, options.together))
    looks = _looks(own, now, way, fast, sources, moves, options)
    sweeps = [_sweep(look, now, options) for look in looks]
    if len(sweeps) < 2:
        return None
    best = int(np.argmin([abs(sweep.time_offset) for sweep in sweeps]))
    motion = register_surfaces(sweeps, best)
    moved = [sweep.transform(motion) for sweep in sweeps]
    kept = [
        k
        for k, sweep in enumerate(moved)
        if k == best or surface_distance(sweep, moved[best]) <= options.blurred
    ]
    if len(kept) < max(2.0, _MOST * len(sweeps)):
        return None
    mesh = _fused([moved[k].to_patch() for k in kept], options)
    least = max(options.least, _MOST * sweeps[best].mesh.areas().sum())
    if not _enough(mesh, least, options):
        return None
    later = np.array([sweeps[k].time_offset for k in kept])
    offset = np.array([_in_plane(*motion_transform(motion, t)) for t in later.tolist()])
    span = min(looks[k].span[0] for k in kept), max(looks[k].span[1] for k in kept)
    return ObjectShape(
        one.object.id, mesh, ObjectFrame(way.box, now + later, offset), True, now, span
    )


def _enough(mesh: Mesh, area: float, options: MoverOptions) -> bool:
    """Whether a surface is of something: as large as that, and higher than the ground is rough."""
    if not len(mesh) or mesh.areas().sum() < area:
        return False
    return bool(np.ptp(mesh.vertices[:, 2]) >= options.height)


def _looks(
    own: Index,
    now: float,
    way: ObjectFrame,
    fast: bool,
    sources: MeshInputs,
    moves: DynamicReturns,
    options: MoverOptions,
) -> list[PartialScan]:
    """At a thing about a time, one in each scan, in the order of their times."""
    near = within_time(own, moves.seconds, now - options.together, now + options.together)
    scan = sources.deskewed.scans_of(moves.beam[near])
    out = []
    for part in np.split(near, np.flatnonzero(np.diff(scan)) + 1):
        if len(part):
            seconds = moves.seconds[part]
            span = float(seconds.min()), float(seconds.max())
            look = extract_partial_scan(own, span, way, fast, sources, moves, options)
            out += [look] if look is not None else []
    # scans of several sensors overlap: which begins first may see it last
    return sorted(out, key=lambda look: look.span[0] + look.span[1])


def _sweep(look: PartialScan, now: float, options: MoverOptions) -> PartialSurface:
    mesh = triangulate_partial_scan(look, True, _DEEP, options)
    return PartialSurface.from_mesh(mesh, look.own.origin.mean(axis=0), 0.5 * sum(look.span) - now)


def _in_plane(R: Float, t: Float) -> list[float]:
    """Metres ahead and to the left, rad to the left."""
    return [float(t[0]), float(t[1]), float(np.arctan2(R[1, 0], R[0, 0]))]


def _fused(patches: Sequence[Patch], options: MoverOptions) -> Mesh:
    """One surface of several looks'."""
    voxel = options.voxel or object_voxel_size(patches)
    limits = SurfaceOptions(
        before=_BEFORE,
        behind=_BEHIND,
        fewest=min(_SEEN_TWICE, _OF_LOOKS * len(patches)),
        island=options.island,
    )
    weighed = [(patch, np.ones(len(patch.faces), np.float32)) for patch in patches]
    return integrate_patches(weighed, voxel, limits)


def object_voxel_size(patches: Sequence[Patch]) -> float:
    """Metres: a little less than beams lie apart on a thing, within bounds."""
    edges = [np.zeros(0)]
    for patch in patches:
        corners = patch.points[patch.faces]
        edges.append(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).ravel())
    all_edges = np.concatenate(edges)
    apart = float(np.median(all_edges)) if len(all_edges) else _FINEST
    return float(np.clip(_OF_SPACING * apart, _FINEST, _COARSEST))


def straighten_track(thing: TrackedBox, now: float, reach: float) -> TrackedBox:
    """The same, going on evenly as it does at a time, from `reach` seconds before to after."""
    box = thing.box
    seconds = np.array([now - reach, now + reach])
    velocity = np.array([np.interp(now, box.seconds, column) for column in box.velocity.T])
    at = int(np.clip(np.searchsorted(box.seconds, now, side="right") - 1, 0, None))
    even = dataclasses.replace(
        box,
        seconds=seconds,
        xy=box.center_at(np.array([now])) + (seconds - now)[:, None] * velocity,
        heading=np.tile(box.heading[at], (2, 1)),
        velocity=np.tile(velocity, (2, 1)),
    )
    return TrackedBox(even, np.full(2, np.interp(now, box.seconds, thing.bottom)), thing.height)


def _best(
    followed: Sequence[ObjectTrack],
    pictures: Sequence[Float],
    moment: float,
    sources: MeshInputs,
    moves: DynamicReturns,
    options: MoverOptions,
) -> tuple[ObjectTrack, tuple[float, float]]:
    """Which of some objects is seen best, and when."""
    found = []
    for one, shown in zip(followed, pictures, strict=True):
        if len(one.returns):
            scans, seconds = (
                sources.deskewed.scans_of(moves.beam[one.returns]),
                moves.seconds[one.returns],
            )
            found.append((one, find_best_interval(seconds, scans, moment, options.near, shown)))
    one, (first, last, _) = max(found, key=lambda each: each[1][2])
    return one, (first, last)
