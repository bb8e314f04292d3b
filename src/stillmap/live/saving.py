"""The result folder of a live run: that of `stillmap map`, and what was answered at the time."""

import logging
import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import empty, iter_blocks, release_pages, write_npy
from stillmap.core.errors import advise, cannot_write
from stillmap.core.files import require_new, resolve_output
from stillmap.core.profiling import Progress, no_progress
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.io.stillmap_folder import HEADER
from stillmap.io.trajectory import write_tum
from stillmap.live.history import FOLDER as RECORDING
from stillmap.live.history import Answers, Placement
from stillmap.live.known_map import KeptMap, write_extended
from stillmap.pipeline.options import Options
from stillmap.pipeline.result import MappingResult, map_recording
from stillmap.results.reader import EXTENDS, RECORD
from stillmap.results.result import Result
from stillmap.results.writer import save

FOLDER = "live"
SUBMAPS = "live/submaps"  # of where the robot was lost, each in a folder with its number

_MIN_SCANS = 20  # of a submap with a result of its own
_DRIVE = f"{RECORDING}/{HEADER}"  # of a folder with a drive, perhaps without a result

_log = logging.getLogger(__name__)


def require_place_for_drive(output: Path, overwrite: bool) -> None:
    """Reject an output folder that is taken, unless there is a result or a drive to overwrite.

    Raises:
        InputError: it is taken.
    """
    if not (overwrite and (output / _DRIVE).is_file()):
        require_new(output, RECORD, overwrite)


@dataclass(frozen=True, eq=False)
class Snapshot(ShortRepr):
    """All scans so far and what is known of them, which stays while more scans are pushed.

    Attributes:
        recording: the scans.
        answers: to them, at the time.
        placement: where they were taken.
        options: see Options.
        folder: of the recording, where it has one.
        kept_map: what is kept of the known map that is extended; None: there is none.
    """

    recording: Recording
    answers: Answers
    placement: Placement
    options: Options
    folder: Path | None = None
    kept_map: KeptMap | None = None

    def build(self, progress: Progress = no_progress) -> Result:
        """Labels, map and objects of the scans that are in the map, at these poses."""
        main, _ = _find_submaps(self.placement)
        return Result.of(self._build(self.recording, main, progress)[0])

    def refine(self, progress: Progress = no_progress) -> Result:
        """The result of `stillmap.build` on all scans: poses, too."""
        return Result.of(self._map(self.recording, None, progress))

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        overwrite: bool = False,
        progress: Progress = no_progress,
    ) -> None:
        """Write the result folder, as `LiveMapper.save` does; may run in a thread of its own.

        In it are `live/trajectory.tum` and `live/beams/p_static.npy` with the answers, and the
        recording where that lies in the folder; with a known map that is extended, the map is that
        one with what was seen. Scans whose place in the map is not known are left out, which a
        warning says; where they make a submap of their own, its result is in `live/submaps/N`. If
        there are none but such, the result is the largest submap.

        Raises:
            InputError: the folder is taken or cannot be written to.
        """
        try:
            self._save(Path(path), overwrite, progress)
        except BaseException as error:  # an interruption, too: nobody drives the same way again
            if self.folder is not None:
                _log.warning("the drive is kept: stillmap map %s makes a map of it", self.folder)
            if isinstance(error, OSError):
                raise cannot_write(error, path) from error
            raise

    def _save(self, path: Path, overwrite: bool, progress: Progress) -> None:
        main, others = _find_submaps(self.placement)
        warnings = self._describe_lost(len(others), main)
        for text in warnings:
            _log.warning(text)
        kept_map = self.kept_map if main == 0 else None
        noted, details = self.recording.source, dict(self.recording.source.details)
        plain = replace(self.recording, source=replace(noted, warnings=[]))
        if warnings:
            details["lost_scans"] = int(np.count_nonzero(self.placement.submap))
        if kept_map is not None and kept_map.cloud is not None:
            details[EXTENDS] = True
        source = replace(noted, warnings=[*noted.warnings, *warnings], details=details)
        result, answers = self._build(replace(self.recording, source=source), main, progress)
        submaps = [self._build(plain, number, no_progress) for number in others]
        path = resolve_output(path)
        is_inside = self.folder is not None and self.folder.resolve() == path / RECORDING

        def write_more(folder: Path) -> None:
            _write_answers(answers, result.recording.stamp_ns, folder)
            if kept_map is not None:
                write_extended(folder, kept_map, result.map, result.options.output.map_mode)
            for number, (submap, given) in enumerate(submaps, 1):
                inside = folder / SUBMAPS / str(number)
                inside.parent.mkdir(exist_ok=True)
                save(submap, inside)
                _write_answers(given, submap.recording.stamp_ns, inside)
            if is_inside:
                shutil.copytree(path / RECORDING, folder / RECORDING, copy_function=_link)

        if not is_inside:
            save(result, path, overwrite, write_more=write_more)
            return
        # the folder holds the drive already, and perhaps an earlier result of it
        save(result, path, True, marker=_DRIVE, write_more=write_more)

    def _build(
        self, recording: Recording, submap: int, progress: Progress
    ) -> tuple[MappingResult, Answers]:
        """The result of the scans of a submap, and the answers to them."""
        scans = np.flatnonzero(self.placement.submap == submap)
        taken, given = _take_scans(recording, self.answers, scans)
        return self._map(taken, self.placement.poses[scans], progress), given

    def _map(
        self, recording: Recording, poses: NDArray[np.float64] | None, progress: Progress
    ) -> MappingResult:
        return map_recording(
            recording, self.options, poses=poses, progress=progress, scratch=recording.scratch
        )

    def _describe_lost(self, submaps: int, main: int) -> list[str]:
        """Warnings about scans whose pose in the map is unknown."""
        lost, stamp_ns = np.flatnonzero(self.placement.submap), self.recording.stamp_ns
        if not len(lost):
            return []
        if main:
            return [
                "the robot was never found in the map: poses and map are in a frame of their own"
            ]
        first = 1e-9 * float(stamp_ns[lost[0]] - stamp_ns[0])
        text = (
            f"{len(lost)} scan{'s' * (len(lost) > 1)}, first at {first:.1f} s, are left out: the "
            "robot was carried, and where they were taken in the map is not known"
        )
        if not submaps:
            return [text]
        return [advise(text, f"see their own map{'s' * (submaps > 1)} in {SUBMAPS}")]


