"""All scans, and the poses and labels returned for them, in temporary files."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core.array_builder import QUICKLY_WRITTEN, ArrayBuilder
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.live.beam_store import BeamStore, join_parts
from stillmap.live.row_numbers import RowNumbers
from stillmap.live.scan import ScanBeams

Float = NDArray[np.float64]

# bytes of answers in memory while the disk is full, 25 minutes of 40 Hz: beyond, those to scans
# that were dropped are dropped as well, but for spaced ones; share of them, the last, that stays
_IN_MEMORY_IF_FULL, _RECENT = 16 << 20, 0.5


@dataclass(frozen=True, eq=False)
class Answers(ShortRepr):
    """Poses and labels returned by `push` for T scans with M beams.

    Attributes:
        number: (T,) of the scans, as they were pushed: all, unless some were dropped.
        poses: (T, D+1, D+1) T_map_base as it was given.
        local: (T, D+1, D+1) in the frame of the odometry by scans, which never jumps.
        anchor: (T,) the last spaced scan at the time; -1: none yet.
        p_static: (M,) float32.
    """

    number: NDArray[np.int64]
    poses: Float
    local: Float
    anchor: NDArray[np.int64]
    p_static: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class KeptScans(ShortRepr):
    """The scans that are kept at a time, while more are appended.

    Attributes:
        number: (T,) of the scans, as they were pushed.
        counts: (T,) number of beams of each.
        answers: (T,) of `answer_type`.
        parts: points, hit, P(static) and time of the beams, each in parts one after another.
        files: the open file that holds each of the parts; None: it is in memory.
        sensors: name and T_base_sensor of each.
        has_odometry: every scan had it.
        has_times: the beams have times.
        warnings: about scans that are missing.
        disk_was_full: that of the temporary files.
    """

    number: NDArray[np.int64]
    counts: NDArray[np.int64]
    answers: NDArray[Any]
    parts: list[list[NDArray[Any]]]
    files: list[list[IO[bytes] | None]]
    sensors: list[tuple[str, Float]]
    has_odometry: bool
    has_times: bool
    warnings: list[str]
    disk_was_full: bool

    def load(self, folder: Path | None) -> tuple[Recording, Answers]:
        """The scans and what was answered, in temporary files in a folder (None: the system's);
        takes long where some scans were dropped, and may be called in another thread.

        Raises:
            OSError: the disk is full.
        """
        points, hit, p_static, times = join_parts(self.parts, folder)
        sensors = [{"name": name, "extrinsics": {"how": "given"}} for name, _ in self.sensors]
        answers = self.answers
        recording = Recording(
            stamp_ns=answers["stamp_ns"].copy(),
            offset=np.concatenate([np.zeros(1, np.int64), np.cumsum(self.counts)]),
            points=points,
            hit=hit,
            T_base_sensor=np.array([T for _, T in self.sensors]),
            sensor=answers["sensor"].copy(),
            T_odom_base=answers["T_odom_base"].copy() if self.has_odometry else None,
            source={"format": "live", "sensors": sensors, "warnings": self.warnings},
            beam_time=times if self.has_times else None,
            scratch=folder,
        )
        return recording, Answers(self.number, *_split(answers), p_static)


def answer_type(dimension: int) -> np.dtype[Any]:
    """A scan and the answer to it, in D dimensions."""
    T = (np.float64, (dimension + 1, dimension + 1))
    fields = [
        ("stamp_ns", np.int64),
        ("anchor", np.int64),
        ("T_odom_base", *T),
        ("pose", *T),
        ("local", *T),
        ("twist", np.float64, 3 if dimension == 2 else 6),
        ("sensor", np.int32),
    ]
    return np.dtype(fields, align=True)


def beam_fields(dimension: int) -> list[tuple[DTypeLike, tuple[int, ...]]]:
    """Type and shape of a row of points, hit, P(static) and time of the beams."""
    return [(np.float32, (dimension,)), (np.bool_, ()), (np.float32, ()), (np.float32, ())]


class History:
    """Scans and answers, appended.

    Args:
        dimension: 2 or 3.
        folder: of the temporary files; None: the system's.
        max_bytes: about, of the beams, 17 bytes each, in 3D 21: beyond, every second one of the
            scans that lie most densely is dropped; None: unbounded.
    """

    def __init__(
        self, dimension: int, folder: Path | None = None, max_bytes: int | None = None
    ) -> None:
        self._answer = answer_type(dimension)
        self._answers = ArrayBuilder(self._answer, (), folder, QUICKLY_WRITTEN)
        self._beams = BeamStore(beam_fields(dimension), folder, max_bytes)
        self._count, self._rows, self._due = 0, RowNumbers(), _IN_MEMORY_IF_FULL
        self._mounts: dict[str | int, Float] = {}
        self._has_odometry, self._has_times = True, False
        self._folder = folder

    def close(self) -> None:
        """Remove the files."""
        self._beams.close()
        self._answers.close()

    def __len__(self) -> int:
        return self._count

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
        self._mounts.setdefault(beams.sensor, beams.T_base_sensor)
        self._has_odometry &= T_odom_base is not None
        self._has_times |= beams.beam_time is not None
        times = beams.beam_time
        if times is None:
            times = np.zeros(len(beams.points), np.float32)
        answer = np.zeros(1, self._answer)
        answer["stamp_ns"], answer["anchor"] = beams.stamp_ns, anchor
        answer["T_odom_base"] = np.nan if T_odom_base is None else T_odom_base
        answer["pose"], answer["local"], answer["twist"] = pose, local, twist
        answer["sensor"] = list(self._mounts).index(beams.sensor)
        number = len(self)
        with suppress(OSError):  # it stays in memory, as the beams do, which say so
            self._answers.append(answer)
        self._rows.append(number)
        self._count += 1
        self._beams.append(number, [beams.points, beams.hit, p_static, times])
        if self._answers.memory_bytes > self._due:
            self._drop_answers()

    def _drop_answers(self) -> None:
        """Drop the answers to scans that were dropped, of those in memory: the disk is full."""
        with suppress(OSError):
            self._answers.write()  # perhaps there is room again
        if self._answers.memory_bytes <= self._due:
            return
        kept = self._beams.has(self._rows.numbers()[self._answers.written :])
        anchor = self._answers.parts()[-1]["anchor"]  # in memory there is one part
        kept |= np.diff(anchor, append=anchor[-1]) != 0  # spaced scans: the poses between follow
        kept[int(_RECENT * len(kept)) :] = True
        self._answers.select_last(kept)
        self._rows.select_last(kept)
        self._due = max(_IN_MEMORY_IF_FULL, 2 * self._answers.memory_bytes)

    @property
    def was_full(self) -> bool:
        """True if the disk was full: scans may be missing."""
        return self._beams.was_full

    def has(self, number: int) -> bool:
        """True if the answer to a scan is kept: all are, unless the disk was full."""
        return self._rows.has(number)

    def at(self, number: int) -> tuple[int, Float]:
        """Anchor and local pose of a scan, see `Answers`."""
        answer = self._answers.row(self._row_of(number))
        return int(answer["anchor"]), np.array(answer["local"])

    def twist_at(self, number: int) -> Float:
        """(3,) or (6,) m/s and rad/s of the base during a scan."""
        return np.array(self._answers.row(self._row_of(number))["twist"])

    def _row_of(self, number: int) -> int:
        if not self.has(number):
            raise InputError(f"scan {number}: was dropped while the disk was full")
        return int(self._rows.find(np.array([number]))[0])

    def recording(self) -> Recording:
        """The scans that are kept. Odometry only if every scan had it. If the disk was full,
        temporary files are in the system's folder."""
        return self.snapshot().load(None if self.was_full else self._folder)[0]

    def snapshot(self) -> KeptScans:
        """The scans that are kept, and what `push` has returned for them."""
        beams, warnings = self._beams, list[str]()
        kept = beams.kept
        if self.was_full and len(kept) < len(self):
            warnings.append(
                f"the disk of temporary files was full: of {len(self)} scans {len(kept)} were kept"
            )
        return KeptScans(
            kept,
            beams.counts,
            self._answers.view()[self._rows.find(kept)],
            beams.parts(),
            beams.files(),
            [(str(name), T) for name, T in self._mounts.items()],
            self._has_odometry,
            self._has_times,
            warnings,
            self.was_full,
        )

    def poses(self) -> tuple[Float, Float, NDArray[np.int64]]:
        """`poses`, `local` and `anchor` of all scans, see `Answers`; of one whose answer was
        dropped those of the last one before it."""
        answers = self._answers.view()
        if len(self._rows) < len(self):
            answers = answers[self._rows.find(np.arange(len(self)))]
        return _split(answers)

    @property
    def dropped(self) -> NDArray[np.int64]:
        """(K,) numbers of the scans the answers to which were dropped."""
        if len(self._rows) == len(self):
            return np.zeros(0, np.int64)
        return np.setdiff1d(np.arange(len(self)), self._rows.numbers(), assume_unique=True)


def _split(answers: NDArray[Any]) -> tuple[Float, Float, NDArray[np.int64]]:
    return answers["pose"].copy(), answers["local"].copy(), answers["anchor"].copy()
