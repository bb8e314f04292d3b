"""Opening of files that are read: what is refused, and what files that change give."""

import os
import socket
from pathlib import Path

import numpy as np
import pytest

from stillmap.core import arrays
from stillmap.core.array_folder import open_npy
from stillmap.core.errors import InputError
from stillmap.core.input_files import (
    InputFile,
    InputPath,
    ShorterFileError,
    copy_content,
    hold_lock,
    read_bytes,
    read_text,
)
from stillmap.core.json import read_json

LARGE = 1 << 20  # bytes, more than are read at once


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "a").write_bytes(bytes(range(256)) * (LARGE // 256))
    return tmp_path / "a"


def test_content_is_that_of_the_file(file):
    whole = file.read_bytes()
    with InputFile(file) as opened:
        assert opened.size == LARGE
        assert opened.read(10) == whole[:10]
        assert opened.seek(-5, os.SEEK_END) == LARGE - 5
        assert opened.read() == whole[-5:]
        assert opened.read() == b""
        opened.seek(0)
        assert opened.read() == whole
    with InputPath(file).open("rb") as opened:
        assert opened.read() == whole
    copy_content(file, file.with_name("b"))
    assert read_bytes(file.with_name("b"), LARGE) == whole


@pytest.mark.parametrize("opens", [InputFile, lambda path: read_text(path, 9)])
def test_what_is_no_regular_file(tmp_path, opens):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "device").symlink_to("/dev/zero")
    (tmp_path / "folder").mkdir()
    bound = socket.socket(socket.AF_UNIX)
    with bound:
        bound.bind(os.path.relpath(tmp_path / "socket"))
        for name, said in (
            ("pipe", "is no regular file"),
            ("loop", "cannot be read: Too many levels of symbolic links"),
            ("device", "is no regular file"),
            ("folder", "is a folder"),
            ("socket", "is no regular file"),
            ("absent", "cannot be read: No such file"),
            ("nul\0", "is no usable path"),
            ("lone \ud800", "is no usable path"),
        ):
            with pytest.raises(InputError, match=said):
                opens(tmp_path / name)


def test_pipe_that_comes_meanwhile(file, monkeypatch):
    """Between the look and the opening."""
    opens = os.open

    def swap(path, flags, *more):
        file.unlink()
        os.mkfifo(file)
        return opens(path, flags, *more)

    monkeypatch.setattr(os, "open", swap)
    with pytest.raises(InputError, match="is no regular file"):
        InputFile(file)


@pytest.mark.parametrize("read", [InputFile.read, lambda file: file.read(LARGE), list])
def test_file_that_becomes_shorter(file, read):
    with InputFile(file) as opened:
        opened.read(100)
        os.truncate(file, LARGE // 2)
        with pytest.raises(ShorterFileError, match=f"it ends at byte {LARGE // 2}"):
            read(opened)


def test_file_that_grows(file):
    whole = file.read_bytes()
    with InputFile(file) as opened:
        start = opened.read(100)
        with file.open("ab") as more:
            more.write(b"more")
        assert start + opened.read() == whole
        assert opened.read(1) == b""


def test_texts_with_nul(tmp_path):
    """No path, topic or name can hold it."""
    (tmp_path / "a.json").write_text('{"path": "a\\u0000b"}')
    with pytest.raises(InputError, match=r"a\.json: is not JSON: a text holds NUL"):
        read_json(tmp_path / "a.json", 100)


def test_limit_of_size(file):
    with pytest.raises(InputError, match="is too large: more than 1023 KiB"):
        read_bytes(file, LARGE - 1024)


@pytest.mark.parametrize("limit", [0, 1 << 30])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_are_copies(tmp_path, monkeypatch, limit, order):
    monkeypatch.setattr(arrays, "MAX_BYTES_IN_MEMORY", limit)
    array = np.arange(5000, dtype=np.float32).reshape(50, 100)
    np.save(tmp_path / "a.npy", np.asarray(array, order=order))
    found = open_npy(tmp_path / "a.npy")
    os.truncate(tmp_path / "a.npy", 0)
    arrays.release_pages(found)
    np.testing.assert_array_equal(found, array)
    assert found.dtype == np.float32
    assert not found.flags.writeable


def test_arrays_that_cannot_be(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{}]), allow_pickle=True)
    with pytest.raises(InputError, match="is damaged"):
        open_npy(tmp_path / "a.npy")
    np.save(tmp_path / "a.npy", np.arange(100))
    os.truncate(tmp_path / "a.npy", 500)
    with pytest.raises(InputError, match=r"is damaged: no \(100,\) int64 follow its header"):
        open_npy(tmp_path / "a.npy")


def test_lock_that_is_a_link_leading_nowhere(tmp_path):
    (tmp_path / "lock").symlink_to(tmp_path / "gone" / "lock")
    with pytest.raises(OSError, match="symbolic links"):
        hold_lock(tmp_path / "lock", "is locked", "out")
