"""`stillmap.build`: the main job, called from Python."""

# signatures name ArrayLike instead of spelling it out
from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from stillmap.core import config
from stillmap.core.profiling import Progress, StageTimer, no_progress, show_progress
from stillmap.core.recording import Recording
from stillmap.pipeline import inputs
from stillmap.pipeline.options import DEFAULTS, Options
from stillmap.pipeline.result import map_recording
from stillmap.results.result import BuiltResult


def build(
    recording: Recording | str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    options: Options | Mapping[str, Any] | None = None,
    *,
    resolution: float | None = None,
    odometry: bool = True,
    poses: ArrayLike | str | os.PathLike[str] | None = None,
    progress: bool | Progress = False,
    scratch: str | os.PathLike[str] | None = None,
) -> BuiltResult:
    """Map a recording: poses, P(static) of every beam, the map of what is static, what moved.

    Models of a 3D recording are made by `stillmap.build_models`.

    Args:
        recording: a `Recording`, or the path of one in any format that `stillmap.read` reads, or
            the paths of the parts of one run.
        options: `Options`, or the options to change, as in `{"em.prior": 0.8, "threads": 1}`;
            `stillmap config` prints all of them. None: the defaults.
        resolution: metres, edge of a map cell, in 3D of a voxel; None: as the options say.
        odometry: whether the recording's odometry is used.
        poses: poses to keep instead of estimating them: (T, D+1, D+1) T_map_base, in 2D also
            (T, 3) x, y (m), theta (rad); the path of a TUM trajectory; or "recording" for those
            that the recording states.
        progress: show a bar, in notebooks below the cell; or a function that is called with the
            stage, the iteration (0: outside the loop), the work done, and of how much.
        scratch: folder for arrays that are too large for memory; None: the system's temporary one.

    Raises:
        InputError: the recording or the trajectory cannot be read or mapped, or an option is
            unknown or out of range.
        ValueError: a recording without scans, poses of another shape.
        OSError: the disk of `scratch` is full.

    Examples:
        >>> result = stillmap.build("log.bag", resolution=0.1)
        >>> result.save("out")
    """
    if resolution is not None:
        options = _with_resolution(options, resolution)
    chosen = to_options(options)
    stages, folder = StageTimer(), None if scratch is None else Path(scratch)
    with report_to(progress, chosen.em.max_iterations) as tell:
        if not isinstance(recording, Recording):
            with stages.measure("read"):
                recording = inputs.read(
                    recording, chosen.read, progress=_percent(tell), scratch=folder
                )
        elif not recording.n_scans:
            raise ValueError("recording: expected at least one scan")
        if not odometry:
            recording = recording.without_odometry()
        kept = inputs.read_poses(poses, recording)
        inputs.require_mappable(recording, chosen, kept)
        result = map_recording(
            recording, chosen, poses=kept, progress=tell, stages=stages, scratch=folder
        )
    return BuiltResult(**vars(result))


def to_options(options: Options | Mapping[str, Any] | None) -> Options:
    """The options that a caller gave: all of them, those to change, or none.

    Raises:
        InputError: there is no such option, or a value is out of range.
    """
    if options is None:
        return DEFAULTS
    if isinstance(options, Options):
        return options
    if isinstance(options, Mapping):
        return config.override(DEFAULTS, config.nest(options))
    raise TypeError(f"options: expected Options or a mapping, got {type(options).__name__}")


def _with_resolution(options: Options | Mapping[str, Any] | None, resolution: float) -> Options:
    edge = float(resolution)
    changes = {"slam": {"resolution": edge, "voxel_size": edge}}
    return config.override(to_options(options), changes)


@contextmanager
def report_to(progress: bool | Progress, iterations: int) -> Iterator[Progress]:
    """The callback that was given as `progress`, a bar, or nothing."""
    if callable(progress):
        yield progress
    elif progress:
        with show_progress(iterations) as bar:
            yield bar
    else:
        yield no_progress


def _percent(tell: Progress) -> Any:
    """Progress of reading, as a share, told in percent."""
    return lambda share: tell("reading", 0, round(100.0 * share), 100)
