"""Files that would keep a reader for ever, fill its memory, or break it: found by fuzzing, or
thought of. What is asserted first of all is that reading ends."""

import gzip
import os
import re
import struct
import tracemalloc
import zipfile
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from stillmap.core.config import load_toml, override, parse_assignment
from stillmap.core.errors import InputError
from stillmap.io import read, stillmap_folder, text_lines, writers
from stillmap.io.trajectory import read_tum
from stillmap.prepare.options import ReadOptions
from stillmap.results import reader
from stillmap.results.eval import readers

FLASER = "FLASER 2 1.0 2.0 0 0 0 0 0 0 1 host 1\n"


def test_header_of_an_array_that_numpy_would_speak_of(tmp_path, log):
    stillmap_folder.write(read(log([FLASER])), tmp_path / "r")
    for name, old, new in (("offset", b"(2,)", b"(2L,)"), ("stamp_ns", b"'<i8'", b"'\\_i8'")):
        path = tmp_path / "r" / f"{name}.npy"
        content = path.read_bytes()
        grown = len(new) - len(old)
        path.write_bytes(content.replace(old, new, 1).replace(b" " * (1 + grown), b" ", 1))
        if name == "offset":
            assert read(tmp_path / "r").n_scans == 1
    with pytest.raises(InputError, match=r"stamp_ns\.npy: is damaged"):
        read(tmp_path / "r")


@contextmanager
def little_memory(most):
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


@pytest.fixture
def few_bytes_are_fine(monkeypatch):
    monkeypatch.setattr(text_lines, "_MIN_LIMIT", 1 << 20)


@pytest.mark.parametrize("piece", [b"\n", b"\0" * 1000, b"ODOM 0 0 0 0 0 0 1 h 1\n"])
@pytest.mark.usefixtures("few_bytes_are_fine")
def test_gzip_that_unpacks_to_too_much(tmp_path, piece):
    for name, start in (("a.log.gz", FLASER), ("a.3d.gz", "1 2 3\n")):
        text = start.encode() + piece * ((2 << 20) // len(piece))
        (tmp_path / name).write_bytes(gzip.compress(text))
        with pytest.raises(InputError, match=r"more than 100 times its size|is damaged"):
            read(tmp_path / name)


@pytest.mark.usefixtures("few_bytes_are_fine")
def test_logs_that_pack_well_are_read(tmp_path):
    rng = np.random.default_rng(0)
    log = "".join(FLASER.replace(" 1 host", f" {t + rng.random():.6f} host") for t in range(30_000))
    (tmp_path / "a.log.gz").write_bytes(gzip.compress(log.encode()))
    assert read(tmp_path / "a.log.gz").n_scans == 30_000


@pytest.mark.parametrize("name", ["stamp_ns.npy", "points.npy", "T_odom_base.npy"])
def test_pipe_in_a_recording(tmp_path, log, name):
    stillmap_folder.write(read(log([FLASER])), tmp_path / "r")
    (tmp_path / "r" / name).unlink()
    os.mkfifo(tmp_path / "r" / name)
    with pytest.raises(InputError, match=f"{name}: is no regular file"):
        read(tmp_path / "r")


OF_SCORES = (readers.read_relations, readers.read_trajectory, readers.read_odometry)


@pytest.mark.parametrize("reader", [load_toml, read_tum, *OF_SCORES, read])
def test_device_without_end(tmp_path, reader):
    (tmp_path / "zero").symlink_to("/dev/zero")
    with pytest.raises(InputError, match="is no regular file"):
        reader(tmp_path / "zero")


@pytest.mark.parametrize("number", ["0x" + "f" * 5000, "9" * 5000, "-0x" + "f" * 5000])
@pytest.mark.parametrize("name", ["max_range", "topic", "self_filter"])
def test_options_of_thousands_of_digits(tmp_path, name, number):
    (tmp_path / "a.toml").write_text(f"{name} = {number}")
    with pytest.raises(InputError) as caught:
        override(ReadOptions(), load_toml(tmp_path / "a.toml"))
    assert len(str(caught.value)) < 400
    parse_assignment(f"read.{name}={number}")


def test_map_that_unpacks_to_too_much(tmp_path, monkeypatch):
    monkeypatch.setattr(reader, "_MAX_MAP", 1 << 20)
    with zipfile.ZipFile(tmp_path / "map.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("p_occupied.npy", b"\0" * (2 << 20))
    with pytest.raises(InputError, match="2 MiB of p_occupied when unpacked"):
        reader.read_grid(tmp_path)


def test_points_of_impossible_size(tmp_path, space):
    pytest.importorskip("laspy")
    path = tmp_path / "a.las"
    writers.write(space, path)
    content = bytearray(path.read_bytes())
    struct.pack_into("<HI", content, 105, 17_197, 200_000)  # bytes of a point, points
    path.write_bytes(content)
    with little_memory(100 << 20), pytest.raises(InputError):
        read(path)


@pytest.mark.parametrize("blank", [b"\x1c", b"\x1f\x1f", b"\x85", b"\xa0"])
def test_lines_that_only_numpy_takes_for_empty(tmp_path, blank):
    header = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n"
    (tmp_path / "a.pcd").write_bytes(header + blank + b"\n1 2 3\n")
    assert read(tmp_path / "a.pcd").points.tolist() == [[1.0, 2.0, 3.0]]


@pytest.mark.parametrize("value", [struct.pack("<I", 0x7FA00001), struct.pack("<f", 3e38)])
def test_numbers_that_numpy_would_speak_of(tmp_path, value):
    header = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 3\nDATA binary\n"
    (tmp_path / "a.pcd").write_bytes(header + value + struct.pack("<8f", *range(1, 9)))
    assert read(tmp_path / "a.pcd").hit.tolist() == [False, True, True]


@pytest.mark.parametrize("error", [FileNotFoundError(2, "gone", "a.log"), MemoryError()])
def test_what_happens_while_reading(log, monkeypatch, error):
    def fails(*_):
        raise error

    monkeypatch.setattr("stillmap.io.carmen.reader.read_log", fails)
    with pytest.raises(InputError, match=r"cannot be read: gone|does not fit into memory"):
        read(log([FLASER]))


def test_errors_are_one_short_line():
    error = InputError("x" * 10_000, where="a\nb\x1b[31m\x85", hint="y" * 10_000)
    assert len(str(error)) < 2100
    assert re.match(r"a b\\x1b\[31m\\x85: xxx", str(error))


@pytest.mark.parametrize("name", [b"new\nline.log", b"not\xfftext.log", b"a?b#c%41.log"])
def test_names_of_any_bytes(tmp_path, name):
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name))
    path.write_text(FLASER)
    assert read(path).n_scans == 1
    path.write_text("nothing\n")
    with pytest.raises(InputError) as caught:
        read(path)
    assert "\n" not in str(caught.value)
