"""Small hand-written CARMEN logs."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from cut_recordings import make_recording
from recordings import of_one_sensor
from scipy.spatial.transform import Rotation

from stillmap.core.recording import Recording
from stillmap.io import read
from stillmap.prepare.options import ReadOptions


@pytest.fixture
def log(tmp_path: Path) -> Callable[..., Path]:
    """Writes lines (str) or bytes as a log and gives its path."""

    def write(lines: Iterable[str] | bytes, name: str = "tiny.log") -> Path:
        content = lines if isinstance(lines, bytes) else "".join(f"{x}\n" for x in lines).encode()
        path = tmp_path / name
        path.write_bytes(content)
        return path

    return write


@pytest.fixture
def read_log(log: Callable[..., Path]) -> Callable[..., Recording]:
    """Reads lines or bytes as a log; keywords are ReadOptions."""

    def read_lines(lines: Iterable[str] | bytes, **options: object) -> Recording:
        return read(log(lines), ReadOptions(**options))  # type: ignore[arg-type]

    return read_lines


@pytest.fixture
def flaser() -> Callable[..., str]:
    """One FLASER line of a few readings at a time in seconds."""

    def line(
        stamp: object,
        ranges: Iterable[object] = (1.0, 2.0, 3.0, 4.0),
        pose: tuple[object, object, object] = (0.0, 0.0, 0.0),
        laser_pose: tuple[object, object, object] | None = None,
        kind: str = "FLASER",
    ) -> str:
        readings = list(ranges)
        fields = [kind, len(readings), *readings, *(laser_pose or pose), *pose, stamp, "host", 0.5]
        return " ".join(str(field) for field in fields)

    return line


@pytest.fixture
def space() -> Recording:
    """A short recording in 3D: four scans of other sizes, with poses that the recording states."""
    rng = np.random.default_rng(11)
    counts = np.array([40, 1, 25, 60])
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, :3, :3] = Rotation.random(4, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(0, 3, (4, 3))
    return of_one_sensor(
        1_700_000_000_123_456_789 + np.array([0, 1, 100_000_007, 2**33], np.int64),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        rng.normal(0, 20, (counts.sum(), 3)).astype(np.float32),
        np.ones(counts.sum(), bool),
        T_recorded_base=T,
    )


@pytest.fixture
def drive():
    """60 scans in 2D."""
    return make_recording()
