"""Recordings in the plane as CARMEN logs."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.errors import InputError
from stillmap.output.atomic import new_file
from stillmap.recording import planar
from stillmap.recording.carmen_messages import flaser_angles
from stillmap.recording.extrinsics import is_told_by_lines
from stillmap.recording.lines import is_gzip_name, opened_to_write
from stillmap.recording.model import Recording
from stillmap.recording.ranges import FREQUENT_ZEROS
from stillmap.recording.stamps import seconds_text

NO_RETURN = 81.83  # m, what a SICK LMS reports when nothing comes back
# line of the first and the second laser: over half a circle; with angles; with angles, no poses
_HALF_CIRCLE = ("FLASER", "RLASER")
_WITH_ANGLES = ("ROBOTLASER1", "ROBOTLASER2")
_WITHOUT_POSES = ("RAWLASER1", "RAWLASER2")
_PLACES = ("front", "rear")

_DIGITS = 4  # of ranges in metres
_READS_AS_CODE = 81.82  # m: from here on a FLASER reading means that nothing came back
_SAME_ANGLE = 1e-5  # rad
_UNKNOWN_LASER = 99  # CARMEN's laser_type
_ANOTHER = "write a bag or a recording folder instead"

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Laser:
    """How the scans of one laser are written.

    Attributes:
        kind: of its lines.
        no_return: metres, the reading that means that nothing came back; lines that state their
            angles declare it as the largest range.
        unusable: the reading of an unusable beam.
    """

    kind: str
    no_return: float = NO_RETURN
    unusable: float = 0.0


@dataclass(frozen=True, eq=False)
class Form:
    """How a recording is written.

    Attributes:
        lasers: its one or two lasers.
        fans: (T, 2) first angle and step of each scan, as lines state them; None where none does.
        params: names and values of the PARAM lines.
        comment: the first line.
        host: the recording computer on each line.
        digits: of ranges in metres.
    """

    lasers: tuple[Laser, ...]
    fans: Float | None
    params: dict[str, str]
    comment: str
    host: str
    digits: int = _DIGITS


def write(recording: Recording, path: Path) -> list[str]:
    """Write a CARMEN log, gzip where the name ends so; it appears whole or not at all.

    With odometry FLASER and RLASER lines where lasers look at half a circle and no farther than
    these can say, else ROBOTLASER lines; without odometry RAWLASER lines.

    Returns:
        What could not be said, a sentence each.

    Raises:
        InputError: such a log cannot hold the recording, or cannot be written.
    """
    form = _form(recording)
    with new_file(path) as work, opened_to_write(work, packed=is_gzip_name(path)) as file:
        for line in lines(recording, form):
            file.write(line.encode("ascii"))
    if recording.beam_time is None:
        return []
    return ["when each beam was taken is left out: CARMEN logs cannot say it"]


def lines(recording: Recording, form: Form) -> Iterator[str]:
    """The lines of a log, each with its end: of every scan the odometry, then the scan."""
    yield f"# {form.comment}\n"
    if not recording.n_scans:
        return
    first = int(recording.stamp_ns[0])
    for name, value in form.params.items():
        yield f"PARAM {name} {value} {seconds_text(first)} {form.host} {seconds_text(0)}\n"
    base, laser = _poses(recording)
    for t in recording.in_turn(range(recording.n_scans)):
        stamp = int(recording.stamp_ns[t])
        times = f"{seconds_text(stamp)} {form.host} {seconds_text(stamp - first)}\n"
        if base is not None:
            yield f"ODOM {_pose(base[t])} 0 0 0 {times}"
        its = form.lasers[recording.sensor[t]]
        readings = _readings(planar.ranges(recording, t, its.no_return), its, form.digits)
        if its.kind in _HALF_CIRCLE:
            assert base is not None
            yield f"{its.kind} {readings} {_pose(laser[t])} {_pose(base[t])} {times}"
            continue
        assert form.fans is not None
        header = _header(form.fans[t], int(np.diff(recording.offset[t : t + 2])[0]), its)
        poses = f" {_pose(laser[t])} {_pose(base[t])} 0 0 0 0 0" if base is not None else ""
        yield f"{its.kind} {header} {readings} 0{poses} {times}"


def _poses(recording: Recording) -> tuple[Float | None, Float]:
    """(T, 3) poses of robot and laser in the odometry's frame; None, (0, 3) without odometry."""
    if recording.T_odom_base is None:
        return None, np.empty((0, 3))
    T_odom_sensor = recording.T_map_sensor(recording.T_odom_base)
    return se2.parameters(recording.T_odom_base), se2.parameters(T_odom_sensor)


