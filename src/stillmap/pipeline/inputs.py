"""The inputs of the main job: a recording to be mapped, and poses to keep."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

from numpy.typing import ArrayLike

from stillmap import em
from stillmap import io as formats
from stillmap.core.array_types import Float
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io.from_arrays import poses_to_matrices
from stillmap.io.reader import read_parts, require_plausible
from stillmap.io.text_lines import Progress
from stillmap.io.trajectory import poses_from_tum
from stillmap.pipeline.options import Options
from stillmap.prepare.options import ReadOptions

RECORDED = "recording"  # poses: those that the recording states


def read(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    options: ReadOptions | None = None,
    *,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> Recording:
    """Read a recording of any format, to be mapped.

    `stillmap.load` finds it again by the path, which `source.path` notes, or those of its parts.

    Args:
        path: a CARMEN log, a ROS bag, a folder of clouds, ...: see docs/input.md; or the parts of
            one run, in any order.
        options: what readings mean, topics of a bag, ...; None: the defaults.
        progress: called with the share that is read, 0 to 1.
        scratch: folder for memory-mapped buffers; None: the system's temporary folder.

    Raises:
        InputError: there is no readable recording, or several are not parts of one run.

    Examples:
        >>> recording = stillmap.read("log.bag", stillmap.ReadOptions(min_range=0.3))
        >>> recording = stillmap.read(["log_0.bag", "log_1.bag"])
    """
    if not isinstance(path, str | os.PathLike):
        if len(path) != 1:
            parts = [Path(part) for part in path]
            return read_parts(parts, options, progress=progress, scratch=scratch)
        path = path[0]
    recording = formats.read(Path(path), options, progress=progress, scratch=scratch)
    here = os.fspath(path)
    original = recording.source.path or here
    made_from = recording.source.made_from if original == here else original
    source = dataclasses.replace(recording.source, path=here, made_from=made_from)
    return dataclasses.replace(recording, source=source)


def read_poses(
    poses: ArrayLike | str | os.PathLike[str] | None, recording: Recording
) -> Float | None:
    """Poses to keep, (T, D+1, D+1) T_map_base; None: none.

    Args:
        poses: an array of them, in 2D also (T, 3) x, y (m), theta (rad); the path of a TUM
            trajectory; or "recording": those that the recording states.
        recording: T scans.

    Raises:
        InputError: the file is no trajectory, a scan has no pose, or the recording states none.
        ValueError: an array of another shape, or of no poses.
    """
    if poses is None:
        return None
    if isinstance(poses, str) and poses == RECORDED:
        if recording.T_recorded_base is None:
            hint = 'poses="FILE.tum" gives them; a file of the name `recording` is ./recording'
            where = recording.source.path or "the recording"
            raise InputError("states no poses", where=where, hint=hint)
        return recording.T_recorded_base
    if isinstance(poses, str | os.PathLike):
        return poses_from_tum(Path(poses), recording)
    return poses_to_matrices("poses", poses, recording.n_scans, recording.dimension, "recording")


def require_mappable(recording: Recording, options: Options, poses: Float | None) -> None:
    """Refuse what cannot be mapped.

    Raises:
        InputError: a recording without scans, mounts or odometry that no robot has, an estimator
            that is for 2D alone, or depth images without poses: their narrow view is not
            registered.
    """
    where = recording.source.path or "the recording"
    if recording.n_scans == 0:
        raise InputError("holds no scan that can be used", where=where)
    require_plausible(recording, where)
    if recording.dimension == 3 and options.estimator not in em.ESTIMATORS_3D:
        what = f"is 3D: estimator '{options.estimator}' is for 2D recordings"
        raise InputError(what, where=where, hint=f"estimator={' or '.join(em.ESTIMATORS_3D)}")
    if recording.dimension == 2 or poses is not None or recording.T_odom_base is not None:
        return
    if recording.source.has_depth_camera:
        stated = recording.T_recorded_base is not None
        hint = 'poses="recording"' if stated else 'poses="FILE.tum"'
        what = "holds depth images, whose poses have to be given"
        raise InputError(what, where=where, hint=hint)
