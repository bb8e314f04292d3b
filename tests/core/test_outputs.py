"""Outputs appear whole or not at all: behind links, on mount points, with long names."""

import contextlib
import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from stillmap.core import files
from stillmap.core.errors import InputError
from stillmap.core.files import (
    atomic_file,
    atomic_folder,
    require_new,
    require_new_file,
)

NEW = {"mark": "new", "b/c": "new", "d": "new"}
OLD = {"mark": "old", "a": "old", "b/x": "old"}


def fill(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def content(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): path.read_text()
        for path in folder.rglob("*")
        if path.is_file()
    }


def write(
    path: Path,
    files: dict[str, str] = NEW,
    overwrite: bool = False,
    meanwhile: Callable[[], None] = lambda: None,
) -> None:
    with atomic_folder(path, "mark", overwrite) as work:
        fill(work, files)
        meanwhile()


def write_file(path: Path, text: str, meanwhile: Callable[[], None] = lambda: None) -> None:
    with atomic_file(path) as work:
        work.write_text(text)
        meanwhile()


@pytest.fixture
def fixed(tmp_path, monkeypatch) -> Path:
    """A folder that cannot be renamed."""
    path = tmp_path / "fixed"
    path.mkdir()
    monkeypatch.setattr(files, "_is_mount_point", lambda folder: folder == path)
    rename = os.rename

    def refuse(source, target):
        if path in (Path(source), Path(target)):
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))
        rename(source, target)

    monkeypatch.setattr("os.rename", refuse)
    return path


def test_folder_behind_a_link(tmp_path):
    (tmp_path / "disk" / "there").mkdir(parents=True)
    (tmp_path / "link").symlink_to("disk/there")
    with atomic_folder(tmp_path / "link", "mark") as work:
        assert work.parent == tmp_path / "disk"
        fill(work, NEW)
    assert (tmp_path / "link").is_symlink()
    assert content(tmp_path / "disk/there") == NEW
    assert os.listdir(tmp_path / "disk") == ["there"]


def test_link_to_nothing(tmp_path):
    (tmp_path / "link").symlink_to("new/there")
    (tmp_path / "file").symlink_to("plain")
    write(tmp_path / "link")
    assert content(tmp_path / "new/there") == NEW
    with atomic_file(tmp_path / "file") as work:
        work.write_text("new")
    assert (tmp_path / "file").is_symlink()
    assert (tmp_path / "plain").read_text() == "new"


def test_link_to_itself_is_refused(tmp_path):
    (tmp_path / "link").symlink_to("link")
    for check in (lambda path: require_new(path, "mark"), require_new_file, write):
        with pytest.raises(InputError, match="leads to itself"):
            check(tmp_path / "link")


def test_pipe_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="no regular file"), atomic_file(tmp_path / "pipe"):
        pass
    with pytest.raises(InputError, match="not a folder"):
        write(tmp_path / "pipe")
    assert (tmp_path / "pipe").is_fifo()


@pytest.mark.parametrize("name", ["n" * 255, "ä" * 127, "n" * 254 + ".", "n" * 251 + ".bag"])
def test_long_names(tmp_path, name):
    write(tmp_path / name)
    write(tmp_path / name, overwrite=True)
    assert content(tmp_path / name) == NEW
    shutil.rmtree(tmp_path / name)
    with atomic_file(tmp_path / name) as work:
        work.write_text("new")
    assert (tmp_path / name).read_text() == "new"
    assert os.listdir(tmp_path) == [name]


def test_folder_that_cannot_be_renamed(fixed, tmp_path):
    write(fixed)
    assert content(fixed) == NEW
    with pytest.raises(InputError, match="already holds something"):
        write(fixed)
    fill(fixed, {"lost+found/x": "of the disk"})
    write(fixed, OLD, overwrite=True)
    assert content(fixed) == OLD | {"lost+found/x": "of the disk"}
    assert os.listdir(tmp_path) == ["fixed"]


