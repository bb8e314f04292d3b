"""Reads a recording of any format, and prepares it by what all of its scans show."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io.builder import ReadContext
from stillmap.io.registry import detect_format
from stillmap.io.rigid_transforms import MAX_MOUNT, are_rigid
from stillmap.io.text_lines import Progress
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.prepare import prepare as prepare_recording


def read(
    path: str | Path,
    options: ReadOptions | None = None,
    *,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> Recording:
    """Read a recording of any format.

    Args:
        path: a file or a folder, see `registry.FORMATS`.
        options: read options, None for the defaults. A recording folder, whose readings are already
            interpreted, is narrowed by them.
        progress: called with the share of the file that is read, 0 to 1.
        scratch: folder for memory-mapped buffers; None: the system's temporary folder.

    Raises:
        InputError: there is no readable recording.
    """
    path, options = Path(path), options or ReadOptions()
    with explain_failure(path):
        recording = detect_format(path).read(path, ReadContext(options, progress, scratch))
        return prepare(recording, options, scratch, str(path))


def prepare(
    recording: Recording, options: ReadOptions, scratch: Path | None, where: str
) -> Recording:
    """A recording as its reader made it, with what follows from all of its scans.

    Raises:
        InputError: options are for recordings of another dimension, or a sensor is far from the
            robot.
    """
    require_mounts(recording, where)
    if recording.dimension == 3:
        recording = replace(recording, scratch=scratch)
    try:
        recording = prepare_recording(recording, options)
    except InputError as error:
        raise InputError(error.what, where=where, hint=error.hint) from error
    if recording.dimension == 2:
        return recording
    from stillmap.io import cameras  # nothing that a 2D recording needs

    if options.cameras is not None:
        recording = cameras.apply_camera_file(recording, Path(options.cameras))
    return cameras.add_calibration_warnings(recording)


@contextmanager
def explain_failure(path: Path) -> Iterator[None]:
    """Within this context, files that vanish and full disks are errors of the input.

    Raises:
        InputError: it names the file.
    """
    try:
        # damaged numbers are handled by the readers: no warnings of NumPy
        with np.errstate(over="ignore", invalid="ignore"):
            yield
    except OSError as error:
        # files may vanish and disks fill up at any moment
        what = f"cannot be read: {error.strerror or error}"
        raise InputError(what, where=str(error.filename or path)) from error
    except MemoryError as error:
        raise InputError("does not fit into memory", where=str(path)) from error


def require_mounts(recording: Recording, where: str) -> None:
    """Refuse sensors that are far from the robot, or whose pose on it is none: a kernel could not.

    Raises:
        InputError: a sensor with scans is.
    """
    D = recording.dimension
    for sensor in np.unique(recording.sensor).tolist():
        mount = recording.T_base_sensor[sensor]
        distance = float(np.hypot.reduce(mount[:D, D]))
        if not np.isfinite(mount).all() or not are_rigid(mount[None]):
            raise InputError(f"the mount of sensor {sensor} is no rigid transform", where=where)
        if not distance <= MAX_MOUNT:
            what = f"sensor {sensor} is mounted {distance:.4g} m from the robot's base"
            hint = f"at most {MAX_MOUNT:.0f} m: poses in a map are no mounts"
            raise InputError(what, where=where, hint=hint)


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
