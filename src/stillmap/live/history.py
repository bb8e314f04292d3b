"""The drive so far: its recording, written while it lasts, and what was answered to its scans."""

import json
import logging
import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core.array_folder import FORMAT_VERSION
from stillmap.core.arrays import GrowingArray
from stillmap.core.errors import InputError, cannot_write
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.core.source import LaserPose, SensorNotes, Source
from stillmap.io.stillmap_folder import FORMAT, HEADER
from stillmap.live.scan import ScanBeams

Float = NDArray[np.float64]

FOLDER = "recording"  # of a drive, in its result folder

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Answers(ShortRepr):
    """Poses and labels returned by `push` for T scans with M beams.

    Attributes:
        poses: (T, D+1, D+1) T_map_base as it was given.
        local: (T, D+1, D+1) in the frame of the odometry by scans, which never jumps.
        anchor: (T,) the last spaced scan at the time; -1: none yet.
        p_static: (M,) float32.
    """

    poses: Float
    local: Float
    anchor: NDArray[np.int64]
    p_static: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Placement(ShortRepr):
    """Poses of T scans, each in the map or in a submap.

    Attributes:
        poses: (T, D+1, D+1) T_map_base, in the frame of the submap.
        submap: (T,) 0: the map. From 1 on: a submap that nothing ties to it, one for each time that
            the robot was lost and not found. -1: the pose is not known.
    """

    poses: Float
    submap: NDArray[np.int64]

    def known_poses(self) -> Float:
        """(T, D+1, D+1) T_map_base; NaN where the place in the map is not known."""
        return np.where((self.submap == 0)[:, None, None], self.poses, np.nan)


