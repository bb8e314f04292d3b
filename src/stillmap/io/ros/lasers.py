"""LaserScan and MultiEchoLaserScan messages: collected by topic and frame, as raw lasers.

The scans of a laser that tilts become a 3D recording, by the transforms at the times of its beams.
"""

import math
from array import array
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stillmap.core import arrays, se2
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.array_types import Bool, Float, Float32, Int64
from stillmap.core.errors import InputError, advise
from stillmap.core.source import LaserPose, SensorNotes, Source
from stillmap.io.builder import ReadContext, SkippedRecords
from stillmap.io.ros import tf
from stillmap.io.ros.messages import MULTI_ECHO, Message, SkippedByTopic, frame_name, stamp_ns
from stillmap.prepare.lasers import Beams, RawLaser, RawLasers, scan_order, unit_vectors
from stillmap.prepare.options import ReadOptions

REPEATED = "scan that was recorded twice"

_TURN = 2.0 * math.pi
_MAX_READINGS = 1 << 20
_MAX_SCAN_TIME = 1.0  # s
_STILL_DISTANCE, _STILL_ANGLE = 1e-3, 1e-3  # m, rad: a sensor that moves less is fixed
_MIN_TILT = 0.02  # rad: a laser that turns by less does not tilt
_MAX_PAUSE = 500_000_000  # ns between transforms over which the joint's angle is interpolated
_BLOCK = 1 << 14  # beams at a time


class ScanShape(NamedTuple):
    """Beam geometry that scans of one laser share, in radians, metres and seconds."""

    angle_min: float
    angle_increment: float
    n: int
    range_min: float
    range_max: float
    time_increment: float

    @classmethod
    def of(cls, message: Any, n: int) -> "ScanShape":
        """That of a message with n readings."""
        angles = message.angle_min, message.angle_increment
        return cls(*angles, n, message.range_min, message.range_max, message.time_increment)

    def find_fault(self) -> str | None:
        """Why such a scan cannot be used."""
        if self.n == 0 or self.n > _MAX_READINGS:
            return "scan without readings"
        known = abs(self.angle_min) < 1e3 and abs(self.angle_increment) < 1e3
        # a full turn may repeat its first beam at the end, or go a few steps further
        turns = (self.n - 4) * abs(self.angle_increment) > _TURN
        if not known or turns or (self.angle_increment == 0.0 and self.n > 1):
            return "scan with angles that are none"
        return None

    def angles(self) -> Float:
        """(n,) beam angles."""
        return self.angle_min + self.angle_increment * np.arange(self.n, dtype=np.float64)


class LaserScans:
    """The scans of one laser, by topic and frame.

    Attributes, once it is finished:
        raw: T scans with non-decreasing stamps.
        number: (T,) int64 number of the message on its topic, from 1.
        shape: that of most scans.
        warnings: sentences.
    """

    raw: RawLaser
    number: Int64
    shape: ScanShape

    def __init__(self, topic: str, frame: str, scratch: Path | None) -> None:
        self.topic, self.frame = topic, frame
        self.warnings: list[str] = []
        self._rows = array("q")  # stamp, log time, number and shape of each scan
        self._shapes: dict[ScanShape, int] = {}
        self._ranges = ArrayBuilder(np.float32, (), scratch)

    def add(self, message: Any, ranges: Float32, log_ns: int, number: int) -> str | None:
        """Add a scan; returns the reason if it cannot be used."""
        shape = ScanShape.of(message, len(ranges))
        if shape not in self._shapes and (fault := shape.find_fault()) is not None:
            return fault
        known = self._shapes.setdefault(shape, len(self._shapes))
        self._rows.extend((stamp_ns(message.header), log_ns, number, known))
        self._ranges.append(ranges)
        return None

    def finish(self, skipped: SkippedRecords) -> None:
        """Keep the scans in order of time, without repeated ones; others are counted."""
        ranges, shapes = self._ranges.finish(), list(self._shapes)
        stamps, log_ns, number, shape = np.asarray(self._rows, np.int64).reshape(-1, 4).T.copy()
        n = np.array([s.n for s in shapes], np.int64)[shape]
        start = np.cumsum(n) - n
        if np.mean(stamps == 0) > 0.5:
            stamps = log_ns
            what = f"{self.topic}: headers have no stamps: log times are used"
            todo = "let the driver stamp its scans: log times come later and jitter"
            self.warnings.append(advise(what, todo))
        keep = skipped.order_in_time(stamps, number)
        repeated = np.zeros(len(keep), np.bool_)
        for k in np.flatnonzero(np.diff(stamps[keep]) == 0) + 1:
            a, b = (ranges[start[t] : start[t] + n[t]] for t in keep[[k - 1, k]])
            repeated[k] = np.array_equal(a, b, equal_nan=True)
        skipped.add_all(REPEATED, number[keep[repeated]])
        keep = keep[~repeated]
        self.number, usual = number[keep], shapes[int(np.bincount(shape[keep]).argmax())]
        self.shape = usual
        self.raw = RawLaser(
            self.topic,
            stamps[keep],
            ranges,
            start[keep],
            shape[keep],
            [unit_vectors(s.angles()).astype(np.float32) for s in shapes],
            _beam_steps(stamps[keep], shapes),
            usual.range_min,
            usual.range_max,
        )

    @property
    def n_scans(self) -> int:
        return len(self.number)


