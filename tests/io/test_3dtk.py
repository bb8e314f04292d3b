"""3DTK: centimetres and left hands."""

import gzip

import numpy as np
import pytest
from scipy.spatial import cKDTree

from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.prepare.options import ReadOptions


def write(folder, number, text, pose="0 0 0\n0 0 0\n"):
    (folder / f"scan{number:03d}.3d").write_text(text)
    if pose is not None:
        (folder / f"scan{number:03d}.pose").write_text(pose)


def test_axes_and_units(tmp_path):
    write(tmp_path, 0, "100 0 0\n0 200 0\n0 0 300\n")  # right, up, ahead
    write(tmp_path, 1, "0 0 100 17\n", "100 20 300\n0 90 0\n")
    found = read(tmp_path)
    np.testing.assert_allclose(found.points, [[0, -1, 0], [0, 0, 2], [3, 0, 0], [1, 0, 0]])
    T = found.T_recorded_base
    np.testing.assert_array_equal(T[0], np.eye(4))
    np.testing.assert_allclose(T[1, :3, 3], [3, -1, 0.2])
    # about the axis up, with the left hand: ahead turns to the right
    np.testing.assert_allclose(T[1, :3, :3] @ [1, 0, 0], [0, -1, 0], atol=1e-12)
    assert np.linalg.det(T[1]) == pytest.approx(1.0)
    assert found.stamp_ns.tolist() == [0, 10**9]
    assert any("one second apart" in warning for warning in found.source.warnings)


@pytest.mark.parametrize("heading", ["# x y z\n", "2 1\n", "\n", ""])
def test_headings_packed_or_not(tmp_path, heading):
    text = f"{heading}100 0 0\n\n200 0 0"
    (tmp_path / "a.3d.gz").write_bytes(gzip.compress(text.encode()))
    (tmp_path / "b.3d").write_text(text)
    found = read(tmp_path)
    np.testing.assert_array_equal(np.diff(found.offset), [2, 2])
    assert read(tmp_path / "a.3d.gz").n_beams == 2


@pytest.mark.parametrize("pose", [None, "", "1 2 3\n", "1 2 3\n4 5 x\n", "nan 0 0 0 0 0"])
def test_a_pose_that_is_missing_costs_the_poses(tmp_path, pose):
    write(tmp_path, 0, "1 2 3\n", "1 1 1 0 0 0")
    write(tmp_path, 1, "1 2 3\n", pose)
    found = read(tmp_path)
    assert found.n_scans == 2
    assert found.T_recorded_base is None
    assert any("1 scans have no pose" in warning for warning in found.source.warnings)


def test_damage(tmp_path):
    write(tmp_path, 0, "1 2 3\n")
    write(tmp_path, 1, "1 2 3\n1 2\n")
    write(tmp_path, 2, "1 2 3\n1 2 x\n")
    write(tmp_path, 3, "")
    packed = gzip.compress(b"1 2 3\n" * 1000, mtime=0)
    (tmp_path / "scan004.3d.gz").write_bytes(packed[:-9])
    write(tmp_path, 5, "3\n1 2 3\n1 2 3\n")
    (tmp_path / "scan006.3d.gz").write_bytes(gzip.compress(b"1" * 3_000_000))
    found = read(tmp_path)
    assert found.n_scans == 1
    skipped = {reason: damage.lines for reason, damage in found.source.skipped.items()}
    assert skipped == {"is damaged": [2, 3, 5, 7], "is empty": [4], "is truncated": [6]}
    with pytest.raises(InputError, match=r"scan002\.3d: is damaged.*x"):
        read(tmp_path / "scan002.3d")


def test_codes_for_nothing_are_no_walls(tmp_path):
    far = "".join(f"0 0 {value}\n" for value in (3276.3, 3276.5, 3276.7) * 10)
    near = "".join(f"0 0 {100 + i}\n" for i in range(50))
    write(tmp_path, 0, near + far)
    found = read(tmp_path)
    assert found.hit.sum() == 50
    assert any("code" in warning for warning in found.source.warnings)
    assert read(tmp_path, ReadOptions(max_range=100.0)).hit.all()
    write(tmp_path, 0, near + "0 0 3276.7\n" * 3)
    assert read(tmp_path).hit.all()


def test_scans_of_a_tilting_laser_overlap_where_their_poses_put_them(shared_data):
    found = read(shared_data / "tilting")
    assert found.n_scans == 3
    points = [found.points[found.beams_of(i)].astype(float) for i in range(3)]
    points = [p[np.linalg.norm(p, axis=1) < 15.0] for p in points]

    def near(a, b, T):
        """Share of the points of scan a that have one of scan b within 10 cm."""
        relative = np.linalg.inv(T[b]) @ T[a]
        moved = points[a] @ relative[:3, :3].T + relative[:3, 3]
        return np.mean(cKDTree(points[b]).query(moved[::40])[0] < 0.1)

    T = found.T_recorded_base
    turned, left = T.copy(), T.copy()
    turned[:, :3, :3] = T[:, :3, :3].transpose(0, 2, 1)
    left[:, :3, 3] *= -1.0
    for a, b in ((1, 0), (2, 1)):
        assert near(a, b, T) > 0.75
        assert near(a, b, T) > near(a, b, np.stack([np.eye(4)] * 3)) + 0.1
        assert near(a, b, T) > near(a, b, turned) + 0.02  # they hardly turn
        assert near(a, b, T) > near(a, b, left) + 0.5
