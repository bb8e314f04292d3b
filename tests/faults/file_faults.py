"""What may be wrong with a file that is read, and how a command has to end."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from faulty_inputs import Reader

from stillmap.cli.main import main
from stillmap.core import input_files

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


BEFORE = (be_empty, be_folder, be_pipe, be_loop, be_device)


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
        assert not any(output.parent.iterdir())
    names = [one.name for one in output.parent.iterdir()]
    assert [name for name in names if not name.startswith(output.name)] == []