def _beam_steps(stamps: Int64, shapes: list[ScanShape]) -> tuple[float, ...]:
    """Seconds from beam to beam of each shape; 0 where missing or implausible."""
    span = float(stamps[-1] - stamps[0]) / 1e9
    # 1 / rate, as it was always rounded
    period = 1.0 / ((len(stamps) - 1) / span) if span > 0.0 else _MAX_SCAN_TIME
    steps = np.array([s.time_increment for s in shapes])
    duration = np.abs(steps) * np.array([max(s.n - 1, 1) for s in shapes])
    # many drivers leave the field unset or wrong
    plausible = np.isfinite(steps) & (duration <= min(_MAX_SCAN_TIME, 1.5 * period))
    return tuple(np.where(plausible, steps, 0.0).tolist())


class LaserCollector:
    """Collects the scans of all lasers: one topic may carry several, by frame."""

    def __init__(self, scratch: Path | None, skipped: SkippedByTopic) -> None:
        self._scratch, self.skipped = scratch, skipped
        self._lasers: dict[tuple[str, str], LaserScans] = {}

    def add(self, message: Message, scan: Any, number: int) -> str | None:
        """Add a message, by its number on the topic; returns the reason if it cannot be used."""
        topic = message.channel.topic
        frame = frame_name(scan.header.frame_id)
        ranges = _first_echoes(scan) if message.channel.type == MULTI_ECHO else scan.ranges
        laser = self._lasers.get((topic, frame)) or LaserScans(topic, frame, self._scratch)
        fault = laser.add(scan, ranges, message.log_ns, number)
        if fault is None:
            self._lasers[topic, frame] = laser
        return fault

    def finish(self) -> list[LaserScans]:
        """The lasers: most scans first, then most beams.

        Raises:
            InputError: there is none with a usable scan.
        """
        if not self._lasers:
            total = SkippedRecords().merge(*self.skipped.values())
            raise InputError(f"holds no usable laser scan: {total.summary('message')}")
        for laser in self._lasers.values():
            laser.finish(self.skipped[laser.topic])
        beams = {s: len(s.raw.directions[s.raw.shape[0]]) for s in self._lasers.values()}
        return sorted(beams, key=lambda s: (-s.n_scans, -beams[s], s.topic))


def _first_echoes(scan: Any) -> Float32:
    """(n,) the first echo of each beam: glass and rain return further ones."""
    return np.array([e.echoes[0] if len(e.echoes) else np.nan for e in scan.ranges], np.float32)


def read_lasers(
    collector: LaserCollector,
    tree: tf.TransformTree,
    context: ReadContext,
    *,
    tilting: bool = False,
) -> RawLasers:
    """The 2D scans of all lasers, or those of a laser that tilts, to become a 3D recording.

    Raises:
        InputError: no scan can be used, or options do not fit the lasers.
    """
    scans, options = collector.finish(), context.options
    sensors = [tf.Sensor(s.topic, s.frame, s.raw.stamp_ns) for s in scans]
    poses = tf.place_sensors(tree, sensors, options)
    used = [scans[k] for k in poses.used]
    skipped = SkippedRecords().merge(*(collector.skipped[t] for t in {s.topic for s in used}))
    losses = skipped.loss_warnings(sum(s.n_scans for s in used), "message")
    warnings = [w for s in used for w in s.warnings]
    source = Source(
        base_frame=poses.base,
        base_frame_how=poses.how,
        skipped=skipped.by_reason(),
        warnings=warnings,
    )
    if tilting:
        warnings += losses
        return _read_tilting_laser(used, poses, tree, source, context.scratch)
    options.check_laser_count(len(used))
    warnings += poses.warnings
    raw, mounts = [], []
    for number, laser in enumerate(used):
        mount, notes = _find_mount(laser, poses, number, options, warnings)
        sign = -1.0 if notes.upside_down else 1.0
        mirrored = [d * np.array([1.0, sign], np.float32) for d in laser.raw.directions]
        raw.append(replace(laser.raw, directions=mirrored))
        mounts.append(mount)
        source.sensors.append(notes)
    at = scan_order(raw)
    stamps = np.concatenate([laser.stamp_ns for laser in raw])[at]
    odom, source.odometry = tf.find_odometry(tree, poses.base, stamps, options, warnings)
    warnings += losses
    source.duplicates = poses.omitted
    T_odom_base = None if odom is None else tf.project_to_plane(odom)[0]
    record = np.concatenate([s.number for s in used])[at]
    return RawLasers(raw, mounts, T_odom_base, source, record)


