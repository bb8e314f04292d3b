"""Planar scans of a laser that tilts or pans, as points in 3D by the transforms of a bag."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays, se2
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros import scan_beams
from stillmap.io.ros.collect import BagContent
from stillmap.io.ros.laser_scan import LaserScans
from stillmap.io.ros.sensor_poses import loss_warning, select_lasers
from stillmap.io.ros.tf import TransformTree
from stillmap.preprocessing.options import ReadOptions

Float = NDArray[np.float64]

_STILL = 0.02  # rad: a laser that turns by less on its robot does not tilt
_PAUSE = 500_000_000  # ns without a transform after which nobody knows how the joint went
_TOGETHER = 1 << 14  # beams placed together


def build_tilting_recording(
    found: BagContent, options: ReadOptions, scratch: Path | None
) -> Recording:
    """The recording in 3D of the one laser that was read.

    Every scan has a sensor of its own, which sits as the laser did at the scan's stamp; a beam lies
    as the laser did at the beam's own time. Where transforms pause, beams are unusable.

    Raises:
        InputError: there are several lasers, or this one does not move on its robot.
    """
    used, T, placed, skipped, _ = select_lasers(found, options)
    scans, T_base_sensor = used[0], T[0]
    if len(used) > 1:
        raise InputError(f"{scans.topic}: scans of several lasers: only one can tilt")
    if _largest_rotation(T_base_sensor) < _STILL:
        raise InputError(
            f"{scans.topic}: {scans.frame!r} does not tilt in {placed.base!r}",
            hint="transforms must say how the joint moves, as robot_state_publisher does",
        )
    rule, more = scan_beams.find_range_rule(scans, options)
    flat = scan_beams.convert_to_beams(used, [rule], [False], scratch)
    points, lost = _place_beams(found.transforms, placed.base, scans, flat, T_base_sensor, scratch)
    hit = arrays.copy(flat.hit, scratch)
    for block in arrays.iter_blocks(hit, points):
        hit[block] &= ~np.isnan(points[block, 0])
    warnings = [*scans.warnings, *(f"{scans.topic}: {text}" for text in more)]
    if lost:
        warnings.append(f"{lost} beams where transforms do not say how the laser is tilted")
    damaged = SkippedRecords().merge(skipped[scans.topic])
    return Recording(
        stamp_ns=scans.stamp_ns[flat.scan],
        offset=flat.offset,
        points=points,
        hit=hit,
        T_base_sensor=T_base_sensor[flat.scan],
        sensor=np.arange(scans.n_scans, dtype=np.int32),
        T_odom_base=None,
        beam_time=flat.beam_time,
        source={
            "sensors": [
                {
                    "name": scans.topic,
                    "frame": scans.frame,
                    "scans": scans.n_scans,
                    "places": scans.n_scans,
                    "ranges": rule.to_dict(),
                }
            ],
            "base_frame": placed.base,
            "base_frame_how": placed.how,
            "skipped": damaged.to_dict(),
            "warnings": warnings + loss_warning(scans.n_scans, damaged),
        },
    )


def _largest_rotation(T: Float) -> float:
    """rad, the largest turn between the first of poses (N, 4, 4) and another."""
    trace = np.einsum("ij,nij->n", T[0, :3, :3], T[:, :3, :3])
    return float(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)).max())


def _place_beams(
    transforms: TransformTree,
    base: str,
    scans: LaserScans,
    flat: scan_beams.Beams,
    T_base_sensor: Float,
    scratch: Path | None,
) -> tuple[NDArray[np.float32], int]:
    """Points (M, 3) in the frame that the laser had at its scan's stamp, and how many are lost."""
    known = np.sort(transforms.stamps_between(base, scans.frame))
    M = len(flat.points)
    points = arrays.empty((M, 3), np.float32, scratch)
    lost = 0
    for first in range(0, M, _TOGETHER):
        block = slice(first, min(first + _TOGETHER, M))
        scan = np.searchsorted(flat.offset, np.arange(block.start, block.stop), side="right") - 1
        at_ns = scans.stamp_ns[flat.scan[scan]]
        if flat.beam_time is not None:
            at_ns = at_ns + np.round(1e9 * flat.beam_time[block].astype(np.float64)).astype(
                np.int64
            )
        located = transforms.lookup(base, scans.frame, at_ns)
        assert located is not None  # it hangs together with the base at the stamps
        T = se2.inverse(T_base_sensor[flat.scan[scan]]) @ located.T
        ends = np.einsum("nij,nj->ni", T[:, :3, :2], flat.points[block].astype(np.float64))
        nobody_knows = _find_pauses(known, at_ns)
        lost += int(np.count_nonzero(nobody_knows & np.isfinite(ends[:, 0])))
        ends = np.where(nobody_knows[:, None], np.nan, ends + T[:, :3, 3])
        points[block] = ends
        arrays.release_pages(points)
    return points, lost


def _find_pauses(known: NDArray[np.int64], at_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(n,) which times lie in a pause of rising times, before the first or after the last."""
    after = np.searchsorted(known, at_ns)
    inside = (after > 0) & (after < len(known))
    k = np.clip(after, 1, len(known) - 1)
    exact = known[np.minimum(after, len(known) - 1)] == at_ns
    return np.asarray(~exact & ~(inside & (known[k] - known[k - 1] <= _PAUSE)))
