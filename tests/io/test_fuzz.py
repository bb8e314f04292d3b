"""Reading any log gives a valid recording or an InputError."""

import gzip
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillmap.cli.recording_info import summarize_recording
from stillmap.core.errors import InputError
from stillmap.io import read

NUMBER = st.one_of(
    st.integers(-3, 400).map(str),
    st.floats(allow_nan=True, allow_infinity=True).map(repr),
    st.sampled_from(["nan", "inf", "-inf", "1e999", "+1", "1_0", "", "x", "1e-400", "81.83", "0"]),
)
KIND = st.sampled_from(
    ["FLASER", "RLASER", "RAWLASER1", "RAWLASER2", "ROBOTLASER1", "ODOM", "PARAM", "#", "SYNC"]
)
PARAM = st.sampled_from(
    ["robot_frontlaser_offset", "robot_front_laser_max", "robot_frontlaser_id", "other"]
)


@st.composite
def nearly_a_line(draw):
    """A line of the grammar with up to two fields replaced, added or deleted."""
    kind = draw(KIND)
    n = draw(st.integers(1, 4))
    ranges = draw(st.lists(NUMBER, min_size=n, max_size=n))
    header = ["0", "-1.5", "3.0", "0.5", "20", "0.01", "0"]
    stamp = [str(draw(st.integers(0, 9))), "host", "0.1"]
    fields = {
        "FLASER": [str(n), *ranges, *"000000", *stamp],
        "RLASER": [str(n), *ranges, *"100000", *stamp],
        "ODOM": [*"123000", *stamp],
        "PARAM": [draw(PARAM), draw(NUMBER)],
        "ROBOTLASER1": [*header, str(n), *ranges, "0", *"12312300000", *stamp],
    }.get(kind, [*header, str(n), *ranges, "0", *stamp])
    for _ in range(draw(st.integers(0, 2))):
        at = draw(st.integers(0, len(fields) - 1))
        fields[at : at + draw(st.integers(0, 1))] = draw(st.lists(NUMBER, max_size=2))
        fields = fields or ["0"]
    return " ".join([kind, *fields]).encode()


LINE = st.one_of(nearly_a_line(), nearly_a_line(), st.binary(max_size=40))


def require_valid(content):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fuzz.log"
        path.write_bytes(content)
        try:
            recording = read(path)
        except InputError:
            return
    assert recording.n_scans > 0
    assert np.all(np.diff(recording.stamp_ns) >= 0)
    assert np.isfinite(recording.points[recording.hit]).all()
    assert not np.isinf(recording.points).any()
    assert np.isfinite(recording.T_base_sensor).all()
    assert recording.T_odom_base is None or np.isfinite(recording.T_odom_base).all()
    assert summarize_recording(recording)["scans"] == recording.n_scans


@settings(max_examples=300, deadline=None)
@given(st.lists(LINE, max_size=8), st.sampled_from([b"\n", b"\r\n"]), st.booleans())
def test_random_lines(lines, end, ended):
    require_valid(end.join(lines) + (end if ended else b""))


@settings(max_examples=100, deadline=None)
@given(st.lists(nearly_a_line(), max_size=5), st.data())
def test_damaged_gzip(lines, data):
    packed = bytearray(gzip.compress(b"\n".join(lines) + os.linesep.encode()))
    at = data.draw(st.integers(0, len(packed) - 1))
    if data.draw(st.booleans()):
        del packed[at:]
    else:
        packed[at] = data.draw(st.integers(0, 255))
    require_valid(bytes(packed))


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=300))
def test_random_bytes(content):
    require_valid(content)


def mutated(log, rng):
    """A log with bytes changed, and pieces deleted, repeated or moved."""
    log = bytearray(log)
    for _ in range(rng.integers(1, 9)):
        at, to = (int(i) for i in rng.integers(0, len(log), 2))
        piece = log[at : at + int(2 ** rng.uniform(0, 10))]
        change = rng.integers(5)
        if change == 0:
            log[at] = rng.integers(256)
        elif change == 1:
            log[at] = rng.choice(list(b"0123456789.-+eE \n\t"))
        elif change == 2 and len(piece) < len(log):
            del log[at : at + len(piece)]
        elif change == 3:
            log[to:to] = piece
        else:
            log[to : to + len(piece)] = piece
    return bytes(log)


@pytest.fixture(scope="module")
def healthy_log():
    """Interleaved messages of every kind."""
    rng = np.random.default_rng(1)
    lines = ["PARAM robot_frontlaser_offset 0.1", "PARAM robot_front_laser_max 20.0"]
    for t in range(12):
        ranges = " ".join(f"{r:.2f}" for r in rng.uniform(0.5, 20.0, 9))
        header = "0 -1.570796 3.141593 0.3926991 20.0 0.01 0"
        pose, stamp = f"{t / 10:.3f} 0.0 0.01", f"{t / 5:.6f} host {t / 5:.6f}"
        lines += [
            f"ODOM {pose} 0 0 0 {stamp}",
            f"FLASER 9 {ranges} {pose} {pose} {stamp}",
            f"RAWLASER2 {header} 9 {ranges} 0 {stamp}",
            f"ROBOTLASER1 {header} 9 {ranges} 0 {pose} {pose} 0 0 0 0 0 {stamp}",
        ]
    return "".join(f"{line}\n" for line in lines).encode()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_mutations_of_a_recording(healthy_log, seed):
    require_valid(healthy_log)
    rng = np.random.default_rng(seed)
    for _ in range(1000):
        require_valid(mutated(healthy_log, rng))
