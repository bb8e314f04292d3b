"""A mapped place of one session or several: what was just built, or a folder that was opened."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Float32, Int64
from stillmap.core.errors import InputError
from stillmap.core.grid_map import GridMap
from stillmap.core.recording import Recording
from stillmap.io.trajectory import read_tum
from stillmap.pipeline.options import Options
from stillmap.pipeline.quality import Quality
from stillmap.pipeline.result import MappingResult
from stillmap.prepare.beam_times import add_beam_times
from stillmap.results import reader, timeline
from stillmap.results.folder import ResultFolder, match_labels, open_result
from stillmap.results.run_json import run_record
from stillmap.slam import deskew_recording
from stillmap.tracking import MovingObject

PathLike: TypeAlias = str | os.PathLike[str]
Source: TypeAlias = Recording | PathLike | Sequence[PathLike]


@dataclass(eq=False, repr=False)
class MappedPlace:
    """The data of a mapped place; `stillmap.Result` says what each is."""

    map: GridMap
    poses: Float
    stamp_ns: Int64
    p_static: Float32
    hit: Bool
    objects: Sequence[MovingObject | reader.Track]
    sessions: list[timeline.PlaceSession]
    changes: list[timeline.SessionChange]
    mapping: MappingResult | None = None
    folder: ResultFolder | None = None
    source: Recording | str | Sequence[PathLike] | None = None

    @classmethod
    def of(cls, mapping: MappingResult) -> Self:
        """A recording that was just mapped."""
        recording = mapping.recording
        return cls(
            map=mapping.map,
            poses=mapping.poses,
            stamp_ns=recording.stamp_ns,
            p_static=mapping.p_static,
            hit=recording.hit,
            objects=mapping.objects,
            sessions=[_only_session(recording.source.path, recording.stamp_ns, mapping.poses)],
            changes=[],
            mapping=mapping,
        )

    if not TYPE_CHECKING:  # a misspelt attribute is an error

        def __getattr__(self, name: str) -> Any:
            mapping = None if name.startswith("__") else self.__dict__.get("mapping")
            if mapping is None:
                raise AttributeError(f"a {type(self).__name__} has no {name}")
            return getattr(mapping, name)

    @classmethod
    def open(cls, path: PathLike, recording: Source | None = None) -> Self:
        """See `stillmap.load`."""
        folder, has_several = Path(path), reader.is_place(Path(path))
        if has_several and recording is not None:
            hint = "load_session(NAME, recording=PATH) says where that of one session is"
            raise InputError("is a place of several recordings", where=str(path), hint=hint)
        record, labels = reader.read_run(folder), reader.read_labels(folder)
        opened = ResultFolder(folder, record, source_given=recording is not None)
        poses, changes = _read_poses(opened, labels), list[timeline.SessionChange]()
        sessions = [_only_session(record["input"].get("path"), labels.stamp_ns, poses)]
        if has_several:
            sessions = timeline.read_sessions(folder)
            changes = timeline.read_changes(folder, timeline.read_states(folder)[1])
        result = cls(
            map=reader.read_grid(folder),
            poses=poses,
            stamp_ns=labels.stamp_ns,
            p_static=labels.p_static,
            hit=labels.hit,
            objects=reader.read_tracks(folder / "objects" / "objects.json"),
            sessions=sessions,
            changes=changes,
            folder=opened,
            source=os.fspath(recording) if isinstance(recording, os.PathLike) else recording,
        )
        ends = [0, *(scans.stop for scans in result.stretches)]
        if [scans.start for scans in result.stretches] != ends[:-1] or ends[-1] != len(poses):
            what = "is damaged: its scans are not those of the place"
            raise InputError(what, where=str(folder / reader.SESSIONS))
        return result

    @property
    def path(self) -> Path | None:
        """The folder that it was loaded from; None: it was built."""
        return None if self.folder is None else self.folder.folder

    @property
    def run(self) -> dict[str, Any]:
        """The content of `run.json`."""
        return self.loaded.record if self.mapping is None else run_record(self.mapping)

    @property
    def quality(self) -> Quality:
        """Of labels and geometry, from 0 to 100; None where it cannot be determined."""
        if self.mapping is not None:
            return self.mapping.quality
        return Quality(**(self.run.get("quality") or {}))

    @property
    def warnings(self) -> list[str]:
        """One sentence each."""
        if self.mapping is not None:
            return self.mapping.warnings
        return list(self.run.get("warnings") or [])

    @property
    def options(self) -> Options:
        """Every option as resolved.

        Raises:
            InputError: this version does not know them.
        """
        return self.loaded.options if self.mapping is None else self.mapping.options

    @cached_property
    def recording(self) -> Recording:
        """The recording as it was mapped; of one that was loaded, read when it is first used.

        Raises:
            InputError: it is not there, is not the one that was mapped, or there are several.
        """
        if self.mapping is not None:
            return self.mapping.recording
        folder = self.loaded
        if len(self.stretches) > 1:
            hint = "load_session(NAME).recording is that of one session"
            raise InputError("is a place of several recordings", where=str(self.path), hint=hint)
        if isinstance(self.source, Recording):
            mapped = match_labels(self.source, reader.read_labels(folder.folder), "recording")
            # read from a file, it would have them already
            recording = add_beam_times(mapped, folder.read_options.spin)
        else:
            recording, _ = open_result(folder.folder, self.source).read()
        if recording.dimension != self.poses.shape[-1] - 1:
            what = f"is in {recording.dimension}D, another dimension than the result"
            raise InputError(what, where="recording")
        return folder.calibrate(recording)

    @property
    def deskewed(self) -> Recording:
        """The recording without the motion during its scans, computed at every call."""
        if self.mapping is not None:
            return self.mapping.deskewed
        return deskew_recording(self.recording, self.poses, self.loaded.slam_options)

    @cached_property
    def colors(self) -> NDArray[np.uint8] | None:
        """(M, 3) of the end points of one that was opened; None: without."""
        is_3d = self.poses.shape[-1] == 4
        return reader.read_colors(self.loaded.folder, len(self.hit)) if is_3d else None

    @property
    def loaded(self) -> ResultFolder:
        """The folder of one that was opened."""
        assert self.folder is not None
        return self.folder

    @property
    def stretches(self) -> list[slice]:
        """The scans of each session that is in the place, in their order."""
        placed = [one.scans for one in self.sessions if one.accepted]
        return sorted(placed, key=lambda scans: int(scans.start))


def _only_session(noted: Any, stamp_ns: Int64, poses: Float) -> timeline.PlaceSession:
    """The session of a result of one recording, whose frame is the map frame."""
    D, path = poses.shape[-1] - 1, noted if isinstance(noted, str) and noted else None
    times = (int(stamp_ns[0]), int(stamp_ns[-1])) if len(stamp_ns) else (0, 0)
    name, dof = input_stem(Path(path)) if path else "session", 3 * (D - 1)
    return timeline.PlaceSession(
        name,
        path,
        accepted=True,
        T_place_session=np.eye(D + 1),
        covariance=np.zeros((dof, dof)),
        scans=slice(0, len(stamp_ns)),
        first_ns=times[0],
        last_ns=times[1],
    )


def input_stem(path: Path) -> str:
    """The name of an input without endings."""
    name = Path(os.path.abspath(path)).name
    return name.split(".")[0] or name


def _read_poses(opened: ResultFolder, labels: reader.Labels) -> Float:
    """(T, D+1, D+1) T_map_base."""
    path = opened.folder / "trajectory.tum"
    stamp_ns, poses = read_tum(path)
    if not np.array_equal(stamp_ns, labels.stamp_ns):
        what = f"has {len(stamp_ns)} poses, not one for each of {len(labels.stamp_ns)} scans"
        raise InputError(what, where=str(path))
    # a rig with a tilting laser writes clouds, but its map is that of the planar one
    is_3d = opened.dimension == 3 and not (opened.folder / reader.TILTING).is_dir()
    return poses if is_3d else se2.project_to_plane(poses)