class History:
    """Scans and answers, appended. Where the disk is full, or the bound is reached, it ends there.

    Args:
        dimension: 2 or 3.
        folder: a new one, for the recording of the drive; None: it has no name, and goes with this
            object.
        scratch: folder of temporary files; None: the system's.
        max_bytes: about, of the beams, 17 bytes each, in 3D 21; None: unbounded.

    Raises:
        InputError: the folder cannot be made.
    """

    def __init__(
        self,
        dimension: int,
        folder: Path | None = None,
        scratch: Path | None = None,
        max_bytes: int | None = None,
    ) -> None:
        self._dimension, self.folder, self._scratch = dimension, folder, scratch
        self._max_bytes = np.inf if max_bytes is None else max_bytes
        self._count, self._beam_count, self._is_full = 0, 0, False
        self._mounts: dict[str | int, Float] = {}
        self._has_odometry, self._has_times = True, False
        self._noted: tuple[int, bool, bool] | None = None  # in the header
        try:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir(parents=True)
            self._make_arrays()
        except OSError as error:
            raise cannot_write(error, folder or scratch or "") from error

    def _make_arrays(self) -> None:
        D, pose = self._dimension, (self._dimension + 1,) * 2
        rows: dict[str, tuple[DTypeLike, tuple[int, ...]]] = {
            "points": (np.float32, (D,)),
            "hit": (np.bool_, ()),
            "beam_time": (np.float32, ()),
            "T_base_sensor": (np.float64, pose),
            "T_odom_base": (np.float64, pose),
            "sensor": (np.int32, ()),
            "stamp_ns": (np.int64, ()),
            "offset": (np.int64, ()),  # the last: a scan is whole where its end is there
        }
        folder, scratch = self.folder, self._scratch
        self._recorded = {
            name: GrowingArray(*of, None if folder is None else folder / f"{name}.npy", scratch)
            for name, of in rows.items()
        }
        self._recorded["offset"].append(np.zeros(1, np.int64))
        poses = [("pose", np.float64, pose), ("local", np.float64, pose), ("anchor", np.int64)]
        answer = np.dtype([*poses, ("twist", np.float64, 3 * (D - 1))], align=True)
        self._answers = GrowingArray(answer, (), None, scratch)
        self._p_static = GrowingArray(np.float32, (), None, scratch)

    def __len__(self) -> int:
        return self._count

    @property
    def kept(self) -> int:
        """Number of the first scans that are kept: all, unless the disk was full."""
        return len(self._recorded["offset"]) - 1

    def append(
        self,
        beams: ScanBeams,
        p_static: NDArray[np.float32],
        T_odom_base: Float | None,
        **answer: Float | int,
    ) -> None:
        """Append a scan and the answer to it.

        Args:
            beams: of the scan.
            p_static: (N,).
            T_odom_base: (D+1, D+1); None: without odometry.
            answer: `pose`, `local` and `anchor`, see `Answers`; `twist` (3,) or (6,) m/s and rad/s
                of the base during the scan, in its own frame.
        """
        self._count += 1
        if self._is_full:
            return
        row = np.zeros(1, self._answers.dtype)
        for name, value in answer.items():
            row[name] = value
        try:
            self._p_static.append(p_static)
            self._answers.append(row)
            self._append_scan(beams, T_odom_base)
        except OSError as error:
            self._end(error.strerror or str(error))
            return
        row_bytes = 9 + 4 * self._dimension
        if self._beam_count * row_bytes > self._max_bytes:
            self._end(f"{self._max_bytes / 1e9:g} GB of beams are kept")

    def _append_scan(self, beams: ScanBeams, T_odom_base: Float | None) -> None:
        times, end = beams.beam_time, self._beam_count + len(beams.points)
        if beams.sensor not in self._mounts:
            self._recorded["T_base_sensor"].append(beams.T_base_sensor)
            self._mounts[beams.sensor] = beams.T_base_sensor
        self._has_odometry &= T_odom_base is not None
        self._has_times |= times is not None
        known = len(self._mounts), self._has_odometry, self._has_times
        if known != self._noted:
            self._write_header(is_open=True)
            self._noted = known
        unknown = np.full(beams.T_base_sensor.shape, np.nan)
        rows: dict[str, Any] = {
            "points": beams.points,
            "hit": beams.hit,
            "beam_time": np.zeros(len(beams.points)) if times is None else times,
            "T_odom_base": unknown if T_odom_base is None else T_odom_base,
            "sensor": list(self._mounts).index(beams.sensor),
            "stamp_ns": beams.stamp_ns,
            "offset": end,
        }
        for name, values in rows.items():
            self._recorded[name].append(values)
        self._beam_count = end

    def _end(self, why: str) -> None:
        """Keep no more scans: what was begun of the last one goes."""
        self._is_full = True
        for name, array in (*self._recorded.items(), ("p_static", self._p_static)):
            if name in ("points", "hit", "beam_time", "p_static"):
                array.truncate(self._beam_count)
            elif name in ("T_odom_base", "sensor", "stamp_ns"):
                array.truncate(self.kept)
        self._answers.truncate(self.kept)
        where = self.folder or self._scratch or "temporary files"
        _log.error("%s: %s: poses go on, but from here on no scan is kept", where, why)

    def _write_header(self, *, is_open: bool) -> None:
        """Write `recording.json`; it always is whole.

        Raises:
            OSError: the disk is full.
        """
        if self.folder is None:
            return
        header = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "dimension": self._dimension,
            "scans": self.kept,
            "beams": self._beam_count,
            "sensors": len(self._mounts),
            "odometry": self._has_odometry,
            "beam_times": self._has_times,
            "open": is_open,
            "source": self._source().to_dict(),
        }
        work = self.folder / f".{HEADER}"
        work.write_text(json.dumps(header, indent=1) + "\n", encoding="utf-8")
        os.replace(work, self.folder / HEADER)

    def _source(self) -> Source:
        given = LaserPose(how="given")
        sensors = [SensorNotes(str(name), extrinsics=given) for name in self._mounts]
        missing = f"the disk was full: of {self._count} scans {self.kept} were kept"
        warnings = [missing] if self.kept < self._count else []
        path = None if self.folder is None else os.path.abspath(self.folder)
        return Source(path, format="live", sensors=sensors, warnings=warnings)

    def move(self, folder: Path) -> None:
        """Move the recording folder.

        Raises:
            OSError: it cannot be moved.
        """
        assert self.folder is not None
        shutil.rmtree(folder, ignore_errors=True)
        folder.parent.mkdir(parents=True, exist_ok=True)
        os.replace(self.folder, folder)
        self.folder = folder

    def close(self) -> None:
        """Close the files; the recording folder says how long they are."""
        with suppress(OSError):  # the disk is full: the folder stays open
            if self.folder is not None:
                for array in self._recorded.values():
                    array.write_length()
                self._write_header(is_open=False)
        for array in (*self._recorded.values(), self._p_static, self._answers):
            array.close()

    def answer(self, number: int) -> Any:
        """The answer to a scan that is kept, see `append`."""
        if number >= self.kept:
            raise InputError(f"scan {number}: is not kept, for the disk was full")
        return self._answers.row(number)

    def answers(self) -> Answers:
        """The answers to the scans that are kept."""
        rows, p_static = self._answers.view(), self._p_static.view()
        poses, local, anchor = (rows[name].copy() for name in ("pose", "local", "anchor"))
        return Answers(poses, local, anchor, p_static)

    def recording(self) -> Recording:
        """The scans that are kept, while more are appended; odometry only if all have it."""
        arrays = {name: array.view() for name, array in self._recorded.items()}
        return Recording(
            stamp_ns=np.array(arrays["stamp_ns"]),
            offset=np.array(arrays["offset"]),
            points=arrays["points"],
            hit=arrays["hit"],
            T_base_sensor=np.array(list(self._mounts.values())),
            sensor=np.array(arrays["sensor"]),
            T_odom_base=np.array(arrays["T_odom_base"]) if self._has_odometry else None,
            source=self._source(),
            beam_time=arrays["beam_time"] if self._has_times else None,
            scratch=self._scratch,
        )
