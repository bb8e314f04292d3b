"""Every reader with every fault: exit status 0, or 2 with one line; and an end, soon."""

import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

for needed in ("pye57", "laspy", "lazrs", "lzf"):
    pytest.importorskip(needed)

sys.path.append(str(Path(__file__).resolve().parent))

from faulty_inputs import RECORDINGS, Reader  # noqa: E402

from stillmap.cli.main import main  # noqa: E402
from stillmap.core import input_files  # noqa: E402

_PATIENCE = 60  # s


class Stuck(BaseException):
    """A command does not end."""


@pytest.fixture(autouse=True)
def end_in_time() -> Iterator[None]:
    def stop(*_: object) -> None:
        raise Stuck

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(_PATIENCE)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


# what is done to the file before the command


def be_empty(path: Path) -> None:
    os.truncate(path, 0)


def be_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def be_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def be_loop(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


def be_device(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def be_of_proc(path: Path) -> None:
    path.unlink()
    path.symlink_to("/proc/kmsg" if os.access("/proc/kmsg", os.R_OK) else "/proc/self/mem")


def be_one_of_many(path: Path) -> None:
    """10 000 files beside it, with its ending."""
    ending = "".join(path.suffixes[-2:])
    for number in range(10_000):
        (path.parent / f"{number:06d}{ending}").touch()


BEFORE = (be_empty, be_folder, be_pipe, be_loop, be_device, be_of_proc, be_one_of_many)


# what is done to it once something of it has been read


def shrink(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def vanish(path: Path) -> None:
    os.truncate(path, 0)


def grow(path: Path) -> None:
    with path.open("ab") as file:
        file.write(b"\n1 2 3" * 1000)


MEANWHILE = (shrink, vanish, grow)


def while_read(monkeypatch: pytest.MonkeyPatch, path: Path, change: Callable[[Path], None]) -> None:
    """Change a file after the first bytes of it have been read."""
    read, done = input_files._RegularFile.readinto, []

    def readinto(file: input_files._RegularFile, buffer: memoryview) -> int:
        # not all at once: there must be something left to read
        n = read(file, memoryview(buffer).cast("B")[:64])
        if not done and os.path.samestat(os.fstat(file.fileno()), path.stat()):
            done.append(path)
            change(path)
        return n

    monkeypatch.setattr(input_files._RegularFile, "readinto", readinto)


def run(reader: Reader, folder: Path, path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Run the command of a reader, and judge how it ends."""
    output = folder / "output" / "out"
    output.parent.mkdir()
    scratch = folder / "scratch"
    scratch.mkdir()
    status = main(reader.command(path, output))
    said = capsys.readouterr().err.splitlines()
    assert status in (0, 2), said
    assert not any("Traceback" in line for line in said)
    if status == 2:
        assert len(said) == 1
        assert said[0].startswith("stillmap: ")
        assert not output.exists()
    assert [one.name for one in output.parent.iterdir() if one != output] == []


def rows(faults: tuple[Callable[[Path], None], ...]) -> list[object]:
    return [
        pytest.param(
            reader,
            fault,
            id=f"{reader.name.replace('/', '-')}-{fault.__name__}",
            marks=() if reader.is_quick and fault not in (be_one_of_many,) else pytest.mark.slow,
        )
        for reader in RECORDINGS
        for fault in faults
    ]


def made(reader: Reader, tmp_path: Path) -> Path:
    (tmp_path / "in").mkdir()
    return reader.make(tmp_path / "in")


@pytest.mark.parametrize(("reader", "fault"), rows(BEFORE))
def test_fault_before(tmp_path, capsys, reader, fault):
    path = made(reader, tmp_path)
    fault(tmp_path / "in" / reader.victim)
    run(reader, tmp_path, path, capsys)


@pytest.mark.parametrize(("reader", "fault"), rows(MEANWHILE))
def test_fault_meanwhile(tmp_path, capsys, monkeypatch, reader, fault):
    path = made(reader, tmp_path)
    while_read(monkeypatch, tmp_path / "in" / reader.victim, fault)
    run(reader, tmp_path, path, capsys)


@pytest.mark.parametrize("reader", [pytest.param(one, id=one.name) for one in RECORDINGS])
def test_without_fault(tmp_path, capsys, reader):
    path = made(reader, tmp_path)
    output = tmp_path / "out"
    assert main(reader.command(path, output)) == 0, capsys.readouterr().err
    shutil.rmtree(output, ignore_errors=True)
