"""Reconstruction of moving objects: the best partial scan, or several registered ones (Sect. 4.5).

Static structure, as a hedge or the edge of a wall, is now and then labelled dynamic and tracked; an
object whose surroundings are mostly static at its time gets no model.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from stillmap.core.array_types import Float, Index
from stillmap.core.short_repr import ShortRepr
from stillmap.mesh import partial_scans
from stillmap.mesh.inputs import MeshInputs, ObjectFrame, TrackedBox
from stillmap.mesh.partial_scans import PartialScan, PartialSurface
from stillmap.mesh.range_image import Patch
from stillmap.mesh.returns import HALF_CAR, DynamicReturns, ObjectTrack
from stillmap.mesh.triangle_mesh import Mesh, subdivide
from stillmap.mesh.tsdf import integrate_patches

MERGE_WINDOW = 0.5  # s before and after the best partial scan, of those registered to it
_MAX_VIEW_OFFSET = 0.05  # m of a partial surface from the best one: else it is left out
_SWEEP_WINDOW = 0.4  # s for which people are taken to keep their shape under a tilting laser
_SWEEP_FACTORS = (1.0, 2.0, 4.0)  # of that window, one after the other, until there is a surface
_MIN_AREA = 0.01  # m2 of a model
_MIN_HEIGHT = 0.05  # m from its lowest to its highest point: flatter ones are rough ground
_MIN_P_DYNAMIC = 0.7  # mean P(dynamic) around a model
_POINT_DISTANCE = 0.2  # m from its surface within which returns count for that
_MIN_RETURN_HEIGHT = 0.1  # m above its bottom of these returns: lower ones may be the ground's
_SAMPLE_SHARE = 0.5  # of that distance between samples of the surface
_MIN_VOXEL, _MAX_VOXEL = 0.03, 0.06  # m
_VOXEL_SHARE = 0.7  # of the beam spacing
_TRUNCATION = 6.0, 5.0  # voxels: partial surfaces are a few apart
_MAX_FACES = 200_000  # of an object
_MIN_VIEWS, _MIN_VIEW_SHARE = 1.5, 0.4  # partial surfaces of a voxel, or share where there are few
_MERGE_DEPTH = 1.0  # m along the line of sight that one of several partial surfaces may bridge
_MIN_VERTICES = 200  # of the best partial surface: fewer do not tell how others fit
_MIN_KEPT_SHARE = 0.5  # of the partial surfaces, and of the best one's area

IMAGE_WINDOW = 0.5  # s between an observation and an image of an object that is not rigid
_FAR_IMAGE_PENALTY = 4.0  # an interval far from all images counts 1 / (1 + this)


@dataclass(frozen=True, eq=False)
class ObjectShape(ShortRepr):
    """The surface of a moving object.

    Attributes:
        id: of the object.
        mesh: in the object's frame: x ahead, y left, z up, on the ground below its center.
        frame: pose of that frame over time.
        rigid: whether it was merged from several partial scans.
        seconds: time of this shape, by the clock of boxes: center of the best partial scan.
        span: s, first and last beam that it is made of.
    """

    id: int
    mesh: Mesh
    frame: ObjectFrame
    rigid: bool
    seconds: float
    span: tuple[float, float]


def reconstruct_object(
    tracks: Sequence[ObjectTrack], returns: DynamicReturns, images: Sequence[Float]
) -> ObjectShape | None:
    """The surface of a moving object; None where too little of it was seen, or it stood still.

    Args:
        tracks: of the object.
        returns: the dynamic returns.
        images: (N,) s, times of the images that show each track's object.
    """
    own = np.unique(np.concatenate([one.returns for one in tracks]))
    if not len(own):
        return None
    fast = any(one.box.is_fast for one in tracks)
    rigid = fast or any(one.box.is_large for one in tracks)
    durations = [k * _SWEEP_WINDOW for k in _SWEEP_FACTORS] if returns.inputs.is_planar else [0.0]
    for duration in durations:
        one, span = _best_track(tracks, images, duration, returns)
        frame = ObjectFrame.from_track(one.box)
        scan = partial_scans.extract_partial_scan(own, span, frame, fast, returns)
        if scan is None:
            continue
        mesh = partial_scans.triangulate_partial_scan(scan, rigid, HALF_CAR)
        if not _is_large_enough(mesh, _MIN_AREA):
            continue
        now = 0.5 * sum(scan.span)
        shape = None
        if rigid and not returns.inputs.is_planar and len(mesh.vertices) >= _MIN_VERTICES:
            shape = _merge_partial_scans(one, own, now, fast, returns)
        shape = shape or ObjectShape(one.object.id, mesh, frame, False, now, scan.span)
        p_dynamic = _mean_p_dynamic(shape.mesh, shape.frame, shape.span, returns.inputs)
        return shape if p_dynamic >= _MIN_P_DYNAMIC else None
    return None


def _best_track(
    tracks: Sequence[ObjectTrack], images: Sequence[Float], duration: float, returns: DynamicReturns
) -> tuple[ObjectTrack, tuple[float, float]]:
    """The track that is observed best, and the interval in which it is."""
    found = []
    for one, shown in zip(tracks, images, strict=True):
        if len(one.returns):
            scans = returns.inputs.deskewed.scans_of(returns.beam[one.returns])
            seconds = returns.seconds[one.returns]
            found.append((one, _find_best_interval(seconds, scans, duration, shown)))
    one, (first, last, _) = max(found, key=lambda each: each[1][2])
    return one, (first, last)


def _find_best_interval(
    seconds: Float, scan: Index, duration: float, images: Float
) -> tuple[float, float, float]:
    """The interval with most returns on an object, preferably near an image; start, end, score.

    Args:
        seconds: (n,) times of returns on it, n > 0.
        scan: (n,) number of the scan, rising.
        duration: s; 0: one scan.
        images: (N,) s, when images show the object; an interval `IMAGE_WINDOW` away from all
            counts one fifth.
    """
    if duration == 0.0:
        ends = np.flatnonzero(np.diff(scan)) + 1
        a, b = np.concatenate([[0], ends]), np.concatenate([ends, [len(scan)]])
        first, last = np.minimum.reduceat(seconds, a), np.maximum.reduceat(seconds, a)
        score = (b - a).astype(np.float64)
    else:
        first = np.sort(seconds)
        at = np.searchsorted(first, first + duration, side="right")
        last, score = first[at - 1], (at - np.arange(len(first))).astype(np.float64)
    if len(images):
        away = np.abs(0.5 * (first + last)[:, None] - images).min(axis=1)
        penalty = np.minimum(_FAR_IMAGE_PENALTY * away / IMAGE_WINDOW, _FAR_IMAGE_PENALTY)
        score = score / (1.0 + penalty)
    best = int(np.argmax(score))
    return float(first[best]), float(last[best]), float(score[best])


def _is_large_enough(mesh: Mesh, area: float) -> bool:
    """True if a surface has an area, and is higher than rough ground."""
    if not len(mesh) or mesh.areas().sum() < area:
        return False
    return bool(np.ptp(mesh.vertices[:, 2]) >= _MIN_HEIGHT)


def _mean_p_dynamic(
    mesh: Mesh, frame: ObjectFrame, span: tuple[float, float], inputs: MeshInputs
) -> float:
    """Mean P(c = 0) of the returns around an object, but for those on the ground.

    Args:
        mesh: its surface, in its frame.
        frame: pose of that frame.
        span: s, start and end.
        inputs: the beams.

    Returns:
        NaN where there are no such returns.
    """
    deskewed = inputs.deskewed
    fine, _ = subdivide(mesh, _SAMPLE_SHARE * _POINT_DISTANCE)
    tree = cKDTree(fine.vertices)
    low = fine.vertices.min(axis=0) - _POINT_DISTANCE
    high = fine.vertices.max(axis=0) + _POINT_DISTANCE
    low[2] = max(low[2], _MIN_RETURN_HEIGHT)
    beams, seconds = inputs.beams_within(*span)
    hit = deskewed.hit[beams]
    at = frame.to_object(seconds[hit], deskewed.end_points(beams[hit], inputs.poses))
    some = np.flatnonzero(((at > low) & (at < high)).all(axis=1))
    distance = tree.query(at[some], distance_upper_bound=_POINT_DISTANCE)[0]
    near = inputs.p_static[beams[hit][some[np.isfinite(distance)]]]
    return 1.0 - float(near.mean(dtype=np.float64)) if len(near) else float("nan")


def _merge_partial_scans(
    one: ObjectTrack, own: Index, now: float, fast: bool, returns: DynamicReturns
) -> ObjectShape | None:
    """The surface of a rigid object from the partial scans around a time; None: they do not fit."""
    frame = ObjectFrame.from_track(straighten_track(one.box, now, MERGE_WINDOW))
    scans = _partial_scans(own, now, frame, fast, returns)
    surfaces = [_make_surface(scan, now) for scan in scans]
    if len(surfaces) < 2:
        return None
    best = int(np.argmin([abs(surface.time_offset) for surface in surfaces]))
    motion = partial_scans.register_surfaces(surfaces, best)
    moved = [surface.transform(motion) for surface in surfaces]
    fits = [
        partial_scans.surface_distance(surface, moved[best]) <= _MAX_VIEW_OFFSET
        for surface in moved
    ]
    kept = [k for k, is_near in enumerate(fits) if is_near or k == best]
    if len(kept) < max(2.0, _MIN_KEPT_SHARE * len(surfaces)):
        return None
    mesh = _fuse_patches([moved[k].to_patch() for k in kept])
    min_area = max(_MIN_AREA, _MIN_KEPT_SHARE * surfaces[best].mesh.areas().sum())
    if not _is_large_enough(mesh, min_area):
        return None
    times = np.array([surfaces[k].time_offset for k in kept])
    corrections = [partial_scans.motion_transform(motion, at) for at in times.tolist()]
    offset = np.array([[*t[:2], np.arctan2(R[1, 0], R[0, 0])] for R, t in corrections])
    span = min(scans[k].span[0] for k in kept), max(scans[k].span[1] for k in kept)
    corrected = ObjectFrame(frame.box, now + times, offset)
    return ObjectShape(one.object.id, mesh, corrected, True, now, span)


def _partial_scans(
    own: Index, now: float, frame: ObjectFrame, fast: bool, returns: DynamicReturns
) -> list[PartialScan]:
    """The partial scans of an object around a time, sorted by time."""
    near = partial_scans.within_time(own, returns.seconds, now - MERGE_WINDOW, now + MERGE_WINDOW)
    scan = returns.inputs.deskewed.scans_of(returns.beam[near])
    out = []
    for part in np.split(near, np.flatnonzero(np.diff(scan)) + 1):
        if len(part):
            seconds = returns.seconds[part]
            span = float(seconds.min()), float(seconds.max())
            partial_scan = partial_scans.extract_partial_scan(own, span, frame, fast, returns)
            out += [partial_scan] if partial_scan is not None else []
    # scans of several sensors overlap in time
    return sorted(out, key=lambda one: one.span[0] + one.span[1])


def _make_surface(scan: PartialScan, now: float) -> PartialSurface:
    mesh = partial_scans.triangulate_partial_scan(scan, True, _MERGE_DEPTH)
    sensor = scan.origin[scan.own].mean(axis=0)
    return PartialSurface.from_mesh(mesh, sensor, 0.5 * sum(scan.span) - now)


def _fuse_patches(patches: Sequence[Patch]) -> Mesh:
    """One surface of several partial surfaces, by TSDF integration."""
    return integrate_patches(
        [(patch, np.ones(len(patch.faces), np.float32)) for patch in patches],
        len(patches),
        object_voxel_size(patches),
        truncation=_TRUNCATION,
        min_weight=min(_MIN_VIEWS, _MIN_VIEW_SHARE * len(patches)),
        min_area=partial_scans.MIN_COMPONENT_AREA,
        max_faces=_MAX_FACES,
    )


def object_voxel_size(patches: Sequence[Patch]) -> float:
    """Metres: a little less than the beam spacing on an object, within bounds."""
    corners = np.concatenate([patch.points[patch.faces] for patch in patches])
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    spacing = float(np.median(edges)) if len(edges) else _MIN_VOXEL
    return float(np.clip(_VOXEL_SHARE * spacing, _MIN_VOXEL, _MAX_VOXEL))


def straighten_track(tracked: TrackedBox, now: float, window: float) -> TrackedBox:
    """The box with the constant velocity that it has at a time, `window` seconds around it."""
    box = tracked.box
    center, heading, bottom = tracked.pose_at(np.array([now]))
    seconds = np.array([now - window, now + window])
    velocity = np.array([np.interp(now, box.seconds, column) for column in box.velocity.T])
    straight = dataclasses.replace(
        box,
        seconds=seconds,
        xy=center + (seconds - now)[:, None] * velocity,
        heading=np.tile(heading, (2, 1)),
        velocity=np.tile(velocity, (2, 1)),
    )
    return TrackedBox(straight, np.tile(bottom, 2), tracked.height)