@pytest.mark.parametrize("step", range(9))
def test_interrupted_exchange_is_no_result_and_is_written_again(fixed, monkeypatch, step):
    """Of a process that is killed: without the marker nothing takes the folder for whole."""
    write(fixed, OLD)
    steps = iter(range(100))

    def stopping(function):
        def call(*words, **options):
            if next(steps) >= step:
                raise SystemExit
            return function(*words, **options)

        return call

    with monkeypatch.context() as patch:
        patch.setattr("os.rename", stopping(os.rename))
        patch.setattr("shutil.rmtree", stopping(shutil.rmtree))
        patch.setattr(Path, "unlink", stopping(Path.unlink))
        with contextlib.suppress(SystemExit):
            write(fixed, overwrite=True)
    visible = {name: text for name, text in content(fixed).items() if ".stillmap." not in name}
    assert "mark" not in visible or visible in (OLD, NEW)
    write(fixed, OLD, overwrite=True)
    assert content(fixed).items() >= OLD.items()


@pytest.mark.parametrize("number", [errno.EBUSY, errno.EXDEV, errno.EACCES])
@pytest.mark.parametrize("earlier", [False, True])
def test_rename_that_fails_at_the_end(tmp_path, monkeypatch, number, earlier):
    """Where nothing told before that it would."""
    path, rename = tmp_path / "out", os.rename
    if earlier:
        write(path, OLD)

    def refuse(source, target):
        if path in (Path(source), Path(target)):
            raise OSError(number, os.strerror(number))
        rename(source, target)

    monkeypatch.setattr("os.rename", refuse)
    write(path, overwrite=True)
    assert content(path) == NEW
    assert os.listdir(tmp_path) == ["out"]


@pytest.mark.parametrize("number", [errno.EBUSY, errno.EXDEV])
def test_file_that_cannot_be_replaced_is_written_in_place(tmp_path, monkeypatch, number):
    path, text = tmp_path / "file", "0123456789" * 10_000
    path.write_text("old" * 100_000)

    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("os.replace", refuse)
    write_file(path, text)
    assert path.read_text() == text
    assert os.listdir(tmp_path) == ["file"]

    def fail(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("shutil.copyfile", fail)
    with pytest.raises(InputError, match="No space"):
        write_file(path, text)
    assert path.read_bytes() == b""
    assert os.listdir(tmp_path) == ["file"]


def test_folder_that_appears_meanwhile_stays(tmp_path):
    path = tmp_path / "out"
    with pytest.raises(InputError, match="already holds"):
        write(path, meanwhile=lambda: fill(path, {"mine": "mine"}))
    assert content(path) == {"mine": "mine"}
    assert os.listdir(tmp_path) == ["out"]


def test_errors_about_unfinished_work_name_the_output(tmp_path):
    with pytest.raises(InputError) as failed, atomic_folder(tmp_path / "out", "mark") as work:
        raise InputError("is bad", where=f"{work}/a.pcd:3")
    assert failed.value.where == f"{tmp_path}/out/a.pcd:3"
    with pytest.raises(InputError) as failed, atomic_file(tmp_path / "file") as work:
        raise InputError("is bad", where=str(work))
    assert failed.value.where == f"{tmp_path}/file"


def test_file_that_appears_meanwhile_stays(tmp_path):
    path = tmp_path / "file"
    with pytest.raises(InputError, match="has appeared meanwhile"):
        write_file(path, "new", lambda: fill(tmp_path, {"file": "mine"}))
    assert path.read_text() == "mine"
    assert os.listdir(tmp_path) == ["file"]


def test_work_of_processes_that_were_killed_long_ago_is_removed(tmp_path):
    names = [f".out.{digit * 16}.part" for digit in "abc"]
    aside = f".out.{'a' * 16}.old"
    fill(tmp_path, {f"{names[0]}/x": "", names[1]: "", f"{names[2]}/x": "", ".out.part": ""})
    fill(tmp_path, {f"{aside}/x": ""})
    # in the last one something has changed since
    for name in (f"{names[0]}/x", f"{aside}/x", *names, aside, ".out.part"):
        os.utime(tmp_path / name, (0, 0))
    write(tmp_path / "out")
    assert sorted(os.listdir(tmp_path)) == [names[2], ".out.part", "out"]
