"""The drive so far: its recording, written while it lasts, and what was answered to its scans."""

import json
import logging
import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core.array_builder import GrowingArray
from stillmap.core.array_folder import FORMAT_VERSION
from stillmap.core.array_types import Float, Float32
from stillmap.core.errors import InputError, explaining_refusal
from stillmap.core.recording import Recording
from stillmap.core.source import LaserPose, SensorNotes, Source
from stillmap.io.stillmap_folder import FORMAT, HEADER
from stillmap.live.scan import ScanBeams

FOLDER = "recording"  # of a drive, in its result folder

_PER_BEAM = {"points", "hit", "beam_time", "label"}

_log = logging.getLogger(__name__)


class GrowingRecording:
    """Scans appended to files, with a label of each beam and notes of each scan.

    Args:
        dimension: 2 or 3.
        notes: dtype of the notes.
        folder: an empty one, which is a recording folder while it grows; None: files have no names,
            and go with this object.
        scratch: folder of files without a name; None: the system's.

    Attributes:
        dimension, folder, scratch: see above.
        kept: number of scans that are there as a whole.

    Raises:
        OSError: a file cannot be made.
    """

    def __init__(
        self,
        dimension: int,
        notes: np.dtype[Any],
        folder: Path | None = None,
        scratch: Path | None = None,
    ) -> None:
        D, pose = dimension, (dimension + 1,) * 2
        self.folder, self.dimension, self.scratch = folder, dimension, scratch
        self.kept, self._count, self._beam_count = 0, 0, 0
        self._mounts: dict[str | int, Float] = {}
        self._has_odometry, self._has_times = True, False
        self._noted: tuple[int, bool, bool] | None = None  # in the header
        rows: dict[str, tuple[DTypeLike, tuple[int, ...]]] = {
            "label": (np.float32, ()),
            "notes": (notes, ()),
            "points": (np.float32, (D,)),
            "hit": (np.bool_, ()),
            "beam_time": (np.float32, ()),
            "T_base_sensor": (np.float64, pose),
            "T_odom_base": (np.float64, pose),
            "sensor": (np.int32, ()),
            "stamp_ns": (np.int64, ()),
            "offset": (np.int64, ()),  # the last: a scan is whole where its end is there
        }
        self._arrays = dict[str, GrowingArray]()
        for name, of in rows.items():
            is_unnamed = folder is None or name in ("label", "notes")
            path = None if is_unnamed else Path(folder or "", f"{name}.npy")
            self._arrays[name] = GrowingArray(*of, path, scratch)
        self._arrays["offset"].append(np.zeros(1, np.int64))

    def __len__(self) -> int:
        return self._count

    def append(
        self, beams: ScanBeams, label: Float32, T_odom_base: Float | None = None, **notes: Any
    ) -> None:
        """Append a scan.

        Args:
            beams: of the scan.
            label: (N,) P(static).
            T_odom_base: (D+1, D+1); None: without odometry.
            notes: of the scan.

        Raises:
            OSError: the disk is full.
        """
        self._count += 1
        times, end = beams.beam_time, self._beam_count + len(beams.points)
        self._has_odometry &= T_odom_base is not None
        self._has_times |= times is not None
        if beams.sensor not in self._mounts:
            self._arrays["T_base_sensor"].append(beams.T_base_sensor)
            self._mounts[beams.sensor] = beams.T_base_sensor
        known = len(self._mounts), self._has_odometry, self._has_times
        if known != self._noted:
            self._write_header(is_open=True)
            self._noted = known
        note = self._arrays["notes"].dtype
        row = np.array(tuple(notes[name] for name in note.names or ()), note)
        unknown = np.full(beams.T_base_sensor.shape, np.nan)
        rows: dict[str, Any] = {
            "label": label,
            "notes": row,
            "points": beams.points,
            "hit": beams.hit,
            "beam_time": np.zeros(len(beams.points)) if times is None else times,
            "T_odom_base": unknown if T_odom_base is None else T_odom_base,
            "sensor": list(self._mounts).index(beams.sensor),
            "stamp_ns": beams.stamp_ns,
            "offset": end,
        }
        for name, values in rows.items():
            self._arrays[name].append(values)
        self.kept, self._beam_count = self.kept + 1, end

    def _drop_begun(self) -> None:
        """Remove what was written of a scan that is not whole."""
        for name, array in self._arrays.items():
            if name not in ("T_base_sensor", "offset"):
                array.truncate(self._beam_count if name in _PER_BEAM else self.kept)

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
            "dimension": self.dimension,
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

    def recording(self) -> Recording:
        """The scans so far, while more are appended; odometry only if all have it."""
        arrays = {name: array.view() for name, array in self._arrays.items()}
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
            scratch=self.scratch,
        )

    def notes(self) -> NDArray[Any]:
        """(T,) notes of the scans so far."""
        return self._arrays["notes"].view()

    def labels(self) -> Float32:
        """(M,) labels of their beams."""
        return self._arrays["label"].view()

    def close(self) -> None:
        """Close the files; the recording folder says how long they are."""
        with suppress(OSError):  # the disk is full: the folder stays open
            if self.folder is not None:
                for array in self._arrays.values():
                    array.write_length()
                self._write_header(is_open=False)
        for array in self._arrays.values():
            array.close()


class History(GrowingRecording):
    """Scans and answers. Where the disk is full, or the bound is reached, it ends there.

    The label of a beam is P(static) as it was answered. Notes of a scan are `pose` (T_map_base as
    it was answered), `local` (its pose in the frame of the odometry by scans, which never jumps),
    `anchor` (the last spaced scan at the time; -1: none yet) and `twist` ((3,) or (6,) m/s and
    rad/s of the base during it, in its own frame).

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
        self._max_bytes = np.inf if max_bytes is None else max_bytes
        self._is_full, pose = False, (dimension + 1,) * 2
        notes = [("pose", np.float64, pose), ("local", np.float64, pose), ("anchor", np.int64)]
        dtype = np.dtype([*notes, ("twist", np.float64, 3 * (dimension - 1))], align=True)
        with explaining_refusal(folder or scratch or ""):
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir(parents=True)
            super().__init__(dimension, dtype, folder, scratch)

    def append(
        self, beams: ScanBeams, label: Float32, T_odom_base: Float | None = None, **notes: Any
    ) -> None:
        """Append a scan; once it is full, only count it."""
        if self._is_full:
            self._count += 1
            return
        try:
            super().append(beams, label, T_odom_base, **notes)
        except OSError as error:
            self._end(error.strerror or str(error))
            return
        row_bytes = 9 + 4 * self.dimension
        if self._beam_count * row_bytes > self._max_bytes:
            self._end(f"{self._max_bytes / 1e9:g} GB of beams are kept")

    def _end(self, why: str) -> None:
        """Keep no more scans."""
        self._is_full = True
        self._drop_begun()
        where = self.folder or self.scratch or "temporary files"
        _log.error("%s: %s: poses go on, but from here on no scan is kept", where, why)

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

    def answer(self, number: int) -> Any:
        """The notes of a scan that is kept."""
        if number >= self.kept:
            raise InputError(f"scan {number}: is not kept, for the disk was full")
        return self.notes()[number]