def _find_mount(
    scans: LaserScans, poses: tf.SensorPoses, number: int, options: ReadOptions, warnings: list[str]
) -> tuple[Float, SensorNotes]:
    """T_base_sensor (1, 3, 3) of a laser, or (T, 3, 3) where it moves, and notes on it."""
    flat, upside_down, tilts = tf.project_to_plane(poses.T_base_sensor[number])
    given, upside_down_how = options.laser(number), "TF"
    if tilts:
        warnings.append(f"{scans.topic}: the laser is tilted; its scans are treated as level")
    x, y, theta = se2.parameters(flat)[0].tolist()
    offset = np.abs(se2.parameters(se2.inverse(flat[:1]) @ flat))
    moves = offset[:, :2].max() > _STILL_DISTANCE or offset[:, 2].max() > _STILL_ANGLE
    pose = LaserPose(x, y, theta, "TF, it moves: at its first scan")
    if not moves or given.pose != (None, None, None):
        how = f"TF from {poses.base} to {scans.frame}"
        how = "the laser is the robot's frame" if scans.frame == poses.base else how
        pose = replace(pose, how=how).override(given.pose)
        flat = pose.matrix()[None]
    if given.upside_down is not None:
        upside_down, upside_down_how = given.upside_down, "given"
    sign = -1.0 if upside_down else 1.0
    return flat, SensorNotes(
        scans.topic,
        scans.frame,
        scans.n_scans,
        len(flat),
        scans.shape.n,
        sign * scans.shape.angle_min,
        sign * scans.shape.angle_increment,
        upside_down,
        upside_down_how,
        extrinsics=pose,
    )


def _read_tilting_laser(
    used: list[LaserScans],
    poses: tf.SensorPoses,
    tree: tf.TransformTree,
    source: Source,
    scratch: Path | None,
) -> RawLasers:
    """The scans of a laser that tilts or pans, to become a 3D recording.

    Every scan has a sensor of its own at the laser's pose at the scan's stamp; beams are placed by
    the laser's pose at their own times. Where transforms are missing, beams are unusable.

    Raises:
        InputError: there are several lasers, or this one does not move on the robot.
    """
    scans, T_base_sensor = used[0], poses.T_base_sensor[0]
    if len(used) > 1:
        raise InputError(f"{scans.topic}: scans of several lasers: only one can tilt")
    trace = np.einsum("ij,nij->n", T_base_sensor[0, :3, :3], T_base_sensor[:, :3, :3])
    if np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)).max() < _MIN_TILT:
        hint = "transforms must say how the joint moves, as robot_state_publisher does"
        what = f"{scans.topic}: {scans.frame!r} does not tilt in {poses.base!r}"
        raise InputError(what, hint=hint)
    n = scans.n_scans
    source.sensors.append(SensorNotes(scans.topic, scans.frame, n, places=n))
    to_3d = partial(_convert_to_3d, tree, poses.base, scans, T_base_sensor, scratch)
    return RawLasers([scans.raw], [T_base_sensor], None, source, to_3d=to_3d)


def _convert_to_3d(
    tree: tf.TransformTree,
    base: str,
    scans: LaserScans,
    T_base_sensor: Float,
    scratch: Path | None,
    beams: Beams,
) -> tuple[Float32, list[str]]:
    """Points (M, 3) in the laser's frame at its scan's stamp, and a warning about lost beams."""
    points = arrays.empty((len(beams.points), 3), np.float32, scratch)
    stamps, M, n_lost = np.sort(tree.stamps_between(base, scans.frame)), len(points), 0
    for first in range(0, M, _BLOCK):
        block = slice(first, min(first + _BLOCK, M))
        scan = np.searchsorted(beams.offset, np.arange(block.start, block.stop), side="right") - 1
        at_ns = scans.raw.stamp_ns[scan]
        if beams.beam_time is not None:
            after_ns = np.round(1e9 * beams.beam_time[block].astype(np.float64))
            at_ns = at_ns + after_ns.astype(np.int64)
        pose = tree.lookup(base, scans.frame, at_ns)
        assert pose is not None  # connected at the stamps, so connected
        T = se2.inverse(T_base_sensor[scan]) @ pose.T
        ends = np.einsum("nij,nj->ni", T[:, :3, :2], beams.points[block].astype(np.float64))
        is_lost = ~_is_covered(stamps, at_ns)
        n_lost += int(np.count_nonzero(is_lost & np.isfinite(ends[:, 0])))
        points[block] = np.where(is_lost[:, None], np.nan, ends + T[:, :3, 3])
        arrays.release_pages(points)
    text = f"{n_lost} beams where transforms do not say how the laser is tilted"
    return points, [text] * (n_lost > 0)


def _is_covered(stamps: Int64, at_ns: Int64) -> Bool:
    """(n,) whether times lie on, or between close, sorted stamps."""
    after = np.searchsorted(stamps, at_ns)
    inside = (after > 0) & (after < len(stamps))
    k = np.clip(after, 1, len(stamps) - 1)
    exact = stamps[np.minimum(after, len(stamps) - 1)] == at_ns
    return np.asarray(exact | (inside & (stamps[k] - stamps[k - 1] <= _MAX_PAUSE)))