def _find_submaps(placement: Placement) -> tuple[int, list[int]]:
    """Number of the map, or of the largest submap, if no scan is in the map; and of the others that
    are large enough for a map of their own."""
    counts = np.bincount(placement.submap[placement.submap >= 0])
    main = 0 if not len(counts) or counts[0] else int(np.argmax(counts))
    large = np.flatnonzero(counts >= _MIN_SCANS).tolist()
    return main, [number for number in large if number != main]


def _take_scans(
    recording: Recording, answers: Answers, scans: NDArray[np.intp]
) -> tuple[Recording, Answers]:
    """A recording of some of the scans (n,), rising, and the answers to them."""
    if len(scans) == recording.n_scans:
        return recording, answers
    runs = np.split(scans, np.flatnonzero(np.diff(scans) > 1) + 1) if len(scans) else []
    spans = [slice(recording.offset[run[0]], recording.offset[run[-1] + 1]) for run in runs]
    counts = np.diff(recording.offset)[scans]
    offset = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts, dtype=np.int64)])

    def take(array: NDArray[Any]) -> NDArray[Any]:
        out = empty((int(offset[-1]), *array.shape[1:]), array.dtype, recording.scratch)
        first = 0
        for span in spans:
            part = array[span]
            for block in iter_blocks(part):
                out[first + block.start : first + block.stop] = part[block]
                release_pages(out)
            first += len(part)
        return out

    times, odometry = recording.beam_time, recording.T_odom_base
    taken = replace(
        recording,
        stamp_ns=recording.stamp_ns[scans],
        offset=offset,
        points=take(recording.points),
        hit=take(recording.hit),
        sensor=recording.sensor[scans],
        T_odom_base=None if odometry is None else odometry[scans],
        beam_time=None if times is None else take(times),
    )
    poses, local, anchor = answers.poses[scans], answers.local[scans], answers.anchor[scans]
    return taken, Answers(poses, local, anchor, take(answers.p_static))


def _write_answers(answers: Answers, stamp_ns: NDArray[np.int64], folder: Path) -> None:
    inside = folder / FOLDER
    (inside / "beams").mkdir(parents=True)
    write_tum(inside / "trajectory.tum", stamp_ns, answers.poses)
    write_npy(inside / "beams/p_static.npy", answers.p_static)


def _link(source: str, target: str) -> None:
    """A second name of a file, or a copy where there can be none."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
