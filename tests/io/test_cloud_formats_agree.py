"""A 3D recording is the same in every format that holds one."""

import numpy as np
import pytest

from stillmap.core.recording import Recording
from stillmap.io import read, writers

FORMS = {"bag": ".bag", "db3": ".db3", "mcap": ".mcap", "ros2": "", "kitti": "", "pcd": ""}


@pytest.fixture
def recording():
    rng = np.random.default_rng(8)
    lengths = [40, 1, 25, 60]
    T_odom_base = np.tile(np.eye(4), (4, 1, 1))
    T_odom_base[:, 0, 3] = np.arange(4.0)
    return Recording(
        stamp_ns=1_600_000_000_000_000_000 + np.arange(4, dtype=np.int64) * 100_000_001,
        offset=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        points=rng.normal(0.0, 9.0, (126, 3)).astype(np.float32),
        hit=np.ones(126, np.bool_),
        T_base_sensor=np.eye(4)[None],
        sensor=np.zeros(4, np.int32),
        T_odom_base=T_odom_base,
    )


SAID = {
    "kitti": ["its odometry is written as poses"],
    "pcd": ["its odometry readings are left out"],
}


@pytest.mark.parametrize("form", FORMS)
def test_scans_come_back(recording, tmp_path, form):
    path = tmp_path / f"form{FORMS[form]}"
    lost = writers.write(recording, path, name=form)
    assert lost == SAID.get(form, [])
    again = read(path)
    np.testing.assert_array_equal(again.stamp_ns, recording.stamp_ns)
    np.testing.assert_array_equal(again.offset, recording.offset)
    np.testing.assert_array_equal(again.points, recording.points)
    np.testing.assert_array_equal(again.hit, recording.hit)
    if form not in ("kitti", "pcd"):
        np.testing.assert_allclose(again.T_odom_base, recording.T_odom_base, atol=1e-9)
    if form == "kitti":  # its poses are those of the recording
        np.testing.assert_allclose(again.T_recorded_base, recording.T_odom_base, atol=1e-9)


@pytest.mark.parametrize("ending", [".ply", ".las", ".laz"])
def test_one_cloud_of_all(recording, tmp_path, ending):
    if ending != ".ply":
        pytest.importorskip("laspy")
        pytest.importorskip("lazrs")
    path = tmp_path / f"cloud{ending}"
    lost = writers.write(recording, path)
    assert lost == ["the cloud is placed by odometry: maps are better"]
    again = read(path)
    expected = recording.end_points(np.arange(126), recording.T_odom_base)
    placed = again.points
    offset = np.median(expected - placed, axis=0)  # what was taken off for precision
    np.testing.assert_allclose(placed + offset, expected, atol=2e-4)
