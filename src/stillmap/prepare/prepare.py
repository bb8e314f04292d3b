"""From what a reader returns to a recording that can be mapped."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays, se2
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.prepare.beam_times import DIRECTION_KEY, SPIN_KEY, add_beam_times
from stillmap.prepare.lasers import mirror_beams
from stillmap.prepare.options import LaserOptions, ReadOptions
from stillmap.prepare.self_filter import remove_self_returns
from stillmap.prepare.time_window import TimeWindow, select_time


def prepare(recording: Recording, options: ReadOptions) -> Recording:
    """What follows from all scans: beam times of spinning lidars, no returns from the robot itself.

    In 2D the range rules (`lasers.place_beams`) have seen to that.

    Raises:
        InputError: options are for recordings of another dimension.
    """
    if recording.dimension == 2:
        if options.spin not in ("auto", "none") or options.cameras is not None:
            name = "cameras" if options.spin in ("auto", "none") else "spin"
            raise InputError(f"read.{name} is for 3D recordings, this one is in 2D")
        return recording
    stated = recording.source.pop(DIRECTION_KEY, "auto")
    recording = add_beam_times(recording, stated if options.spin == "auto" else options.spin)
    if options.spin == "none" and recording.beam_time is None:
        source = {**recording.source, SPIN_KEY: {"direction": "none"}}
        recording = replace(recording, source=source)
    return remove_self_returns(recording) if options.self_filter else recording


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
