"""Bad records are skipped and counted, by reason and with line numbers."""

import gzip

import pytest

from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.io.text_lines import MAX_LINE


def lines_of(recording, reason):
    damage = recording.source["skipped"][reason]
    assert damage["count"] == len(damage["lines"])
    return damage["lines"]


@pytest.mark.parametrize(
    "line",
    [
        "FLASER 4 1 2 3 0 0 0 0 0 0 2.0 host 0.5",  # one reading too few
        "FLASER 4 1 2 3 4 5 0 0 0 0 0 0 2.0 host 0.5",  # one too many
        "FLASER 4 1 2 3 4 5 0 0 0 0 0 0 2.0 host",  # hidden by the missing logger stamp
        "FLASER 4 1 2 3 4 5 6 0 0 0 0 0 0 2.5",  # hidden by two missing fields
        "FLASER 4 1 2 3 4 0 0 0 0 0 0",  # no stamp
        "FLASER 4 1 2",
        "FLASER",
        "FLASER 0 0 0 0 0 0 0 2.0 host 0.5",
        "FLASER 999999999 1 2 3 4 0 0 0 0 0 0 2.0 host 0.5",
        "FLASER 5 1 2 3 4 5 0 0 0 0 0 0 2.0 host 0.5",  # well-formed, but not as all others
    ],
)
def test_wrong_number_of_readings(read_log, flaser, line):
    recording = read_log([flaser(1.0), line, flaser(3.0)])
    assert recording.n_scans == 2
    assert lines_of(recording, "wrong number of readings") == [2]


@pytest.mark.parametrize(
    "line",
    [
        "FLASER 4 1 2 3,5 4 0 0 0 0 0 0 2.0 host 0.5",
        "FLASER 4 1 2 1_0 4 0 0 0 0 0 0 2.0 host 0.5",
        "FLASER four 1 2 3 4 0 0 0 0 0 0 2.0 host 0.5",
        "FLASER -4 1 2 3 4 0 0 0 0 0 0 2.0 host 0.5",
        "FLASER 4 1 2 3 4 0 x 0 0 0 0 2.0 host 0.5",
        "FLASER 4 1 2 3 4 0 0 0 0 0 0 nan host 0.5",
        "FLASER 4 1 2 3 4 0 0 0 0 0 0 1e99 host 0.5",
        "FLASER 4 1 2 3 4 0 0 0 0 0 0 1e999999999999 host 0.5",
    ],
)
def test_unreadable_number(read_log, flaser, line):
    recording = read_log([flaser(1.0), line, flaser(3.0)])
    assert recording.n_scans == 2
    assert lines_of(recording, "unreadable number") == [2]


@pytest.mark.parametrize("bad", ["nan", "inf", "-inf", "1e300"])
def test_pose_not_finite(read_log, flaser, bad):
    recording = read_log([flaser(1.0), flaser(2.0, pose=(0, bad, 0)), flaser(3.0)])
    assert recording.n_scans == 2
    assert lines_of(recording, "pose not finite") == [2]


def test_stamp_jumping_ahead(read_log, flaser):
    stamps = [1, 2, 3, 900, 4, 5, 5, 6]
    recording = read_log([flaser(stamp) for stamp in stamps])
    assert (recording.stamp_ns // 10**9).tolist() == [1, 2, 3, 4, 5, 5, 6]
    assert lines_of(recording, "time running backwards") == [4]


def test_stamp_jumping_back(read_log, flaser):
    recording = read_log([flaser(stamp) for stamp in [1, 2, 3, 0.5, 4, 5]])
    assert lines_of(recording, "time running backwards") == [4]


def test_cut_last_line_is_skipped(read_log, flaser):
    whole = (flaser(1.0) + "\n").encode()
    last = flaser("2.123456", [1, 2, 3, 4], kind="FLASER").encode()
    for length in range(1, len(last) - len("0.5") + 1):
        recording = read_log(whole + last[:length])
        assert recording.n_scans == 1, last[:length]
        assert lines_of(recording, "cut last line") == [2], last[:length]


def test_complete_last_line_without_line_end(read_log, flaser):
    recording = read_log((flaser(1.0) + "\n" + flaser(2.0)).encode())
    assert recording.n_scans == 2
    assert recording.source["skipped"] == {}


def test_over_long_line(read_log, flaser):
    long = "FLASER 4 " + "1 " * MAX_LINE
    recording = read_log([flaser(1.0), long, flaser(2.0)])
    assert recording.n_scans == 2
    assert lines_of(recording, "over-long line") == [2]


def test_cut_gzip_stream(log, flaser):
    lines = [flaser(i, [i + 0.1 * k for k in range(30)]) for i in range(400)]
    packed = gzip.compress("\n".join(lines).encode())
    recording = read(log(packed[: len(packed) // 2], "cut.log.gz"))
    assert 50 < recording.n_scans < 350
    (line,) = lines_of(recording, "damaged gzip stream")
    assert line == recording.n_scans + 1


def test_gzip_stream_with_a_flipped_checksum(log, flaser):
    packed = bytearray(gzip.compress((flaser(1.0) + "\n").encode()))
    packed[-6] ^= 0xFF
    recording = read(log(bytes(packed), "bad.log.gz"))
    assert recording.n_scans == 1
    assert lines_of(recording, "damaged gzip stream") == [2]


def test_damaged_odometry(read_log, flaser):
    recording = read_log(
        ["ODOM 1 2 nan 0 0 0 1 h 0", "ODOM 1 2", "ODOM 0 0 0 0 0 0 x h 0", flaser(1.0)]
    )
    assert recording.source["skipped"] == {}
    assert recording.source["skipped_odometry"] == {
        "pose not finite": {"count": 1, "lines": [1]},
        "wrong number of fields": {"count": 1, "lines": [2]},
        "unreadable number": {"count": 1, "lines": [3]},
    }


def test_line_numbers_are_kept_up_to_a_thousand(read_log, flaser):
    recording = read_log([flaser(1.0), *["FLASER 3 1 2"] * 1500])
    damage = recording.source["skipped"]["wrong number of readings"]
    assert damage["count"] == 1500
    assert damage["lines"] == list(range(2, 1002))
    assert any("1500 of 1501" in warning for warning in recording.source["warnings"])


def test_log_of_damaged_scans_only(read_log):
    with pytest.raises(InputError, match=r"no usable laser scan: 2 x wrong number .*line 1, 2"):
        read_log(["FLASER 3 1 2", "FLASER 3 1 2"])
