"""The result folder of a live run: that of `stillmap map`, and what was answered at the time."""

import logging
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.advice import advise
from stillmap.core.arrays import write_npy
from stillmap.core.files import nearest_folder_above
from stillmap.core.profiling import Progress, no_progress
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.io.trajectory import write_tum
from stillmap.live.history import Answers, KeptScans
from stillmap.live.map_extension import KeptMap, write_extended
from stillmap.live.placement import Placement, take_scans
from stillmap.pipeline.options import Options
from stillmap.pipeline.result import map_recording
from stillmap.results.result import BuiltResult
from stillmap.results.run_json import EXTENDS
from stillmap.results.save import save

FOLDER = "live"
SUBMAPS = "live/submaps"  # of where the robot was lost, each in a folder with its number

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Snapshot(ShortRepr):
    """All scans so far and what is known of them, which stays while more scans are pushed.

    Attributes:
        kept: the scans, and what was answered at the time.
        placement: where they were taken.
        options: see Options.
        scratch: folder of temporary files; None: the system's.
        kept_map: what is kept of the known map that is extended; None: there is none.
    """

    kept: KeptScans
    placement: Placement
    options: Options
    scratch: Path | None
    kept_map: KeptMap | None = None

    def build(self, progress: Progress = no_progress) -> BuiltResult:
        """Labels, map and objects of the scans that are in the map, at these poses."""
        scratch = self._usable_scratch(None)
        return self._build(*self.kept.load(scratch), self.placement.main, progress)[0]

    def refine(self, progress: Progress = no_progress) -> BuiltResult:
        """The result of `stillmap.build` on all scans: poses, too."""
        return self._map(self.kept.load(self._usable_scratch(None))[0], None, progress)

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        overwrite: bool = False,
        progress: Progress = no_progress,
    ) -> None:
        """Write the result folder, as `LiveMapper.save` does; may run in a thread of its own.
        If the disk of `scratch` was full, temporary files lie where the result goes.

        In it are `live/trajectory.tum` and `live/beams/p_static.npy` with the answers; with a known
        map that is extended, the map is that one with what was seen. Scans whose place in the map
        is not known are left out, which a warning says; where they make a submap of their own, its
        result is in `live/submaps/N`. If there are none but such, the result is the largest submap.

        Raises:
            InputError: the folder is taken or cannot be written to.
        """
        self.prepare(path, progress).write(path, overwrite)

    def prepare(
        self, path: str | os.PathLike[str], progress: Progress = no_progress
    ) -> "LiveResult":
        """Build the result that `save` writes. Temporary files lie where the result goes if the
        disk of `scratch` was full, or is now.

        Raises:
            OSError: no disk has room for them.
        """
        beside = nearest_folder_above(path)
        scratch = self._usable_scratch(beside)
        try:
            return self._prepare(scratch, progress)
        except OSError:
            if scratch == beside:
                raise
            return self._prepare(beside, progress)

    def _prepare(self, scratch: Path | None, progress: Progress) -> "LiveResult":
        recording, answers = self.kept.load(scratch)
        main, others = self.placement.main, self.placement.others()
        warnings = self._describe_lost(recording.stamp_ns, len(others))
        for text in warnings:
            _log.warning(text)
        kept_map = self.kept_map if main == 0 else None
        source = {**recording.source, "warnings": [*recording.source["warnings"], *warnings]}
        if warnings:
            source["lost_scans"] = int(np.count_nonzero(self.placement.submap))
        if kept_map is not None and kept_map.cloud is not None:
            source[EXTENDS] = True
        built = self._build(replace(recording, source=source), answers, main, progress)
        recording = replace(recording, source={**recording.source, "warnings": []})
        submaps = [self._build(recording, answers, one, no_progress) for one in others]
        return LiveResult(*built, submaps, kept_map)

    def _build(
        self, recording: Recording, answers: Answers, submap: int, progress: Progress
    ) -> tuple[BuiltResult, Answers]:
        """The result of the scans of a submap, and the answers to them."""
        scans = np.flatnonzero(self.placement.submap == submap)
        taken, given = take_scans(recording, answers, scans, recording.scratch)
        return self._map(taken, self.placement.poses[scans], progress), given

    def _map(
        self, recording: Recording, poses: NDArray[np.float64] | None, progress: Progress
    ) -> BuiltResult:
        found = map_recording(
            recording, self.options, poses=poses, progress=progress, scratch=recording.scratch
        )
        return BuiltResult(**vars(found))

    def _usable_scratch(self, other: Path | None) -> Path | None:
        """The folder of temporary files, or another one if its disk was full."""
        return other if self.kept.disk_was_full else self.scratch

    def _describe_lost(self, stamp_ns: NDArray[np.int64], submaps: int) -> list[str]:
        """Warnings about scans whose pose in the map is unknown."""
        lost = np.flatnonzero(self.placement.submap)
        if not len(lost):
            return []
        if self.placement.main:
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


@dataclass(frozen=True, eq=False)
class LiveResult(ShortRepr):
    """Result of a drive, ready to be written.

    Attributes:
        result: labels, map and objects.
        given: what was answered at the time.
        submaps: the same of where the robot was lost.
        kept_map: see `Snapshot`.
    """

    result: BuiltResult
    given: Answers
    submaps: list[tuple[BuiltResult, Answers]]
    kept_map: KeptMap | None

    def write(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write the result folder; see `Snapshot.save`."""
        save(self.result, Path(path), overwrite, write_more=self._write_more)

    def _write_more(self, folder: Path) -> None:
        _write_answers(self.given, self.result.recording.stamp_ns, folder)
        if self.kept_map is not None:
            mode = self.result.options.output.map_mode
            write_extended(folder, self.kept_map, self.result.map, mode)
        for number, (result, given) in enumerate(self.submaps, 1):
            inside = folder / SUBMAPS / str(number)
            inside.parent.mkdir(exist_ok=True)
            LiveResult(result, given, [], None).write(inside)


def _write_answers(answers: Answers, stamp_ns: NDArray[np.int64], folder: Path) -> None:
    inside = folder / FOLDER
    (inside / "beams").mkdir(parents=True)
    write_tum(inside / "trajectory.tum", stamp_ns, answers.poses)
    write_npy(inside / "beams/p_static.npy", answers.p_static)
