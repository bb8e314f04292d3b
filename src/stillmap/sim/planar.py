"""Recording of planar lasers: sweeps, mirrors, bumps that show the floor, blind stretches."""

import math
from typing import NamedTuple

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Float32, Int32
from stillmap.core.recording import Recording
from stillmap.core.source import SensorNotes
from stillmap.sim import laser
from stillmap.sim.dynamics import Moment, Motion
from stillmap.sim.episode import Episode
from stillmap.sim.laser import Movers, Returns
from stillmap.sim.options import LaserOptions, RobotOptions
from stillmap.sim.truth import Truth

FLOOR = -3  # Truth.mover of beams that end on the floor
MIRRORED = -4  # Truth.mover of beams that end on what a mirror shows

_MAX_GROUPS = 64  # of simultaneous beams per scan
_BLOCK = 1000  # groups of beams processed at once
_MAX_SIGMAS = 10.0  # of a range
_SPREAD = (0.5, 1.5)  # of pitch and duration of a bump, times their options


def record_planar(episode: Episode) -> tuple[Recording, Truth]:
    """The recording of the planar lasers of an episode, with its truth."""
    scene, motion, walls = episode.scene, episode.motion, episode.walls
    o, T, rng = scene.laser, len(motion.robot), episode.mishap_rng
    sensor = np.arange(T, dtype=np.int32) % o.count
    mounts, recorded = (_mounts(o, pose) for pose in ((o.x, o.y, o.yaw), o.recorded_mount))
    exact = cast_sweeps(motion, walls, mounts[sensor], o)
    angles = laser.compute_beam_angles(o.beams, o.fov)
    bearing = se2.parameters(mounts[sensor])[:, 2:]
    bearing = bearing + (angles if o.upside_down == "no" else -angles)
    if scene.mirrors:
        by = exact.wall >= len(walls) - len(scene.mirrors)
        by &= rng.random(by.shape) >= o.mirror_return_share
        exact = _reflect_beams(exact, by, episode, mounts[sensor], bearing)
    if scene.robot.bump_rate > 0:
        bumps = simulate_bumps(motion.robot, motion.seconds, scene.robot, rng)
        sweep = Sweep.of(o)
        tilt = bumps.tilt(motion.seconds[:, None] + sweep.seconds)
        tilt = np.repeat(tilt, sweep.group, axis=1)[:, : o.beams]
        exact = add_floor(exact, bearing, tilt, o.height)
    on_glass = laser.find_glass(exact.wall, scene)
    ranges, hit = laser.simulate_measurement(exact.range, on_glass, o, episode.sensor_rng)
    blind = find_blind_scans(motion.seconds, o, rng)
    ranges[blind], hit[blind] = o.max_range, False
    if o.upside_down == "known":
        angles = -angles
    points = ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    recording = Recording(
        stamp_ns=episode.stamp_ns,
        offset=np.arange(T + 1, dtype=np.int64) * o.beams,
        points=points.reshape(-1, 2).astype(np.float32),
        hit=hit.ravel(),
        T_base_sensor=recorded,
        sensor=sensor,
        T_odom_base=episode.T_odom_base,
        source=episode.source(_describe_sensors(o, angles)),
        beam_time=np.tile(Sweep.of(o).beam_times(o.beams), T) if o.sweep_time > 0 else None,
    )
    mover = np.where(hit, exact.mover, np.int32(-1)).ravel()
    truth = episode.truth(
        recording.hit & (mover == -1),
        mover,
        se2.matrix(*motion.robot.T),
        T_base_sensor=None if np.array_equal(mounts, recorded) else mounts,
        thing=_find_standing_things(exact, hit, episode),
    )
    return recording, truth


def _find_standing_things(exact: Returns, hit: Bool, episode: Episode) -> Int32 | None:
    """(M,) index of the movable object, standing still, that each beam (T, n) hit; -1: none."""
    if not episode.has_standing_things:
        return None
    scene, still_thing = episode.scene, episode.motion.still_thing
    first = len(scene.walls) + len(scene.glass)
    of_wall = np.full(len(episode.walls), -1, np.int32)
    of_wall[first : first + len(still_thing)] = still_thing
    stands = hit & (exact.mover == -1) & (exact.wall >= 0)
    return np.where(stands, of_wall[exact.wall], np.int32(-1)).ravel()


def _mounts(o: LaserOptions, pose: tuple[float, ...]) -> Float:
    """(S, 3, 3) T_base_sensor of the lasers, the first of which is at x, y, yaw."""
    x, y, yaw = pose
    front = se2.matrix(x, y, yaw)
    return np.stack([front, se2.matrix(0.0, 0.0, np.pi) @ front][: o.count])


