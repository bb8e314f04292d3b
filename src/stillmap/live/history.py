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
from numpy.typing import NDArray

from stillmap.core.arrays import GrowingArray
from stillmap.core.errors import InputError, cannot_write
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.io.stillmap_folder import FORMAT, FORMAT_VERSION, HEADER
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
        try:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir(parents=True)
            self._make_arrays(folder)
        except OSError as error:
            raise cannot_write(error, folder or scratch or "") from error

    def _make_arrays(self, folder: Path | None) -> None:
        D = self._dimension
        T = (D + 1, D + 1)

        def make(name: str, dtype: Any, row: tuple[int, ...] = ()) -> GrowingArray:
            path = None if folder is None else folder / f"{name}.npy"
            return GrowingArray(dtype, row, path, self._scratch)

        self._points = make("points", np.float32, (D,))
        self._hit = make("hit", np.bool_)
        self._times = make("beam_time", np.float32)
        self._sensors = make("T_base_sensor", np.float64, T)
        self._odometry = make("T_odom_base", np.float64, T)
        self._sensor = make("sensor", np.int32)
        self._stamps = make("stamp_ns", np.int64)
        self._offset = make("offset", np.int64)  # the last: a scan is whole where its end is there
        self._offset.append(np.zeros(1, np.int64))
        pose = (np.float64, T)
        fields = [("pose", *pose), ("local", *pose), ("anchor", np.int64)]
        answer = np.dtype([*fields, ("twist", np.float64, 3 if D == 2 else 6)], align=True)
        self._p_static = GrowingArray(np.float32, (), None, self._scratch)
        self._answers = GrowingArray(answer, (), None, self._scratch)

    def __len__(self) -> int:
        return self._count

    @property
    def kept(self) -> int:
        """Number of the first scans that are kept: all, unless the disk was full."""
        return len(self._offset) - 1

    def append(
        self,
        beams: ScanBeams,
        p_static: NDArray[np.float32],
        T_odom_base: Float | None,
        pose: Float,
        local: Float,
        anchor: int,
        twist: Float,
    ) -> None:
        """Append a scan and the answer to it; see `Answers`.

        Args:
            beams: of the scan.
            p_static: (N,).
            T_odom_base: (D+1, D+1); None: without odometry.
            pose: (D+1, D+1).
            local: (D+1, D+1).
            anchor: a spaced scan.
            twist: (3,) or (6,) m/s and rad/s of the base during the scan, in its own frame.
        """
        self._count += 1
        if self._is_full:
            return
        try:
            self._append_answer(p_static, pose, local, anchor, twist)
            self._append_scan(beams, T_odom_base)
        except OSError as error:
            self._end(error.strerror or str(error))
            return
        row_bytes = 9 + 4 * self._dimension
        if self._beam_count * row_bytes > self._max_bytes:
            self._end(f"{self._max_bytes / 1e9:g} GB of beams are kept")

    def _append_answer(
        self, p_static: NDArray[np.float32], pose: Float, local: Float, anchor: int, twist: Float
    ) -> None:
        answer = np.zeros(1, self._answers.dtype)
        answer["pose"], answer["local"] = pose, local
        answer["anchor"], answer["twist"] = anchor, twist
        self._p_static.append(p_static)
        self._answers.append(answer)

    def _append_scan(self, beams: ScanBeams, T_odom_base: Float | None) -> None:
        times = beams.beam_time
        self._points.append(beams.points)
        self._hit.append(beams.hit)
        self._times.append(np.zeros(len(beams.points), np.float32) if times is None else times)
        known = len(self._mounts), self._has_odometry, self._has_times
        if beams.sensor not in self._mounts:
            self._sensors.append(beams.T_base_sensor[None])
            self._mounts[beams.sensor] = beams.T_base_sensor
        self._has_odometry &= T_odom_base is not None
        self._has_times |= times is not None
        if known != (len(self._mounts), self._has_odometry, self._has_times):
            self._write_header(is_open=True)
        nowhere = np.full(beams.T_base_sensor.shape, np.nan)
        self._odometry.append((nowhere if T_odom_base is None else T_odom_base)[None])
        self._sensor.append(np.array([list(self._mounts).index(beams.sensor)]))
        self._stamps.append(np.array([beams.stamp_ns]))
        self._offset.append(np.array([self._beam_count + len(beams.points)]))
        self._beam_count += len(beams.points)

    def _end(self, why: str) -> None:
        """Keep no more scans: what was begun of the last one goes."""
        self._is_full = True
        for array in (self._points, self._hit, self._times, self._p_static):
            array.truncate(self._beam_count)
        for array in (self._odometry, self._sensor, self._stamps, self._answers):
            array.truncate(self.kept)
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
            "source": self._source(),
        }
        work = self.folder / f".{HEADER}"
        work.write_text(json.dumps(header, indent=1) + "\n", encoding="utf-8")
        os.replace(work, self.folder / HEADER)

    def _source(self) -> dict[str, Any]:
        sensors = [{"name": str(name), "extrinsics": {"how": "given"}} for name in self._mounts]
        missing = f"the disk was full: of {self._count} scans {self.kept} were kept"
        warnings = [missing] if self.kept < self._count else []
        path = {} if self.folder is None else {"path": os.path.abspath(self.folder)}
        return {**path, "format": "live", "sensors": sensors, "warnings": warnings}

    def finish(self) -> None:
        """Enter what is in the recording folder into its headers; appending may go on.

        Raises:
            OSError: the disk is full.
        """
        if self.folder is None:
            return
        for array in self._recorded:
            array.write_length()
        self._write_header(is_open=False)

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

    @property
    def _recorded(self) -> list[GrowingArray]:
        """The arrays of the recording."""
        of_beams = [self._points, self._hit, self._times]
        return [*of_beams, self._sensors, self._odometry, self._sensor, self._stamps, self._offset]

    def close(self) -> None:
        """Close the files; the recording folder says how long they are."""
        with suppress(OSError):
            self.finish()
        for array in (*self._recorded, self._p_static, self._answers):
            array.close()

    def at(self, number: int) -> tuple[int, Float]:
        """Anchor and local pose of a scan that is kept, see `Answers`."""
        answer = self._answer(number)
        return int(answer["anchor"]), np.array(answer["local"])

    def twist_at(self, number: int) -> Float:
        """(3,) or (6,) m/s and rad/s of the base during a scan that is kept."""
        return np.array(self._answer(number)["twist"])

    def _answer(self, number: int) -> Any:
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
        return Recording(
            stamp_ns=np.array(self._stamps.view()),
            offset=np.array(self._offset.view()),
            points=self._points.view(),
            hit=self._hit.view(),
            T_base_sensor=np.array(list(self._mounts.values())),
            sensor=np.array(self._sensor.view()),
            T_odom_base=np.array(self._odometry.view()) if self._has_odometry else None,
            source=self._source(),
            beam_time=self._times.view() if self._has_times else None,
            scratch=self._scratch,
        )
