"""Detection of formats, and errors of one line."""

import gzip
import os

import pytest

from stillmap.core.errors import InputError
from stillmap.io import read


@pytest.mark.parametrize(
    "name", ["a.log", "a.clf", "a.LOG", "a.txt", "a.log.gz", "a.clf.gz", "a.gz", "a.dat", "noname"]
)
@pytest.mark.parametrize("packed", [False, True])
def test_logs_by_suffix_or_content(log, flaser, name, packed):
    text = ("# comment\n" + flaser(1.0) + "\n").encode()
    assert read(log(gzip.compress(text) if packed else text, name)).n_scans == 1


@pytest.mark.parametrize("name", ["a.log", "a.clf.gz", "a.xyz"])
@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "is empty"),
        (bytes(range(256)) * 100, "is binary"),
        (gzip.compress(bytes(4096), mtime=0), "is binary"),  # workers must agree on its name
        (b"hello\nworld\n", "no "),
        (b"ODOM 0 0 0 0 0 0 1.0 host 0\n", "no laser line"),
        (b"\x1f\x8b", "no "),
    ],
)
def test_other_files(log, name, content, what):
    path = log(content, name)
    with pytest.raises(InputError, match=what) as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.hint


def test_missing_path(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read(tmp_path / "missing.log")
    with pytest.raises(InputError, match="without a recording"):
        read(tmp_path)


def test_recordings_in_a_folder_are_listed(tmp_path):
    outer = tmp_path / "sim"
    (outer / "notes").mkdir(parents=True)
    (outer / ".hidden").write_text("")

    def said(*more: str) -> str:
        for name in more:
            (outer / name).mkdir()
            (outer / name / "recording.json").write_text("")
        with pytest.raises(InputError) as caught:
            read(outer)
        return str(caught.value)

    assert "is a folder without a recording" in said()
    assert said("tilting").endswith(f"holds a recording: {outer / 'tilting'} (name it)")
    both = said("horizontal")
    assert both.startswith(f"{outer}: is no recording but holds several recordings: ")
    assert f"{outer / 'horizontal'}, {outer / 'tilting'} (both: " in both
    assert f"{outer / 'horizontal'} with tilting={outer / 'tilting'}" in both
    (outer / "run.json").write_text("")
    assert "is a folder without a recording" in said()  # a result folder: its clouds are objects
    (outer / "run.json").unlink()
    many = said("a", "b", "c")
    assert f"{outer / 'a'}, {outer / 'b'}, {outer / 'c'} and 2 more (name one of them)" in many


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_named_pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe.log")
    with pytest.raises(InputError, match="regular file"):
        read(tmp_path / "pipe.log")


@pytest.mark.parametrize("path", ["a\0b.log", "x" * 5000 + ".log"])
def test_impossible_paths(path):
    with pytest.raises(InputError):
        read(path)
