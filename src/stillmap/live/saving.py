"""The result folder of a live run: that of `stillmap map`, and what was answered at the time."""

import logging
import os
import shutil
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Float, Float32, Int64
from stillmap.core.arrays import write_npy
from stillmap.core.errors import advise, explaining_refusal
from stillmap.core.files import require_new, resolve_output
from stillmap.core.local_frame import FAR, find_origin
from stillmap.core.profiling import Progress, no_progress
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.core.source import Source
from stillmap.io.builder import reorder_scans
from stillmap.io.stillmap_folder import HEADER
from stillmap.io.trajectory import write_tum
from stillmap.live.history import FOLDER as RECORDING
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
    """All T scans so far and what is known of them, which stays while more scans are pushed.

    Attributes:
        recording: the scans.
        given: (T, D+1, D+1) T_map_base as it was answered at the time.
        p_static: (M,) float32 of the beams, likewise.
        poses: (T, D+1, D+1) T_map_base as it is known now, in the frame of the submap.
        submap: (T,) 0: the map. From 1 on: a submap that nothing ties to it, one for each time that
            the robot was lost and not found. -1: the pose is not known.
        options: see Options.
        folder: of the recording, where it has one.
        kept_map: what is kept of the known map that is extended; None: there is none.
    """

    recording: Recording
    given: Float
    p_static: Float32
    poses: Float
    submap: Int64
    options: Options
    folder: Path | None = None
    kept_map: KeptMap | None = None

    def refine(self, progress: Progress = no_progress) -> Result:
        """The result of `stillmap.build` on all scans: poses, too."""
        return Result.of(self._map(progress, refine=True))

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
            with explaining_refusal(path):
                self._save(Path(path), overwrite, progress)
        except BaseException:  # an interruption, too: nobody drives the same way again
            if self.folder is not None:
                _log.warning("the drive is kept: stillmap map %s makes a map of it", self.folder)
            raise

    def _save(self, path: Path, overwrite: bool, progress: Progress) -> None:
        main, others = self._find_submaps()
        warnings = self._describe_lost(len(others), main)
        for text in warnings:
            _log.warning(text)
        kept_map = self.kept_map if main == 0 else None
        noted, details = self.recording.source, dict(self.recording.source.details)
        if warnings:
            details["lost_scans"] = int(np.count_nonzero(self.submap))
        if kept_map is not None and kept_map.stands is not None:
            details[EXTENDS] = True
        source = replace(noted, warnings=[*noted.warnings, *warnings], details=details)
        taken = self._take(main, source)
        result = taken._map(progress)
        submaps = [self._take(number, replace(noted, warnings=[])) for number in others]
        maps = [submap._map() for submap in submaps]
        path = resolve_output(path)
        is_inside = self.folder is not None and self.folder.resolve() == path / RECORDING

        def write_more(folder: Path) -> None:
            taken._write_answers(folder)
            if kept_map is not None:
                write_extended(folder, kept_map, result.map, result.options.output.map_mode)
            for number, (submap, of_submap) in enumerate(zip(submaps, maps, strict=True), 1):
                inside = folder / SUBMAPS / str(number)
                inside.parent.mkdir(exist_ok=True)
                save(of_submap, inside)
                submap._write_answers(inside)
            if is_inside:
                shutil.copytree(path / RECORDING, folder / RECORDING, copy_function=_link)

        # the folder may hold the drive already, and perhaps an earlier result of it
        more = {"overwrite": True, "marker": _DRIVE} if is_inside else {"overwrite": overwrite}
        save(result, path, write_more=write_more, **more)

    def _find_submaps(self) -> tuple[int, list[int]]:
        """Number of the map, or of the largest submap, if no scan is in the map; and of the others
        that are large enough for a map of their own."""
        counts = np.bincount(self.submap[self.submap >= 0])
        main = 0 if not len(counts) or counts[0] else int(np.argmax(counts))
        large = np.flatnonzero(counts >= _MIN_SCANS).tolist()
        return main, [number for number in large if number != main]

    def _take(self, submap: int, source: Source) -> "Snapshot":
        """The scans of a submap; `source` instead of that of the recording."""
        scans = np.flatnonzero(self.submap == submap)
        recording = replace(self.recording, source=source)
        if len(scans) == recording.n_scans:
            return replace(self, recording=recording)
        counts = np.diff(recording.offset)

        def take(array: NDArray[Any]) -> NDArray[Any]:
            return reorder_scans(array, counts, scans, recording.scratch)

        times, odometry = recording.beam_time, recording.T_odom_base
        taken = replace(
            recording,
            stamp_ns=recording.stamp_ns[scans],
            offset=np.concatenate([[0], np.cumsum(counts[scans])]).astype(np.int64),
            points=take(recording.points),
            hit=take(recording.hit),
            sensor=recording.sensor[scans],
            T_odom_base=None if odometry is None else odometry[scans],
            beam_time=None if times is None else take(times),
        )
        given, poses, p_static = self.given[scans], self.poses[scans], take(self.p_static)
        kept = replace(self, given=given, p_static=p_static, poses=poses)
        return replace(kept, recording=taken, submap=self.submap[scans])

    def _map(self, progress: Progress = no_progress, *, refine: bool = False) -> MappingResult:
        run = partial(map_recording, progress=progress, scratch=self.recording.scratch)
        if refine:
            return run(self.recording, self.options)
        # cells are those of a known map near its origin, which this one may extend
        origin = find_origin(self.poses, FAR)
        return run(self.recording, self.options, poses=self.poses, origin=origin)

    def _describe_lost(self, submaps: int, main: int) -> list[str]:
        """Warnings about scans whose pose in the map is unknown."""
        lost, stamp_ns = np.flatnonzero(self.submap), self.recording.stamp_ns
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

    def _write_answers(self, folder: Path) -> None:
        inside = folder / FOLDER
        (inside / "beams").mkdir(parents=True)
        write_tum(inside / "trajectory.tum", self.recording.stamp_ns, self.given)
        write_npy(inside / "beams/p_static.npy", self.p_static)


def _link(source: str, target: str) -> None:
    """A second name of a file, or a copy where there can be none."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
