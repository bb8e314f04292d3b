"""Reading options applied to a recording whose ranges are already interpreted."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays, se2
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.prepare.options import LaserOptions, ReadOptions
from stillmap.prepare.time_window import TimeWindow


def apply_options(recording: Recording, options: ReadOptions) -> Recording:
    """Apply time and range limits and laser poses; the recording itself where nothing is set.

    Hits nearer than `min_range` become unusable; hits from `max_range` on become maximum-range
    beams of that length; maximum-range beams are cut to `free_range`; the beams of an upside-down
    laser are mirrored. `zero_means`, `self_filter` and fields of view do not apply here.

    Raises:
        InputError: a laser pose is given for a 3D recording or a laser that does not exist, a
            topic or frame is named, or no scan lies in the time window.
    """
    defaults = ReadOptions(zero_means=options.zero_means, self_filter=options.self_filter)
    if options == defaults:
        return recording
    given = {key: value for key, value in vars(options).items() if value != getattr(defaults, key)}
    of_bags = ("topic", "tilting_topic", "base_frame", "odom_frame")
    named = next((key for key in of_bags if key in given), None)
    if named is not None:
        raise InputError(f"read.{named} is for bags: this recording has no topics and frames")
    changed = replace(recording, source={**recording.source, "read_options": given})
    if window := TimeWindow(options):
        changed = select_time(changed, window)
    if options.min_range > 0 or options.max_range is not None or options.free_range is not None:
        changed = _limit_ranges(changed, options)
    options.check_laser_count(len(recording.T_base_sensor))
    for number in range(min(len(recording.T_base_sensor), 2)):
        changed = _apply_laser_options(changed, number, options.laser(number))
    return changed


def select_time(recording: Recording, window: TimeWindow, where: str = "") -> Recording:
    """The scans and images of a recording in a window; `where` is its path, for messages.

    Raises:
        InputError: there is no such scan.
    """
    inside = window.select_all(recording.stamp_ns)
    window.require_scans(where)
    scans = np.flatnonzero(inside)
    if not len(scans):
        return recording
    rows = slice(int(scans[0]), int(scans[-1]) + 1)  # stamps do not decrease
    beams = slice(int(recording.offset[rows.start]), int(recording.offset[rows.stop]))
    return replace(
        recording,
        stamp_ns=recording.stamp_ns[rows],
        offset=recording.offset[rows.start : rows.stop + 1] - recording.offset[rows.start],
        points=recording.points[beams],
        hit=recording.hit[beams],
        sensor=recording.sensor[rows],
        T_odom_base=None if recording.T_odom_base is None else recording.T_odom_base[rows],
        T_recorded_base=(
            None if recording.T_recorded_base is None else recording.T_recorded_base[rows]
        ),
        beam_time=None if recording.beam_time is None else recording.beam_time[beams],
        images=window.select_images(recording.images),
        record=None if recording.record is None else recording.record[rows],
        source={**recording.source, **window.notes()},
    )


def _limit_ranges(recording: Recording, options: ReadOptions) -> Recording:
    points = arrays.copy(recording.points, recording.scratch)
    hit = arrays.copy(recording.hit, recording.scratch)
    for block in arrays.iter_blocks(points, hit):
        _limit_block(points[block], hit[block], options)
    return replace(recording, points=points, hit=hit)


def _limit_block(points: NDArray[np.float32], hit: NDArray[np.bool_], options: ReadOptions) -> None:
    length = np.linalg.norm(points, axis=1)
    if options.max_range is not None:
        hit &= ~(length >= np.float32(options.max_range))
    ends = [v for v in (options.max_range, options.free_range) if v is not None]
    if ends:
        too_far = ~hit & (length > np.float32(min(ends)))
        points[too_far] *= (np.float32(min(ends)) / length[too_far])[:, None]
    near = hit & (length < np.float32(options.min_range))
    points[near], hit[near] = np.nan, False


def _apply_laser_options(recording: Recording, number: int, laser: LaserOptions) -> Recording:
    if laser.pose == (None, None, None) and not laser.upside_down:
        return recording
    if recording.dimension != 2:
        raise InputError("the laser's place on the robot can be given for 2D recordings only")
    T = np.array(recording.T_base_sensor)
    recorded = se2.parameters(T[number])
    pose = (r if g is None else g for r, g in zip(recorded, laser.pose, strict=True))
    T[number] = se2.matrix(*pose)
    changed = replace(recording, T_base_sensor=T)
    return mirror_beams(changed, number) if laser.upside_down else changed


def mirror_beams(recording: Recording, number: int) -> Recording:
    """Negate the y coordinate of all points of one laser."""
    points = arrays.copy(recording.points, recording.scratch)
    scans = np.flatnonzero(recording.sensor == number).tolist()
    for t in arrays.release_periodically(scans, lambda: arrays.release_pages(points)):
        points[recording.beams_of(t), 1] *= -1.0
    return replace(recording, points=points)
