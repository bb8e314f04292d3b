from decimal import Decimal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stillmap.core.errors import InputError
from stillmap.core.se2 import matrix
from stillmap.core.timestamps import MAX_STAMP_NS
from stillmap.io.trajectory import read_tum, write_tum

STAMPS = np.array([1, 999_999_999, 1_000_000_000, 1_699_999_999_123_456_789], np.int64)
POSES = matrix([0.0, 1.5, -2.25, 1e3], [0.0, -1.0, 0.5, -1e-12], [0.0, 3.1, -3.1, np.pi])


def test_lines(tmp_path):
    write_tum(tmp_path / "t.tum", STAMPS, POSES)
    lines = (tmp_path / "t.tum").read_text().splitlines()
    assert [line.split()[0] for line in lines] == [
        "0.000000001",
        "0.999999999",
        "1.000000000",
        "1699999999.123456789",
    ]
    zeros = " ".join(["0.000000000"] * 6)
    assert lines[0] == f"0.000000001 {zeros} 1.000000000"
    assert "-0.000000000" not in "".join(lines)
    for line, pose in zip(lines, POSES, strict=True):
        x, y, z, qx, qy, qz, qw = map(float, line.split()[1:])
        assert (z, qx, qy) == (0, 0, 0)
        np.testing.assert_allclose([x, y], pose[:2, 2], atol=1e-9)
        turned = complex(qw, qz) ** 2  # a rotation about z by twice the quaternion's angle
        np.testing.assert_allclose([turned.real, turned.imag], pose[:2, 0], atol=5e-9)


@given(st.lists(st.integers(-MAX_STAMP_NS, MAX_STAMP_NS), min_size=1, max_size=20))
def test_stamps_survive_exactly(tmp_path_factory, stamps):
    path = tmp_path_factory.mktemp("tum") / "t.tum"
    write_tum(path, np.array(stamps, np.int64), matrix(0 * np.ones(len(stamps)), 0.0, 0.0))
    for line, stamp in zip(path.read_text().splitlines(), stamps, strict=True):
        assert Decimal(line.split()[0]) * 10**9 == stamp
    np.testing.assert_array_equal(read_tum(path)[0], stamps)


def test_poses_in_space_survive(tmp_path):
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, :3, :3] = Rotation.random(50, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(0, 100, (50, 3))
    stamps = np.arange(50, dtype=np.int64)
    write_tum(tmp_path / "t.tum", stamps, poses)
    read_stamps, read_poses = read_tum(tmp_path / "t.tum")
    np.testing.assert_array_equal(read_stamps, stamps)
    np.testing.assert_allclose(read_poses, poses, atol=1e-8)


def test_reads_what_others_write(tmp_path):
    path = tmp_path / "t.tum"
    path.write_text(
        "# stamp x y z qx qy qz qw\n\n"
        "1.305031102175304174e+09 1.0e+00 2 3 0 0 0.7071 0.7071\n"
        "5 1 2 3 0 0 0 -1\r\n"
        "1699999999.1234567894 0 0 0 0 0 0 1\n"
    )
    stamps, poses = read_tum(path)
    assert stamps.tolist() == [1_305_031_102_175_304_174, 5_000_000_000, 1_699_999_999_123_456_789]
    np.testing.assert_allclose(poses[0, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_array_equal(
        poses[1], [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    )


@pytest.mark.parametrize(
    "line",
    [
        "1 2 3",
        "1 0 0 0 0 0 0 1 9",
        "one 0 0 0 0 0 0 1",
        "1 0 x 0 0 0 0 1",
        "1 0 nan 0 0 0 0 1",
        "snan 0 0 0 0 0 0 1",
        "1e300 0 0 0 0 0 0 1",
        "1e999999999 0 0 0 0 0 0 1",
        "1 0 0 0 0 0 0 0",
        "1 0 0 0 1 1 0 0",
    ],
)
def test_a_bad_line_is_named(tmp_path, line):
    path = tmp_path / "t.tum"
    path.write_text(f"1 0 0 0 0 0 0 1\n# remark\n{line}\n")
    with pytest.raises(InputError, match="is no pose") as error:
        read_tum(path)
    assert error.value.where == f"{path}:3"


def test_files_that_hold_no_trajectory(tmp_path):
    (tmp_path / "empty.tum").write_text("# nothing\n")
    (tmp_path / "binary.tum").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="no poses"):
        read_tum(tmp_path / "empty.tum")
    with pytest.raises(InputError, match="not a text file"):
        read_tum(tmp_path / "binary.tum")
    with pytest.raises(InputError, match="cannot be read"):
        read_tum(tmp_path / "absent.tum")
    with pytest.raises(ValueError, match=r"poses: expected [0-9]+, got 2"):
        write_tum(tmp_path / "t.tum", STAMPS, POSES[:2])
