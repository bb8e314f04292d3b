"""How a recording's readings are understood.

Reading options laid over a recording whose readings are understood already.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays, se2
from stillmap.core.config import option
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording

MAX_PLAUSIBLE_RANGE = (
    1000.0  # m: no laser in the plane sees so far; drivers write 1e10 or FLT_MAX for +inf
)

MAX_POINT_DISTANCE = 1e5  # m: nothing at all sees so far; damaged numbers do

_LARGEST = {"x": 1e3, "y": 1e3, "theta": 1e3, "fov": 2.0 * math.pi + 1e-6}  # m, m, rad, rad


class LaserOptions(NamedTuple):
    """What the options say of one laser; None: found in the recording. Metres and radians."""

    x: float | None
    y: float | None
    theta: float | None
    upside_down: bool | None
    fov: float | None

    @property
    def pose(self) -> tuple[float | None, float | None, float | None]:
        """Where it sits on the robot."""
        return self.x, self.y, self.theta


_NOTHING_GIVEN = LaserOptions(None, None, None, None, None)


@dataclass(frozen=True)
class ReadOptions:
    """Options of `stillmap.recording.read`; None means: found in the recording."""

    min_range: float = option(0.0, "m: nearer readings are unusable (the robot itself)")
    max_range: float | None = option(
        None, "m: readings at or above it are maximum range; unset: found from the readings"
    )
    zero_means: Literal["auto", "unusable", "max-range"] = option(
        "auto", "what a reading of zero stands for: auto, unusable or max-range"
    )
    free_range: float | None = option(
        None, "m: how much free space a maximum-range beam shows; unset: what the laser really sees"
    )
    self_filter: bool = option(
        True,
        "leave out readings of the robot itself: beams that end at the same place wherever it is",
    )
    spin: Literal["auto", "none", "clockwise", "counter-clockwise"] = option(
        "auto",
        "how a lidar whose beams have no times turns, seen from above: clockwise, "
        "counter-clockwise, none: beams count as taken at once; auto: clockwise for raw drives of "
        "KITTI, else none",
    )
    spin_rate: float | None = option(
        None, "turns per second of that; unset: one from stamp to stamp"
    )
    spin_start: float = option(
        math.pi, "rad: direction in which its turns begin, 0 ahead, to the left; behind"
    )
    spin_stamp: float | None = option(
        None,
        "rad: direction in which it looks at a scan's stamp; unset: ahead for KITTI, else where "
        "turns begin",
    )
    laser_x: float | None = option(
        None, "m: first laser ahead of the robot's centre; unset: found in the recording"
    )
    laser_y: float | None = option(
        None, "m: first laser left of the robot's centre; unset: found in the recording"
    )
    laser_theta: float | None = option(
        None, "rad: first laser turned on the robot; unset: found in the recording"
    )
    laser_upside_down: bool | None = option(
        None, "first laser's beams turn the other way round; unset: found in the recording"
    )
    laser_fov: float | None = option(
        None, "rad: all beams of the first laser, of lines without angles; unset: half a circle"
    )
    laser2_x: float | None = option(None, "m: second laser ahead of the robot's centre")
    laser2_y: float | None = option(None, "m: second laser left of the robot's centre")
    laser2_theta: float | None = option(None, "rad: second laser turned on the robot")
    laser2_upside_down: bool | None = option(None, "second laser's beams turn the other way round")
    laser2_fov: float | None = option(None, "rad: all beams of the second laser")
    cameras: str | None = option(
        None, "file that says of cameras what the recording does not, and names further pictures"
    )
    depth_step: int = option(2, "of depth pictures: every so many columns and rows become beams")
    depth_max: float = option(
        5.0,
        "m: readings of depth pictures from there on count as nothing there, if max_range is unset",
    )
    depth_scale: float | None = option(
        None, "units of depth pictures per metre; unset: 1000, 5000 of TUM RGB-D"
    )
    register: bool = option(
        True, "find where the colour camera of a folder like 7-Scenes sits, by the edges of things"
    )
    level: bool = option(
        True, "turn the recorded poses of RGB-D folders so that z is up: their world lies anyhow"
    )
    topic: str | None = option(
        None, "of a bag: topics of the scans to use, with commas; unset: found by type and rate"
    )
    tilting_topic: str | None = option(
        None, "of a bag: scans of a laser that tilts or pans; they are not for the map"
    )
    base_frame: str | None = option(
        None, "of a bag: the robot's own frame; unset: found in the transforms"
    )
    odom_frame: str | None = option(
        None, "of a bag: the frame in which odometry moves the robot; unset: found"
    )

    def __post_init__(self) -> None:
        if not 0.0 <= self.min_range < MAX_PLAUSIBLE_RANGE:
            raise ValueError(
                f"min_range must lie in 0 to {MAX_PLAUSIBLE_RANGE:g} m, got {self.min_range}"
            )
        for name in ("max_range", "free_range"):
            value = getattr(self, name)
            if value is not None and not self.min_range < value <= MAX_PLAUSIBLE_RANGE:
                raise ValueError(
                    f"{name} must lie in min_range to {MAX_PLAUSIBLE_RANGE:g} m, got {value}"
                )
        if self.spin_rate is not None and not 0.0 < self.spin_rate <= 1000.0:
            raise ValueError(
                f"spin_rate must lie in 0 to 1000 turns per second, got {self.spin_rate}"
            )
        for name in ("spin_start", "spin_stamp"):
            if getattr(self, name) is not None and not abs(getattr(self, name)) <= 2.0 * math.pi:
                raise ValueError(f"{name} must lie within a turn, got {getattr(self, name)}")
        if not 1 <= self.depth_step <= 64:
            raise ValueError(f"depth_step must lie in 1 to 64, got {self.depth_step}")
        if not 0.0 < self.depth_max <= MAX_PLAUSIBLE_RANGE:
            raise ValueError(
                f"depth_max must lie in 0 to {MAX_PLAUSIBLE_RANGE:g} m, got {self.depth_max}"
            )
        if self.depth_scale is not None and not 1e-3 <= self.depth_scale <= 1e6:
            raise ValueError(f"depth_scale must lie in 0.001 to 1e6, got {self.depth_scale}")
        for name in ("topic", "tilting_topic", "base_frame", "odom_frame", "cameras"):
            if getattr(self, name) is not None and not getattr(self, name).strip():
                raise ValueError(f"{name} must name something")
        for number, laser in enumerate(("laser", "laser2")):
            for name, largest in _LARGEST.items():
                value = getattr(self.laser(number), name)
                if value is not None and not abs(value) < largest:
                    raise ValueError(f"{laser}_{name} must be a small finite number, got {value}")
            fov = self.laser(number).fov
            if fov is not None and not fov > 0.0:
                raise ValueError(f"{laser}_fov must be positive, got {fov}")

    def laser(self, number: int) -> LaserOptions:
        """What is said of a laser, from 0."""
        if number > 1:
            return _NOTHING_GIVEN
        prefix = ("laser", "laser2")[number]
        return LaserOptions(*(getattr(self, f"{prefix}_{name}") for name in LaserOptions._fields))

    def check_laser_count(self, number: int) -> None:
        """Refuses options for a laser that is not there.

        Raises:
            InputError: there are only `number` lasers.
        """
        if number < 2 and self.laser(1) != _NOTHING_GIVEN:
            raise InputError("options speak of a second laser, and there is none (laser2_...)")


def apply_options(recording: Recording, options: ReadOptions) -> Recording:
    """`recording` narrowed by the options; itself where they are the defaults.

    Nearer than `min_range`: unusable. From `max_range` on: maximum range, ending there. A
    maximum-range beam shows at most `free_range`. A laser upside down is turned round from how it
    was recorded. `zero_means`, `own_body` and fields of view have nothing left to say.

    Raises:
        InputError: a laser's place on the robot is given, and the recording is 3D or has no such
            laser; a topic or frame is named.
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
    if options.min_range > 0 or options.max_range is not None or options.free_range is not None:
        changed = _narrowed(changed, options)
    options.check_laser_count(len(recording.T_base_sensor))
    for number in range(min(len(recording.T_base_sensor), 2)):
        changed = _with_laser(changed, number, options.laser(number))
    return changed


def _narrowed(recording: Recording, options: ReadOptions) -> Recording:
    points = arrays.copy(recording.points, recording.scratch)
    hit = arrays.copy(recording.hit, recording.scratch)
    for block in arrays.iter_blocks(points, hit):
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


def _with_laser(recording: Recording, number: int, given: LaserOptions) -> Recording:
    if given.pose == (None, None, None) and not given.upside_down:
        return recording
    if recording.dimension != 2:
        raise InputError("the laser's place on the robot can be given for 2D recordings only")
    T = np.array(recording.T_base_sensor)
    found = se2.parameters(T[number])
    place = (f if w is None else w for f, w in zip(found, given.pose, strict=True))
    T[number] = se2.matrix(*place)
    changed = replace(recording, T_base_sensor=T)
    return _mirrored(changed, number) if given.upside_down else changed


def _mirrored(recording: Recording, number: int) -> Recording:
    """The beams of one laser turned the other way round."""
    points = arrays.copy(recording.points, recording.scratch)
    scans = np.flatnonzero(recording.sensor == number).tolist()
    for t in arrays.release_periodically(scans, lambda: arrays.release_pages(points)):
        points[recording.beams_of(t), 1] *= -1.0
    return replace(recording, points=points)
