"""Small hand-written CARMEN logs."""

from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from stillmap.recording import Recording, read
from stillmap.recording.options import ReadOptions


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
