"""Read what `stillmap map` is given: recording, poses, and the recording of a tilting laser."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap import em
from stillmap.cli.console import show_share
from stillmap.core.errors import InputError
from stillmap.core.profiling import StageTimer
from stillmap.core.recording import Recording
from stillmap.io import read
from stillmap.io.registry import detect_format
from stillmap.io.text_lines import Progress
from stillmap.io.trajectory import poses_from_tum
from stillmap.pipeline.options import Options, resolve_options
from stillmap.preprocessing.options import ReadOptions
from stillmap.rig.build import check_rig


class Request(NamedTuple):
    """Parsed arguments, apart from options.

    Attributes:
        input: recording, as it was given.
        output: result folder.
        tilting: recording of a tilting laser, or None.
        poses: file of poses to keep, "recording" or None.
        odometry: use the recording's odometry.
        overwrite: replace what is in the result folder.
        resume: continue from a checkpoint.
        quiet: no progress, no summary.
    """

    input: str
    output: Path
    tilting: str | None
    poses: str | None
    odometry: bool
    overwrite: bool
    resume: bool
    quiet: bool


class Inputs(NamedTuple):
    """The recording, poses to keep, and the recording of a tilting laser."""

    recording: Recording
    poses: NDArray[np.float64] | None
    tilting: Recording | None


def read_inputs(
    request: Request, options: Options, scratch: Path, stages: StageTimer
) -> tuple[Inputs, Options]:
    """Read the inputs, and resolve the options for them."""
    with stages.measure("read"):
        with show_share(request.quiet, "reading") as progress:
            recording = read(Path(request.input), options.read, progress=progress, scratch=scratch)
        _require_mappable(recording, options, request.input)
        recording = _note_path(recording, request.input)
        if not request.odometry:
            recording = recording.without_odometry()
        poses = _read_poses(request, recording)
        with show_share(request.quiet, "reading") as progress:
            tilting = _read_tilting_laser(
                request.input, request.tilting, recording, options, progress, scratch
            )
        return Inputs(recording, poses, tilting), resolve_options(options, recording)


def _require_mappable(recording: Recording, options: Options, path: str) -> None:
    if recording.n_scans == 0:
        raise InputError("holds no scan that can be used", where=path)
    if recording.dimension == 3 and options.estimator not in em.ESTIMATORS_3D:
        raise InputError(
            f"is 3D: estimator '{options.estimator}' is for 2D recordings",
            where=path,
            hint=f"--estimator {' or '.join(em.ESTIMATORS_3D)}",
        )


def _note_path(recording: Recording, path: str) -> Recording:
    """Note where the recording lies, and what it was made from where that is noted."""
    original = recording.source.get("path", path)
    source = {**recording.source, "path": path}
    if original != path:
        source["made_from"] = original
    return dataclasses.replace(recording, source=source)


def _read_poses(request: Request, recording: Recording) -> NDArray[np.float64] | None:
    if not request.poses:
        return None
    if request.poses != "recording":
        return poses_from_tum(Path(request.poses), recording)
    if recording.T_recorded_base is None:
        raise InputError(
            "states no poses",
            where=request.input,
            hint="--poses FILE.tum gives them; a file of the name `recording` is ./recording",
        )
    return recording.T_recorded_base


def _read_tilting_laser(
    planar_path: str,
    tilting_path: str | None,
    planar: Recording,
    options: Options,
    progress: Progress | None,
    scratch: Path,
) -> Recording | None:
    """Read the tilting laser from its own recording, or from a topic of the planar one's bag.

    Returns:
        The recording, None where neither `tilting_path` nor `read.tilting_topic` is given.

    Raises:
        InputError: it cannot be read, or is not of the same robot and time as the planar one.
    """
    topic = options.read.tilting_topic
    if tilting_path and topic is not None:
        raise InputError("--tilting and --tilting-topic exclude each other")
    if not tilting_path and topic is None:
        return None
    if planar.dimension != 2:
        what = "the planar laser decides which objects move, but this recording is 3D"
        raise InputError(what, where=planar_path)
    if topic is not None:
        base_frame = planar.source.get("base_frame") or None
        read_as = dataclasses.replace(
            options.read, topic=topic, tilting_topic=None, base_frame=base_frame
        )
        tilting = _read_topic(Path(planar_path), read_as, progress, scratch)
    else:
        # a topic chosen for INPUT is not in the other recording
        read_as = dataclasses.replace(options.read, topic=None)
        tilting = read(Path(str(tilting_path)), read_as, progress=progress, scratch=scratch)
    path = tilting_path or planar_path
    check_rig(planar, tilting, path)
    return dataclasses.replace(tilting, source={**tilting.source, "path": path})


def _read_topic(
    path: Path, options: ReadOptions, progress: Progress | None, scratch: Path
) -> Recording:
    from stillmap.io.ros.reader import read_tilting  # message types take long to load

    if detect_format(path).name != "ROS bag":
        raise InputError("--tilting-topic is for bags", where=str(path))
    with np.errstate(over="ignore", invalid="ignore"):
        return read_tilting(path, options, progress, scratch)
