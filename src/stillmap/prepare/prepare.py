"""From what a reader returns to a recording that can be mapped."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from stillmap.core import arrays, se2
from stillmap.core.array_types import Bool, Float32
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.source import LaserPose, Spin
from stillmap.prepare.beam_times import add_beam_times
from stillmap.prepare.gravity import align_to_gravity
from stillmap.prepare.lasers import RawLasers, mirror_beams, place_beams
from stillmap.prepare.options import LaserOptions, ReadOptions
from stillmap.prepare.self_filter import remove_self_returns

_LIMITS = ("min_range", "max_range", "free_range")
_LASERS = tuple(f"{laser}_{name}" for laser in ("laser", "laser2") for name in LaserOptions._fields)


def prepare(
    raw: Recording | RawLasers, options: ReadOptions, scratch: Path | None = None
) -> Recording:
    """Hits by what readings mean, z up, beam times of spinning lidars, no returns from the robot.

    Raises:
        InputError: options are for recordings of another dimension, or a laser that is not there.
    """
    return complete(interpret(raw, options, scratch), options, scratch)


def interpret(raw: Recording | RawLasers, options: ReadOptions, scratch: Path | None) -> Recording:
    """The recording, its hits by the range rule of planar lasers or by the limits of ranges, with
    poses of lasers that options give.

    Raises:
        InputError: a laser pose is given for a 3D recording or a laser that does not exist.
    """
    if isinstance(raw, RawLasers):
        return place_beams(raw, options, scratch)
    recording = _limit_ranges(raw, options)
    options.check_laser_count(len(recording.T_base_sensor))
    for number in range(min(len(recording.T_base_sensor), 2)):
        recording = _apply_laser_options(recording, number, options.laser(number))
    return recording


def complete(recording: Recording, options: ReadOptions, scratch: Path | None) -> Recording:
    """Add what follows from all scans: in 2D nothing, where the range rule saw to it.

    Raises:
        InputError: options are for recordings of another dimension.
    """
    if recording.dimension == 2:
        if options.spin not in ("auto", "none") or options.cameras is not None:
            name = "cameras" if options.spin in ("auto", "none") else "spin"
            raise InputError(f"read.{name} is for 3D recordings, this one is in 2D")
        return recording
    recording = align_to_gravity(recording)
    stated = recording.source.spin_direction or "auto"
    source = replace(recording.source, spin_direction=None)
    recording = replace(recording, source=source, scratch=scratch)
    recording = add_beam_times(recording, stated if options.spin == "auto" else options.spin)
    if options.spin == "none" and recording.beam_time is None:
        recording = replace(recording, source=replace(source, spin=Spin("none")))
    return remove_self_returns(recording) if options.self_filter else recording


def _limit_ranges(recording: Recording, options: ReadOptions) -> Recording:
    """Hits nearer than `min_range` become unusable, those from `max_range` on maximum-range beams;
    these end at `free_range`, or `max_range`. `source.max_range` is the default of a format."""
    defaults, source = ReadOptions(), replace(recording.source, max_range=None)
    if options.max_range is None and recording.source.max_range is not None:
        nearest = max(recording.source.max_range, options.min_range + 1e-3)
        options = replace(options, max_range=nearest)
    names = [n for n in (*_LIMITS, *_LASERS) if getattr(options, n) != getattr(defaults, n)]
    if names:
        source.read_options = {name: getattr(options, name) for name in names}
    recording = replace(recording, source=source)
    if not set(names) & set(_LIMITS):
        return recording
    points, hit = recording.points, recording.hit
    # those that can be written are of a reader that has just made them: nobody else has them
    points = points if points.flags.writeable else arrays.copy(points, recording.scratch)
    hit = hit if hit.flags.writeable else arrays.copy(hit, recording.scratch)
    for block in arrays.iter_blocks(points, hit):
        _limit_block(points[block], hit[block], options)
    return replace(recording, points=points, hit=hit)


def _limit_block(points: Float32, hit: Bool, options: ReadOptions) -> None:
    length = np.sqrt(arrays.squared_lengths(points))
    if options.max_range is not None:
        hit &= ~(length >= options.max_range)
    end = min(v for v in (options.max_range, options.free_range, np.inf) if v is not None)
    long = ~hit & (length > end)
    points[long] *= (end / length[long])[:, None].astype(np.float32)
    near = hit & (length < options.min_range)
    points[near], hit[near] = np.nan, False


def _apply_laser_options(recording: Recording, number: int, laser: LaserOptions) -> Recording:
    if laser.pose == (None, None, None) and not laser.upside_down and laser.fov is None:
        return recording
    if recording.dimension != 2:
        raise InputError("the laser's place on the robot can be given for 2D recordings only")
    T = np.array(recording.T_base_sensor)
    recorded = LaserPose(*se2.parameters(T[number]).tolist())
    T[number] = recorded.override(laser.pose).matrix()
    changed = replace(recording, T_base_sensor=T)
    return mirror_beams(changed, number) if laser.upside_down else changed
