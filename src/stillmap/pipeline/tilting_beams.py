"""Beams of a tilting laser: their poses by another laser's scans, and boxes that they end in."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Float32, Index, Int64
from stillmap.core.arrays import iter_blocks
from stillmap.core.recording import Recording, beam_stamps_ns
from stillmap.em import GroundMap
from stillmap.em.spatial_coupling import GROUND_CLEARANCE
from stillmap.io.trajectory import bracket_times, embed_in_3d
from stillmap.slam.deskew import MAX_SCAN_GAP, MAX_SPEED
from stillmap.tracking.boxes import MAX_OBJECT_HEIGHT, MIN_VEHICLE_LENGTH, Box

_MARGIN = 0.15  # m around the box of an object, where points are probably dynamic
_MAX_VEHICLE_HEIGHT = 4.0  # m above the ground
_MAX_VERTICAL_GAP = 0.5  # m without any point, above which points belong to something else
_MIN_HEIGHT = 1.0  # m; the planar laser lies lower, so points below in a box are of the object
_BLOCK = 1 << 16  # beams per block


class PosedRecording(NamedTuple):
    """A 3D recording at the poses of a planar one.

    Attributes:
        deskewed: T scans with M beams without motion during a scan; beams without a known pose are
            unusable.
        poses: (T, 4, 4) T_map_base at the stamps, upright at height zero.
        unposed_beams: number of beams without a known pose.
    """

    deskewed: Recording
    poses: Float
    unposed_beams: int


def interpolate_poses(stamp_ns: Int64, poses: Float, at_ns: Int64) -> tuple[Float, Bool]:
    """Poses at given times, along the arc from one scan to the next.

    Args:
        stamp_ns: (T,) of the scans, non-decreasing, T > 0.
        poses: (T, 3, 3) T_map_base.
        at_ns: (N,) times.

    Returns:
        (N, 3, 3) poses, outside the scans' time the first or the last one; (N,) whether they are
        known.
    """
    before, after, seconds, since = bracket_times(stamp_ns, at_ns)
    share = np.clip(since / np.where(seconds > 0.0, seconds, np.inf), 0.0, 1.0)
    twist = se2.log(se2.inverse(poses[before]) @ poses[after])
    known = (at_ns >= stamp_ns[0]) & (at_ns <= stamp_ns[-1])
    leaps = np.linalg.norm(twist[:, :2], axis=1) > MAX_SPEED * seconds
    between = (share > 0.0) & (share < 1.0)
    known &= ~(between & ((seconds > MAX_SCAN_GAP) | leaps))
    return poses[before] @ se2.exp(share[:, None] * twist), known


def pose_recording(recording: Recording, stamp_ns: Int64, poses: Float) -> PosedRecording:
    """Deskews a recording by the poses of other scans.

    Args:
        recording: 3D, M beams.
        stamp_ns: (T,) of the scans of another laser on the same robot, by the same clock.
        poses: (T, 3, 3) T_map_base of these.
    """
    at_scan, known = interpolate_poses(stamp_ns, poses, recording.stamp_ns)
    points = recording.allocate_per_beam(np.float32, (3,))
    hit = recording.allocate_per_beam(np.bool_)
    unposed, step = 0, max(1, _BLOCK * recording.n_scans // max(recording.n_beams, 1))
    for first in range(0, recording.n_scans, step):
        scans = slice(first, min(first + step, recording.n_scans))
        beams = slice(int(recording.offset[scans.start]), int(recording.offset[scans.stop]))
        counts = np.diff(recording.offset[scans.start : scans.stop + 1])
        scan = np.repeat(np.arange(scans.start, scans.stop), counts)
        moved, posed = recording.points[beams], known[scan]
        if recording.beam_time is not None:
            T, posed = interpolate_poses(stamp_ns, poses, beam_stamps_ns(recording, scans))
            T_base_sensor = recording.T_base_sensor[recording.sensor[scan]]
            moved = _transform_points(moved, T_base_sensor, se2.inverse(at_scan[scan]) @ T)
        points[beams] = np.where(posed[:, None], moved, np.nan)
        hit[beams] = recording.hit[beams] & posed
        unposed += int(np.count_nonzero(~posed))
        recording.release_pages(points, hit)
    deskewed = dataclasses.replace(recording, points=points, hit=hit, beam_time=None)
    return PosedRecording(deskewed, embed_in_3d(at_scan), unposed)


def _transform_points(points: Float32, T_base_sensor: Float, T: Float) -> Float32:
    """Points (n, 3) of sensors at (n, 4, 4) on a base moved by T (n, 3, 3), in the sensor frame."""
    R, t = T_base_sensor[:, :3, :3], T_base_sensor[:, :3, 3]
    in_base = np.einsum("nij,nj->ni", R, points) + t
    in_base[:, :2] = np.einsum("nij,nj->ni", T[:, :2, :2], in_base[:, :2]) + T[:, :2, 2]
    return np.asarray(np.einsum("nji,nj->ni", R, in_base - t), np.float32)


class BoxBeams(NamedTuple):
    """Beams that ended in a box.

    Attributes:
        beams: (n,) indices, increasing.
        core: (n,) True in the box itself, False in the margin around it.
    """

    beams: Index
    core: Bool


def select_box_beams(
    boxes: Sequence[Box],
    recording: Recording,
    posed: PosedRecording,
    ground: GroundMap,
    start_ns: int,
) -> list[BoxBeams]:
    """The beams that ended in each box or in its margin, from the ground to the object's top.

    Args:
        boxes: boxes of moving objects; their seconds count from `start_ns`.
        recording: 3D, as read.
        posed: the same at its poses.
        ground: height of the ground.
        start_ns: a stamp.
    """
    ends = _end_points(posed)
    seconds = 1e-9 * (recording.stamp_ns - start_ns)
    early, late = recording.beam_time_span
    out = []
    for box in boxes:
        first = int(np.searchsorted(seconds, box.seconds[0] - box.hold - late))
        stop = int(np.searchsorted(seconds, box.seconds[-1] + box.hold - early, side="right"))
        beams = slice(int(recording.offset[first]), int(recording.offset[stop]))
        stamps = beam_stamps_ns(recording, slice(first, stop))
        at = np.asarray(1e-9 * (stamps - start_ns), np.float64)
        near = np.flatnonzero(_is_near_path(box, ends[beams]))
        xyz = np.asarray(ends[beams][near], np.float64)
        within = box.contains(at[near], xyz[:, :2], _MARGIN)
        near, xyz = near[within], xyz[within]
        core = box.contains(at[near], xyz[:, :2], 0.0)
        height = xyz[:, 2] - ground.height_at(xyz[:, :2])
        is_vehicle = 2.0 * max(box.half_size) >= MIN_VEHICLE_LENGTH
        top = object_height(height, _MAX_VEHICLE_HEIGHT if is_vehicle else MAX_OBJECT_HEIGHT)
        kept = (height > GROUND_CLEARANCE) & (height <= top)
        out.append(BoxBeams(beams.start + near[kept], core[kept]))
    return out


def object_height(height: Float, max_height: float) -> float:
    """Top of an object in m above the ground: of the points that are connected from below.

    Args:
        height: (n,) m, of end points above the ground.
        max_height: m.
    """
    higher = np.sort(height[(height > _MIN_HEIGHT) & (height <= max_height)])
    steps = np.diff(higher, prepend=_MIN_HEIGHT)
    gaps = np.flatnonzero(steps > _MAX_VERTICAL_GAP)
    connected = higher[: gaps[0]] if len(gaps) else higher
    return float(connected[-1]) if len(connected) else min(_MIN_HEIGHT, max_height)


def _end_points(posed: PosedRecording) -> Float32:
    """(M, 3) end points of hits in the map frame, NaN for others."""
    scans = posed.deskewed
    ends = scans.allocate_per_beam(np.float32, (3,))
    for block in iter_blocks(ends, scans.hit):
        hits = block.start + np.flatnonzero(scans.hit[block])
        ends[block] = np.nan
        ends[hits] = scans.end_points(hits, posed.poses)
    return ends


def _is_near_path(box: Box, ends: Float32) -> Bool:
    """(n,) whether end points lie near the path of a box at any time; a cheap first test."""
    beyond = box.hold * float(np.linalg.norm(box.velocity[[0, -1]], axis=1).max())
    radius = float(np.linalg.norm(box.half_size)) + 2.0 * _MARGIN + beyond
    low, high = box.xy.min(axis=0) - radius, box.xy.max(axis=0) + radius
    return np.asarray(((ends[:, :2] >= low) & (ends[:, :2] <= high)).all(axis=1))
