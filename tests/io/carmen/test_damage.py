"""Bad records are skipped and counted, with line numbers."""

import gzip

import pytest

from stillmap.core.errors import InputError
from stillmap.core.source import Skipped
from stillmap.io import read
from stillmap.io.builder import TIME_BACKWARDS
from stillmap.io.carmen.log import BAD_LINE


@pytest.mark.parametrize(
    "line",
    [
        "FLASER 4 1 2 3 0 0 0 0 0 0 2.0 host 0.5",  # one reading too few
        "FLASER 4 1 2 3 4 5 0 0 0 0 0 0 2.0 host",  # too many, hidden by the missing logger stamp
        "FLASER 4 1 2 3 4 5 6 0 0 0 0 0 0 2.5",  # hidden by two missing fields
        "FLASER 4 1 2 3 4 0 0 0 0 0 0",  # no stamp
        "FLASER",
        "FLASER 0 0 0 0 0 0 0 2.0 host 0.5",
        "FLASER 999999999 1 2 3 4 0 0 0 0 0 0 2.0 host 0.5",
        "FLASER 4 1 2 1_0 4 0 0 0 0 0 0 2.0 host 0.5",
        "FLASER -4 1 2 3 4 0 0 0 0 0 0 2.0 host 0.5",
        "FLASER 4 1 2 3 4 0 nan 0 0 0 0 2.0 host 0.5",
        "FLASER 4 1 2 3 4 0 1e300 0 0 0 0 2.0 host 0.5",
        "FLASER 4 1 2 3 4 0 0 0 0 0 0 1e999999999999 host 0.5",
    ],
)
def test_a_bad_line_costs_its_scan(read_log, flaser, line):
    recording = read_log([flaser(1.0), line, flaser(3.0)])
    assert recording.n_scans == 2
    assert recording.source.skipped == {BAD_LINE: Skipped(1, [2])}


@pytest.mark.parametrize("stamps", [[1, 2, 3, 900, 4, 5, 5, 6], [1, 2, 3, 0.5, 4, 5]])
def test_a_stamp_that_jumps_costs_its_scan(read_log, flaser, stamps):
    recording = read_log([flaser(stamp) for stamp in stamps])
    assert (recording.stamp_ns / 1e9).tolist() == stamps[:3] + stamps[4:]
    assert recording.source.skipped[TIME_BACKWARDS].lines == [4]


def test_cut_last_line_is_skipped(read_log, flaser):
    whole = (flaser(1.0) + "\n").encode()
    last = flaser("2.123456", [1, 2, 3, 4], kind="FLASER").encode()
    for length in range(1, len(last) - len("0.5") + 1):
        recording = read_log(whole + last[:length])
        assert recording.n_scans == 1, last[:length]
        assert recording.source.skipped[BAD_LINE].lines == [2], last[:length]
    assert read_log(whole + last).n_scans == 2


def test_damaged_gzip_stream(log, flaser):
    lines = [flaser(i, [i + 0.1 * k for k in range(30)]) for i in range(400)]
    packed = gzip.compress("\n".join(lines).encode())
    recording = read(log(packed[: len(packed) // 2], "cut.log.gz"))
    assert 50 < recording.n_scans < 350
    assert recording.source.skipped[BAD_LINE].lines == [recording.n_scans + 1]


def test_damaged_odometry(read_log, flaser):
    recording = read_log(
        ["ODOM 1 2 nan 0 0 0 1 h 0", "ODOM 1 2", "ODOM 0 0 0 0 0 0 x h 0", flaser(1.0)]
    )
    assert recording.source.skipped == {}
    assert recording.source.skipped_odometry == {BAD_LINE: Skipped(3, [1, 2, 3])}


def test_line_numbers_are_kept_up_to_a_thousand(read_log, flaser):
    recording = read_log([flaser(1.0), *["FLASER 3 1 2"] * 1500])
    damage = recording.source.skipped[BAD_LINE]
    assert damage == Skipped(1500, list(range(2, 1002)))
    assert any("1500 of 1501" in warning for warning in recording.source.warnings)


def test_log_of_damaged_scans_only(read_log):
    with pytest.raises(InputError, match=r"no usable laser scan: 2 x line that .*line 1, 2"):
        read_log(["FLASER 3 1 2", "FLASER 3 1 2"])
