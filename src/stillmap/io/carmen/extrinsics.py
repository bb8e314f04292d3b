"""Finds the extrinsics, mounting and declared ranges of the lasers of a CARMEN log."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.io.carmen.log import LaserLog
from stillmap.io.carmen.scan_selection import laser_position, param_number
from stillmap.prepare.options import LaserOptions

# differences between laser and robot pose that agree: old logs round to cm. A corrected pose in
# the laser field differs by metres, and differently in each scan
_SAME_DISTANCE, _SAME_ANGLE = 0.02, 0.01  # m, rad
_MAX_OFFSET = 3.0  # m on a robot
_MIN_OFFSET = 0.002  # m or rad: less is rounding


class Extrinsics(NamedTuple):
    """Pose of a laser on the robot in metres and radians, and how it was found."""

    x: float
    y: float
    theta: float
    how: str

    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) T_base_sensor."""
        return se2.matrix(self.x, self.y, self.theta)


def find_extrinsics(
    laser: LaserLog, poses: NDArray[np.float64] | None, params: dict[str, str]
) -> tuple[Extrinsics, list[str]]:
    """Find the extrinsics of a laser; returns them and warnings.

    In this order: the median pose of the laser relative to the robot on the scan lines, if scans
    agree on it; PARAMs; facing backwards for RLASER; the robot's center.

    Args:
        laser: its scans.
        poses: (T, 6) laser and robot pose of each scan, None if lines have none.
        params: PARAMs of the log.
    """
    warnings: list[str] = []
    if poses is not None:
        offset, alike = _median_offset(poses)
        x, y, theta = (round(float(value), 6) for value in offset)
        if alike and is_stated_by_lines(x, y, theta):
            return Extrinsics(x, y, theta, "scan lines"), warnings
        if not alike:
            warnings.append(
                f"{laser.kind}: the laser poses on the scan lines do not keep to one place on the "
                "robot (a corrected log?): not used"
            )
    found = _extrinsics_from_params(laser.kind, params)
    if found is not None:
        return found, warnings
    if laser.kind == "RLASER":
        return Extrinsics(0.0, 0.0, math.pi, "a rear laser faces backwards"), warnings
    if laser.kind in ("RAWLASER2", "RAWLASER3", "RAWLASER4"):
        warnings.append(f"{laser.kind}: the log does not state its pose: robot center assumed")
    return Extrinsics(0.0, 0.0, 0.0, "robot center assumed"), warnings


def is_stated_by_lines(x: float, y: float, theta: float) -> bool:
    """True if a pose from scan lines is plausible: on the robot, and not at its center."""
    distance = math.hypot(x, y)
    return distance < _MAX_OFFSET and max(distance, abs(theta)) > _MIN_OFFSET


def override(found: Extrinsics, given: LaserOptions) -> Extrinsics:
    """`found` with the values that options give."""
    if given.pose == (None, None, None):
        return found
    x, y, theta = (f if w is None else w for f, w in zip(found[:3], given.pose, strict=True))
    return Extrinsics(x, y, theta, "given")


def find_upside_down(kind: str, params: dict[str, str], given: LaserOptions) -> tuple[bool, str]:
    """Find whether a laser is mounted upside down, its beams turning clockwise, and the source.

    CARMEN's own laser_..._flipped does not tell: its laser server reverses such readings before
    they are logged.
    """
    if given.upside_down is not None:
        return given.upside_down, "given"
    stated = param_number(params, f"robot_{laser_position(kind, params)}laser_flipped")
    return (False, "assumed") if stated is None else (stated != 0.0, "PARAM")


def find_field_of_view(kind: str, params: dict[str, str], given: LaserOptions) -> float | None:
    """Field of view in radians of a laser whose lines declare no angles; None: not stated."""
    if given.fov is not None:
        return given.fov
    degrees = param_number(params, f"laser_{laser_position(kind, params)}_laser_fov")
    return math.radians(degrees) if degrees is not None and 0.0 < degrees <= 360.0 else None


def find_max_range(laser: LaserLog, params: dict[str, str]) -> float | None:
    """The declared maximum range in metres, the smaller of PARAM and headers; None: not stated."""
    in_headers = [config.max_range for config in laser.configs if config.max_range is not None]
    in_params = param_number(params, f"robot_{laser_position(laser.kind, params)}_laser_max")
    # single headers may be damaged: the largest is the most cautious
    stated = [max(in_headers)] if in_headers else []
    if in_params is not None and in_params > 0.0:
        stated.append(in_params)
    return min(stated) if stated else None


def _median_offset(poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
    """Median (x, y, theta) of the laser in the robot's frame, and whether scans agree on it."""
    T_odom_sensor, T_odom_base = se2.matrix(*poses[:, :3].T), se2.matrix(*poses[:, 3:].T)
    offsets = se2.parameters(se2.inverse(T_odom_base) @ T_odom_sensor)
    # unwrap about the first: angles near pi lie on both sides of the cut
    offsets[:, 2] = offsets[0, 2] + se2.wrap(offsets[:, 2] - offsets[0, 2])
    middle = np.median(offsets, axis=0)
    off = np.abs(offsets - middle)
    alike = np.mean((off[:, :2].max(axis=1) < _SAME_DISTANCE) & (off[:, 2] < _SAME_ANGLE)) > 0.9
    return middle, bool(alike) and bool(np.hypot(*middle[:2]) < _MAX_OFFSET)


def _extrinsics_from_params(kind: str, params: dict[str, str]) -> Extrinsics | None:
    place = laser_position(kind, params)
    names = [f"robot_{place}laser_{what}" for what in ("offset", "side_offset", "angular_offset")]
    x, y, theta = (param_number(params, name) for name in names)
    if x is None and y is None and theta is None:
        return None
    if theta is None:
        theta = math.pi if place == "rear" else 0.0
    elif abs(theta) > 2.0 * math.pi:  # some logs write degrees
        theta = math.radians(theta)
    return Extrinsics(x or 0.0, y or 0.0, theta, "PARAM")