def _describe_sensors(o: LaserOptions, angles: Float) -> list[SensorNotes]:
    first, step = float(angles[0]), float(angles[1] - angles[0])
    names = ("simulated laser", "simulated rear laser")[: o.count]
    return [
        SensorNotes(name, beams_per_scan=len(angles), start_angle=first, angle_step=step)
        for name in names
    ]


class Sweep(NamedTuple):
    """Times of the beams of a scan.

    Attributes:
        group: number of simultaneous beams; the last group may be smaller.
        seconds: (G,) after the scan's stamp, of each group.
    """

    group: int
    seconds: Float

    @classmethod
    def of(cls, options: LaserOptions) -> "Sweep":
        """The sweep of a laser: times proportional to the beam angles."""
        n = options.beams
        if options.sweep_time == 0:
            return cls(n, np.zeros(1))
        group = max(2, math.ceil(n / _MAX_GROUPS))
        first = np.arange(0, n, group)
        middle = (first + np.minimum(first + group, n) - 1) / 2
        angles = laser.compute_beam_angles(n, options.fov)
        share = middle * (angles[1] - angles[0]) / options.fov
        return cls(group, options.sweep_time * share)

    def beam_times(self, beams: int) -> Float32:
        """(n,) seconds after the stamp, of each beam of a scan."""
        return np.repeat(self.seconds, self.group)[:beams].astype(np.float32)


