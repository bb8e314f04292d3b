import gzip

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.timestamps import parse_ns
from stillmap.io.trajectory import write_tum
from stillmap.results.eval.readers import (
    read_odometry,
    read_planar_trajectory,
    read_relations,
    read_trajectory,
    to_seconds,
)

ODOM = "ODOM {x} 0 0 0 0 0 {t} host 0.1\n"
FLASER = "FLASER 3 1.0 1.0 1.0 9 9 9 {x} 0 0 {t} host 0.1\n"


def test_rows_in_the_plane_and_tum_rows_read_alike(tmp_path):
    rows = np.array([[3.5, 1, 2, -3], [1.25, -4, 0, 0.5]])
    np.savetxt(tmp_path / "rows.txt", rows, header="t x y theta")
    stamps = (rows[:, 0] * 1e9).astype(np.int64)
    write_tum(tmp_path / "rows.tum", stamps, se2.matrix(*rows[:, 1:].T))
    wanted = rows[::-1]  # sorted by time
    np.testing.assert_allclose(read_planar_trajectory(tmp_path / "rows.txt"), wanted, atol=1e-12)
    np.testing.assert_allclose(read_planar_trajectory(tmp_path / "rows.tum"), wanted, atol=1e-8)
    in_space = read_trajectory(tmp_path / "rows.txt").poses
    np.testing.assert_allclose(in_space, read_trajectory(tmp_path / "rows.tum").poses, atol=1e-8)


def test_seconds_are_those_of_the_text():
    text = [f"976052{n:03d}.{n:06d}" for n in range(100, 1000, 7)] + ["1700000000.123456789"]
    stamps = np.array([parse_ns(t) for t in text], np.int64)
    assert (stamps / 1e9).tolist() != [float(t) for t in text]  # what the exactness is for
    assert to_seconds(stamps).tolist() == [float(t) for t in text]


@pytest.mark.parametrize(
    ("text", "place", "what"),
    [
        ("", "", "no rows"),
        ("# only words\n\n", "", "no rows"),
        ("0 1 2 3\n1 2 3\n", ":2", "4 finite"),
        ("0 1 2 3\n\n# x\n1 2 three 4\n", ":4", "4 finite"),
        ("0 1 2 3\n1 nan 2 3\n", ":2", "4 finite"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 1\n", ":2", "is no pose"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 nan\n", ":2", "is no pose"),
        ("1 2\n", ":1", "is no pose"),
    ],
)
def test_bad_trajectories_name_the_line(tmp_path, text, place, what):
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=what) as caught:
        read_trajectory(path)
    assert caught.value.where == f"{path}{place}"


def test_files_that_are_no_text(tmp_path):
    path = tmp_path / "bytes"
    path.write_bytes(b"1 2 3 4\n\xff\xfe\x00\n")
    for read in (read_trajectory, read_relations):
        with pytest.raises(InputError, match="not a text file"):
            read(path)
    for read in (read_trajectory, read_relations, read_odometry):
        with pytest.raises(InputError, match="cannot be read"):
            read(tmp_path / "absent")
        with pytest.raises(InputError, match="cannot be read"):
            read(tmp_path)


def test_relations_have_eight_columns(tmp_path):
    path = tmp_path / "r"
    path.write_text("0 1 2 3 4 5 6 7  # kept\n0 1 2 3\n")
    with pytest.raises(InputError, match="no row of 8") as caught:
        read_relations(path)
    assert caught.value.where == f"{path}:2"


@pytest.mark.parametrize("packed", [False, True])
def test_odometry_of_a_log_is_its_odom_lines(tmp_path, packed):
    text = "# a log\nPARAM robot_width 0.5\n" + ODOM.format(x=2, t=20.5) + FLASER.format(x=7, t=3)
    text += ODOM.format(x=1, t=10.25)
    path = tmp_path / "log"
    path.write_bytes(gzip.compress(text.encode()) if packed else text.encode())
    np.testing.assert_array_equal(read_odometry(path), [[10.25, 1, 0, 0], [20.5, 2, 0, 0]])


def test_odometry_of_a_log_without_odom_lines_is_its_robot_poses(tmp_path):
    path = tmp_path / "log"
    path.write_text(FLASER.format(x=7, t=3) + FLASER.format(x=8, t=4))
    np.testing.assert_array_equal(read_odometry(path), [[3, 7, 0, 0], [4, 8, 0, 0]])


def test_odometry_passes_over_damaged_lines_and_says_so(tmp_path, caplog):
    path = tmp_path / "log"
    path.write_text(ODOM.format(x=1, t=1) + ODOM.format(x="broken", t=2) + ODOM.format(x=3, t=3))
    assert read_odometry(path)[:, 0].tolist() == [1, 3]
    assert "odometry skipped: 1" in caplog.text


def test_a_log_without_odometry_is_refused(tmp_path):
    path = tmp_path / "log"
    path.write_text("PARAM robot_width 0.5\n")
    with pytest.raises(InputError, match="no odometry"):
        read_odometry(path)
