"""Filtered copies of CARMEN logs."""

import gzip

import numpy as np
import pytest

from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.io.carmen.writer import find_no_return_code, write_filtered
from stillmap.io.filtered_clouds import FilterJob
from stillmap.prepare.max_range import RangeRule
from stillmap.prepare.options import ReadOptions

# real readings, and a code that repeats in several directions
READINGS = [[1.5, 81.83, 3.25, 4.0], [1.5, 2.0, 81.83, 4.0], [81.83, 2.0, 3.0, 81.83]]


@pytest.fixture
def made(log, flaser):
    """A log with other lines than scans, and odd spacing."""

    def make(name="tiny.log"):
        scans = [flaser(k + 1, row).replace(" ", "  ", 3) for k, row in enumerate(READINGS)]
        lines = ["# a comment", "PARAM robot_width 0.5", scans[0], "ODOM 0 0 0 0 0 0 1 host 1"]
        lines += ["", *scans[1:], flaser(0.25, READINGS[0]), "SOMETHING else"]
        content = "".join(f"{line}\n" for line in lines).encode()
        return log(gzip.compress(content) if name.endswith(".gz") else content, name)

    return make


def blanked(source, out, which):
    recording = read(source)
    blank = np.zeros(recording.n_beams, bool)
    blank[which] = True
    return recording, write_filtered(FilterJob(source, out, recording, blank, ReadOptions())).scans


def test_other_bytes_are_unchanged(made, tmp_path):
    source, out = made(), tmp_path / "out.log"
    recording, omitted = blanked(source, out, [0, 2, 7])
    assert recording.n_scans == 3
    assert omitted == 1
    before, after = (path.read_text().splitlines() for path in (source, out))
    # its stamp decreases: it was skipped
    assert before.pop(7).split()[-3] == "0.25"
    assert len(after) == len(before)
    changed = [k for k, (a, b) in enumerate(zip(before, after, strict=True)) if a != b]
    assert changed == [2, 5]
    assert after[2] == before[2].replace("1.5", "81.83", 1).replace("3.25", "81.83", 1)
    assert after[5] == before[5].replace("4.0", "81.83", 1)


def test_only_blanked_beams_differ(made, tmp_path):
    source, out = made(), tmp_path / "out.log"
    recording, _ = blanked(source, out, [0, 5])
    again = read(out)
    expected = recording.hit.copy()
    expected[[0, 5]] = False
    np.testing.assert_array_equal(again.hit, expected)
    np.testing.assert_array_equal(again.points[expected], recording.points[expected])
    np.testing.assert_array_equal(again.stamp_ns, recording.stamp_ns)
    np.testing.assert_array_equal(again.T_odom_base, recording.T_odom_base)


@pytest.mark.parametrize(("given", "wanted"), [("a.log.gz", "b.log"), ("a.log", "b.log.gz")])
def test_gzip_by_name(made, tmp_path, given, wanted):
    out = tmp_path / wanted
    blanked(made(given), out, [0])
    packed = out.read_bytes()
    assert packed.startswith(b"\x1f\x8b") == wanted.endswith(".gz")
    assert read(out).n_scans == 3
    blanked(made(given), out, [0])
    assert out.read_bytes() == packed


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf", b"\xef\xbb\xbf "])
@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
def test_byte_order_mark_tabs_and_line_ends(log, flaser, tmp_path, mark, end):
    lines = [flaser(k + 1, row).replace(" ", "\t").encode() for k, row in enumerate(READINGS)]
    source, out = log(mark + end.join(lines), "odd.log"), tmp_path / "out.log"
    blanked(source, out, [0])
    expected = [lines[0].replace(b"1.5", b"81.83", 1), *lines[1:]]
    assert out.read_bytes() == mark + end.join(expected)


def test_unused_scan_lines_are_omitted(log, tmp_path):
    header, host = "0 -1.57 3.14 1.57 80 0.01 0", "host 1"
    lines = []
    for k, row in enumerate(READINGS):
        readings = f"{len(row)} {' '.join(map(str, row))}"
        lines.append(f"RAWLASER1 {header} {readings} 0 {k + 1} {host}")
        pose = "0 0 0 0 0 0 0 0 0 0 0"
        lines.append(f"ROBOTLASER1 {header} {readings} 0 {pose} {k + 1} {host}")
    source, out = log(lines), tmp_path / "out.log"
    _, omitted = blanked(source, out, [2])
    assert omitted == 3
    written = out.read_text().splitlines()
    assert [line.split()[0] for line in written] == ["ROBOTLASER1"] * 3
    assert written[0].split()[9:13] == ["1.5", "81.83", "81.83", "4.0"]


def test_another_log_is_refused(made, log, flaser, tmp_path):
    recording = read(made())
    other = log([flaser(k, READINGS[0]) for k in (5, 6, 7)], "other.log")
    blank = np.zeros(12, bool)
    job = FilterJob(other, tmp_path / "out.log", recording, blank, ReadOptions())
    with pytest.raises(InputError, match="not the recording that was mapped"):
        write_filtered(job)
    assert not (tmp_path / "out.log").exists()


def rule(threshold=None, zero="unusable", free=20.0):
    return RangeRule(threshold, "", zero, free, 0.0)


@pytest.mark.parametrize(
    ("readings", "said", "expected"),
    [
        ([[1.0, 81.91, 81.83, 81.91]], rule(81.83), b"81.91"),  # the frequent one
        ([[1.0, 25.31, 25.31, 7.0]], rule(20.0), b"81.91"),  # given, not a code
        ([[1.0, np.inf]], rule(None), b"inf"),
        ([[1.0, 0.0]], rule(None, "max-range"), b"0.00"),
        ([[1.0, 2.0]], rule(None, free=None), b"81.91"),
        ([[1.0, 90.0]], rule(None, free=90.0), b"900.00"),
    ],
)
def test_no_return_code(readings, said, expected):
    assert find_no_return_code(np.array(readings, np.float32), said) == expected