def _readings(ranges: Float, laser: Laser, digits: int) -> str:
    ranges = np.where(np.isnan(ranges), laser.unusable, ranges)
    form = " ".join([f"%.{digits}f"] * len(ranges))
    return f"{len(ranges)} {form % tuple(ranges.tolist())}"


def _header(fan: Float, n: int, laser: Laser) -> str:
    start, step = fan.tolist()
    return f"{_UNKNOWN_LASER} {start!r} {step * (n - 1)!r} {step!r} {laser.no_return!r} 0 0"


def _pose(pose: Float) -> str:
    return " ".join(f"{value:.6f}" for value in pose.tolist())


def _form(recording: Recording) -> Form:
    lasers = len(recording.T_base_sensor)
    if lasers > 2:
        raise InputError(f"CARMEN logs hold two lasers, here are {lasers}", hint=_ANOTHER)
    counts = np.diff(recording.offset)
    for number in range(lasers):
        _require_one_count(counts[recording.sensor == number])
    fans = planar.fans(recording)
    params = {}
    for number, place in enumerate(_PLACES[:lasers]):
        its = recording.sensor == number
        if _is_upside_down(fans[its]):
            fans[its] *= -1.0
            params[f"robot_{place}laser_flipped"] = "1"
    reaches = planar.reaches(recording)
    kinds = _WITHOUT_POSES
    if recording.T_odom_base is not None:
        near = all(round(reach.hit, _DIGITS) < _READS_AS_CODE for reach in reaches)
        kinds = _HALF_CIRCLE if near and _are_half_circles(fans, counts) else _WITH_ANGLES
    written = []
    for number, reach in enumerate(reaches):
        no_return = NO_RETURN if kinds is _HALF_CIRCLE else _declared(reach)
        written.append(Laser(kinds[number], no_return, _unusable(recording, number)))
        x, y, theta = se2.parameters(recording.T_base_sensor[number]).tolist()
        params |= _place(kinds[number], _PLACES[number], x, y, theta)
    return Form(tuple(written), fans, params, "stillmap convert", "stillmap")


def _require_one_count(counts: NDArray[np.int64]) -> None:
    found = np.unique(counts)
    if len(found) > 1 or np.any(found == 0):
        raise InputError(
            f"scans of {found.min()} to {found.max()} beams: in a CARMEN log all scans of a laser "
            "have as many",
            hint=_ANOTHER,
        )


def _is_upside_down(fans: Float) -> bool:
    """Whether angles fall from beam to beam.

    Raises:
        InputError: in some scans only.
    """
    falls = fans[:, 1] < 0.0
    if falls.any() and not falls.all():
        raise InputError("beams turn one way in some scans and the other in others", hint=_ANOTHER)
    return bool(falls.any())


def _are_half_circles(fans: Float, counts: NDArray[np.int64]) -> bool:
    """Whether first and last beams point where FLASER lines of as many readings have them."""
    of = {int(n): flaser_angles(int(n))[:2] for n in np.unique(counts)}
    off = fans - np.array([of[n] for n in counts.tolist()]).reshape(-1, 2)
    off[:, 1] = off[:, 0] + (counts - 1) * off[:, 1]
    return bool(np.all(np.abs(off) < _SAME_ANGLE))


def _declared(reach: planar.Reach) -> float:
    """A largest range that no reading of a hit reaches, with as many digits as readings have."""
    limit = round(reach.limit(), _DIGITS)
    return limit if round(reach.hit, _DIGITS) < limit else round(limit + 10**-_DIGITS, _DIGITS)


def _unusable(recording: Recording, number: int) -> float:
    """Zero, as lasers say it; not a number where frequent zeros would mean maximum range."""
    beams = unusable = 0
    for t in recording.in_turn(np.flatnonzero(recording.sensor == number).tolist()):
        points = recording.points[recording.beams_of(t)]
        beams += len(points)
        unusable += int(np.count_nonzero(np.isnan(points[:, 0])))
    return 0.0 if unusable <= FREQUENT_ZEROS * beams else math.nan


def _place(kind: str, place: str, x: float, y: float, theta: float) -> dict[str, str]:
    """PARAMs that say where a laser sits, where nothing else does."""
    assumed = (0.0, 0.0, math.pi if kind == "RLASER" else 0.0)
    told = kind not in _WITHOUT_POSES and is_told_by_lines(x, y, theta)
    if told or (x, y, theta) == assumed:
        return {}
    names = ("offset", "side_offset", "angular_offset")
    values = zip(names, (x, y, theta), strict=True)
    return {f"robot_{place}laser_{name}": f"{value:.6f}" for name, value in values}