def cast_sweeps(motion: Motion, walls: Float, T_base_sensor: Float, o: LaserOptions) -> Returns:
    """The nearest surface on every beam of every scan.

    Args:
        motion: of T scans.
        walls: (W, 4) segments in metres.
        T_base_sensor: (T, 3, 3) pose of the laser of each scan.
        o: the lasers.

    Returns:
        Beams in the order of the scan: from the last angle to the first if the laser is mounted
        upside down.
    """
    sweep, angles = Sweep.of(o), laser.compute_beam_angles(o.beams, o.fov)
    T, G = len(motion.robot), len(sweep.seconds)
    reach = o.max_range + _MAX_SIGMAS * o.range_noise
    # a group of beams is cast as a scan of its own, rotated to the angles of the first group
    turned, group = np.arange(G) * sweep.group * (angles[1] - angles[0]), angles[: sweep.group]
    order = slice(None)
    if o.upside_down != "no":
        turned, group, order = -turned, -group[::-1], slice(None, None, -1)
    block = max(1, _BLOCK // G)
    parts = []
    for first in range(0, T, block):
        scans = np.arange(first, min(first + block, T))
        now = Moment(motion, np.repeat(scans, G), np.tile(sweep.seconds, len(scans)))
        T_robot_sensor = np.repeat(T_base_sensor[scans], G, axis=0)
        poses = se2.parameters(se2.matrix(*now.interpolate(motion.robot).T) @ T_robot_sensor)
        poses[:, 2] += np.tile(turned, len(scans))
        part = laser.cast_beams(poses, group, walls, *now.interpolate_movers(), reach)
        in_order = (values[:, order].reshape(-1, G * sweep.group) for values in part)
        parts.append([values[:, : o.beams] for values in in_order])
    return Returns(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _reflect_beams(
    exact: Returns, by: Bool, episode: Episode, T_base_sensor: Float, bearing: Float
) -> Returns:
    """Returns whose beams go on, from the mirror that they meet, to what it shows.

    What lies behind a second mirror is not followed: the beam ends there.

    Args:
        exact: returns (T, n) that end at mirrors.
        by: (T, n) beams that are reflected; their `wall` is the mirror.
        episode: the motion, and the walls with mirrors among them.
        T_base_sensor: (T, 3, 3) pose of the laser of each scan.
        bearing: (T, n) of the beams in the frame of the base, rad.
    """
    motion, walls, o = episode.motion, episode.walls, episode.scene.laser
    seconds = Sweep.of(o).beam_times(o.beams).astype(np.float64)
    out = Returns(exact.range.copy(), exact.wall.copy(), exact.mover.copy())
    scan, beam = np.nonzero(by)
    now = Moment(motion, scan, seconds[beam])
    robot = now.interpolate(motion.robot)
    heading = robot[:, 2] + bearing[by]
    to_mirror = exact.range[by][:, None]
    origin = (se2.matrix(*robot.T) @ T_base_sensor[scan])[:, :2, 2]
    origin = origin + to_mirror * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    x0, y0, x1, y1 = walls[exact.wall[by]].T
    reflected = 2.0 * np.arctan2(y1 - y0, x1 - x0) - heading
    people, outlines = now.interpolate_movers()
    people = _with_robot(people, robot[:, :2], episode.scene.robot.radius)
    # each beam as a scan of its own, of which the second beam does not count
    poses = np.column_stack([origin, reflected])
    seen = laser.cast_beams(poses, np.array([0.0, 1.0]), walls, people, outlines)
    range, wall, mover = (values[:, 0] for values in seen)
    out.range[by] = to_mirror[:, 0] + range
    out.wall[by] = np.where(mover == -1, wall, np.int32(-1))
    out.mover[by] = np.where(np.isfinite(range), MIRRORED, -1)
    return out


def _with_robot(people: Movers, robot: Float, radius: float) -> Movers:
    """The people (B, Q) and the robot (B, 2), which sees itself, as one more of them."""
    xy = np.concatenate([people.xy, robot[:, None]], axis=1)
    heading = np.pad(people.heading, ((0, 0), (0, 1)))
    semi_axes = np.concatenate([people.semi_axes, [[radius, radius]]])
    return Movers(xy, heading, semi_axes, np.append(people.mover, np.int32(MIRRORED)))


class Bumps(NamedTuple):
    """K bumps of the robot, each a half sine wave of pitch and roll.

    Attributes:
        start: (K,) s, since the beginning of the recording.
        duration: (K,) s.
        peak: (K, 2) rad, pitch (nose down) and roll (left side down) at the peak.
    """

    start: Float
    duration: Float
    peak: Float

    def tilt(self, seconds: Float) -> Float:
        """(..., 2) rad, pitch and roll at times (...); bumps that overlap add up."""
        out = np.zeros((*seconds.shape, 2))
        for start, duration, peak in zip(self.start, self.duration, self.peak, strict=True):
            phase = (seconds - start) / duration
            within = (phase > 0) & (phase < 1)
            out[within] += np.sin(np.pi * phase[within])[:, None] * peak
        return out


def simulate_bumps(
    robot: Float, seconds: Float, options: RobotOptions, rng: np.random.Generator
) -> Bumps:
    """The bumps on the way of a robot, a Poisson process in the distance driven.

    Args:
        robot: (T, 3) poses.
        seconds: (T,) times of them.
        options: rate and size of bumps.
        rng: of their places and sizes.
    """
    steps = np.hypot(*np.diff(robot[:, :2], axis=0).T)
    # being carried or turned on the spot shakes nobody
    steps[np.diff(seconds) > 1.5 * np.median(np.diff(seconds))] = 0.0
    driven = np.concatenate([[0.0], np.cumsum(steps)])
    count = rng.poisson(options.bump_rate * driven[-1])
    start = np.interp(np.sort(rng.uniform(0.0, driven[-1], count)), driven, seconds)
    duration = options.bump_time * rng.uniform(*_SPREAD, count)
    pitch = options.bump_pitch * rng.uniform(*_SPREAD, count) * rng.choice([-1.0, 1.0], count)
    roll = options.bump_roll * rng.standard_normal(count)
    return Bumps(start, duration, np.stack([pitch, roll], axis=-1))


def add_floor(exact: Returns, bearing: Float, tilt: Float, height: float) -> Returns:
    """End beams on a level floor where that is nearer than what they would have met.

    A beam at bearing a of a laser at height h, pitched by p and rolled by r, ends on the floor
    after h / (sin p cos a + sin r sin a); walls are taken for high, and their distances for those
    of the level laser.

    Args:
        exact: returns (T, n) of the level laser.
        bearing: (T, n) of the beams in the frame of the base, rad.
        tilt: (T, n, 2) pitch and roll, rad.
        height: of the laser above the floor, m.
    """
    falls = np.sin(tilt[..., 0]) * np.cos(bearing) + np.sin(tilt[..., 1]) * np.sin(bearing)
    with np.errstate(divide="ignore"):
        floor = np.where(falls > 0, height / falls, np.inf)
    nearer = floor < exact.range
    return Returns(
        np.where(nearer, floor, exact.range),
        np.where(nearer, np.int32(-1), exact.wall),
        np.where(nearer, np.int32(FLOOR), exact.mover),
    )


def find_blind_scans(seconds: Float, options: LaserOptions, rng: np.random.Generator) -> Bool:
    """(T,) mask of the scans without any return.

    Args:
        seconds: (T,) times of the scans.
        options: number, place and duration of blind stretches; with a number, the recording is
            divided into as many equal parts, and one stretch begins at a random time of each.
        rng: not used without such a number.
    """
    length, count = float(seconds[-1] - seconds[0]), options.blind_stretches
    starts = [] if options.blind_at is None else [seconds[0] + options.blind_at * length]
    if count:
        room = max(0.0, length / count - options.blind_time)
        begins = np.arange(count) * (length / count)
        starts += (seconds[0] + begins + rng.uniform(0.0, room, count)).tolist()
    blind = np.zeros(len(seconds), bool)
    for start in starts:
        blind |= (seconds >= start) & (seconds < start + options.blind_time)
    return blind
