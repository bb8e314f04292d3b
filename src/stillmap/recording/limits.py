"""Reading options laid over a recording whose readings are understood already."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.errors import InputError
from stillmap.recording import spool
from stillmap.recording.model import Recording
from stillmap.recording.options import GivenLaser, ReadOptions


def applied(recording: Recording, options: ReadOptions) -> Recording:
    """`recording` narrowed by the options; itself where they are the defaults.

    Nearer than `min_range`: unusable. From `max_range` on: maximum range, ending there. A
    maximum-range beam shows at most `free_range`. A laser upside down is turned round from how it
    was recorded. `zero_means`, `own_body` and fields of view have nothing left to say.

    Raises:
        InputError: a laser's place on the robot is given, and the recording is 3D or has no such
            laser; a topic or frame is named.
    """
    defaults = ReadOptions(zero_means=options.zero_means, own_body=options.own_body)
    if options == defaults:
        return recording
    given = {key: value for key, value in vars(options).items() if value != getattr(defaults, key)}
    of_bags = ("topic", "tilting_topic", "base_frame", "odom_frame")
    named = next((key for key in of_bags if key in given), None)
    if named is not None:
        raise InputError(f"read.{named} is for bags: this recording has no topics and frames")
    changed = replace(recording, source={**recording.source, "read_options": given})
    if options.min_range > 0 or options.max_range is not None or options.free_range is not None:
        changed = _narrowed(changed, options)
    options.require_lasers(len(recording.T_base_sensor))
    for number in range(min(len(recording.T_base_sensor), 2)):
        changed = _with_laser(changed, number, options.laser(number))
    return changed


def _narrowed(recording: Recording, options: ReadOptions) -> Recording:
    points = spool.copied(recording.points, recording.scratch)
    hit = spool.copied(recording.hit, recording.scratch)
    for block in spool.blocks(points, hit):
        _narrow(points[block], hit[block], options)
    return replace(recording, points=points, hit=hit)


def _narrow(points: NDArray[np.float32], hit: NDArray[np.bool_], options: ReadOptions) -> None:
    length = np.linalg.norm(points, axis=1)
    if options.max_range is not None:
        hit &= ~(length >= np.float32(options.max_range))
    ends = [v for v in (options.max_range, options.free_range) if v is not None]
    if ends:
        too_far = ~hit & (length > np.float32(min(ends)))
        points[too_far] *= (np.float32(min(ends)) / length[too_far])[:, None]
    near = hit & (length < np.float32(options.min_range))
    points[near], hit[near] = np.nan, False


def _with_laser(recording: Recording, number: int, given: GivenLaser) -> Recording:
    if given.place == (None, None, None) and not given.upside_down:
        return recording
    if recording.dimension != 2:
        raise InputError("the laser's place on the robot can be given for 2D recordings only")
    T = np.array(recording.T_base_sensor)
    found = se2.parameters(T[number])
    place = (f if w is None else w for f, w in zip(found, given.place, strict=True))
    T[number] = se2.matrix(*place)
    changed = replace(recording, T_base_sensor=T)
    return _mirrored(changed, number) if given.upside_down else changed


def _mirrored(recording: Recording, number: int) -> Recording:
    """The beams of one laser turned the other way round."""
    points = spool.copied(recording.points, recording.scratch)
    scans = np.flatnonzero(recording.sensor == number).tolist()
    for t in spool.in_turn(scans, lambda: spool.let_go(points)):
        points[recording.beams_of(t), 1] *= -1.0
    return replace(recording, points=points)
