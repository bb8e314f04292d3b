"""Numbers that no robot has: refused before they reach a kernel, which could only say so."""

import numpy as np

from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io.rigid_transforms import are_rigid

MAX_MOUNT = 1e5  # m from the robot's base to a sensor; the kernels' cells end at a few hundred km


def require_mounts(recording: Recording, where: str) -> None:
    """Refuse sensors that are far from the robot, or whose pose on it is none.

    Raises:
        InputError: a sensor with scans is.
    """
    D = recording.dimension
    for sensor in np.unique(recording.sensor).tolist():
        mount = recording.T_base_sensor[sensor]
        distance = float(np.hypot.reduce(mount[:D, D]))
        if not np.isfinite(mount).all():
            raise InputError(f"the mount of sensor {sensor} is not finite", where=where)
        if not distance <= MAX_MOUNT:
            what = f"sensor {sensor} is mounted {distance:.4g} m from the robot's base"
            hint = f"at most {MAX_MOUNT:.0f} m: poses in a map are no mounts"
            raise InputError(what, where=where, hint=hint)
        if not are_rigid(mount[None]):
            raise InputError(f"the mount of sensor {sensor} is no rigid transform", where=where)


def require_plausible(recording: Recording, where: str) -> None:
    """Refuse what no reader returns, but who makes a `Recording` himself may have put there.

    Raises:
        InputError: stamps fall, or a mount or an odometry pose is none.
    """
    require_mounts(recording, where)
    if np.any(recording.stamp_ns[1:] < recording.stamp_ns[:-1]):
        raise InputError("stamps must not fall", where=where, hint="sort the scans by time")
    if recording.T_odom_base is not None and not are_rigid(recording.T_odom_base):
        what = "odometry: expected finite rigid transforms within a million km"
        raise InputError(what, where=where, hint="odometry=False does without")
