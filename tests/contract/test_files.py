"""Files of a result, and recordings as clouds, read by other programs."""

import json
import re

import numpy as np
import pytest
from report_page import Page

from stillmap.cli.main import main
from stillmap.io import trajectory as given_poses
from stillmap.io.trajectory import read_tum


def planar(T):
    return T[:, [0, 1, 3]][:, :, [0, 1, 3]]


@pytest.fixture(scope="module")
def stamps_and_poses(result, recording):
    """The trajectory as stillmap reads it."""
    path = result / "trajectory.tum"
    return recording.stamp_ns, given_poses.poses_from_tum(path, recording)


def test_evo_reads_the_trajectory(result, stamps_and_poses, tmp_path, monkeypatch):
    import warnings

    monkeypatch.setenv("HOME", str(tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file_interface = pytest.importorskip("evo.tools.file_interface")
    found = file_interface.read_tum_trajectory_file(str(result / "trajectory.tum"))
    stamp_ns, T = stamps_and_poses
    valid, why = found.check()
    assert valid, why
    np.testing.assert_allclose(found.timestamps, stamp_ns / 1e9, rtol=1e-15)
    np.testing.assert_allclose(planar(np.array(found.poses_se3)), T, atol=1e-8)


def test_gtsam_optimum_is_near_the_trajectory(result, stamps_and_poses):
    gtsam = pytest.importorskip("gtsam")
    factors, values = gtsam.readG2o(str(result / "graph.g2o"), False)
    lines = (result / "graph.g2o").read_text().splitlines()
    ids = [int(line.split()[1]) for line in lines if line.startswith("VERTEX_SE2")]
    edges = sum(line.startswith("EDGE_SE2") for line in lines)
    assert (values.size(), factors.size()) == (len(ids), edges)
    assert edges >= len(ids) - 1 > 10

    def poses(of):
        found = [of.atPose2(k) for k in ids]
        return np.array([[pose.x(), pose.y(), pose.theta()] for pose in found])

    _, T = stamps_and_poses
    np.testing.assert_allclose(poses(values)[:, :2], T[ids, :2, 2], atol=1e-8)
    held = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    factors.add(gtsam.PriorFactorPose2(ids[0], values.atPose2(ids[0]), held))
    optimum = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    # every scan was registered once more after the graph was solved
    moved = np.abs(poses(optimum) - poses(values))
    assert np.median(moved[:, :2]) < 0.01
    assert moved[:, :2].max() < 0.05


def test_trimesh_reads_object_points(result):
    trimesh = pytest.importorskip("trimesh")
    objects = json.loads((result / "objects/objects.json").read_text())
    assert objects
    for one in objects:
        cloud = trimesh.load(result / f"objects/{one['id']:04d}.ply")
        assert cloud.vertices.shape == (one["beams"], 3)
        assert np.all(cloud.vertices[:, 2] == 0)
        # around its way, as near as it is large
        way = np.array([one["track"]["x"], one["track"]["y"]]).T
        apart = np.linalg.norm(cloud.vertices[:, None, :2] - way, axis=-1).min(axis=1)
        assert np.median(apart) < 0.5
        extra = cloud.metadata["_ply_raw"]["vertex"]["data"]
        assert set(extra.dtype.names) >= {"seconds", "p_dynamic"}
        np.testing.assert_allclose(extra["p_dynamic"].mean(), one["p_dynamic"], atol=1e-5)


def test_report_is_complete_and_fetches_nothing(result):
    text = (result / "report.html").read_text(encoding="utf-8")
    page = Page(text)  # every element that opens closes
    names = ("src", "href", "srcset", "data", "action", "poster", "xlink:href")
    fetched, links = [], []
    for tag, attributes in page.tags:
        assert tag not in ("iframe", "object", "embed")
        addresses = [attributes[name] for name in names if name in attributes]
        (links if tag == "a" else fetched).extend(addresses)
    assert fetched
    assert all(one.startswith(("data:image/png;base64,", "#")) for one in fetched)
    assert links
    assert [link for link in links if not (result / link).is_file()] == []
    assert re.findall(r"url\((?!#)", text) == []
    assert "@import" not in text


def test_numpy_maps_the_labels(result, recording):
    p_static, hit = (np.load(result / f"beams/{n}.npy", mmap_mode="r") for n in ("p_static", "hit"))
    assert isinstance(p_static, np.memmap)
    np.testing.assert_array_equal(hit, recording.hit)
    stamp_ns, _ = read_tum(result / "trajectory.tum")
    np.testing.assert_array_equal(np.load(result / "beams/stamp_ns.npy"), stamp_ns)


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_laspy_reads_the_cloud(recorded, recording, tmp_path, ending):
    laspy = pytest.importorskip("laspy")
    path = tmp_path / f"cloud.{ending}"
    assert main(["convert", str(recorded), "-o", str(path), "--quiet"]) == 0
    found = laspy.read(path)
    hits = np.flatnonzero(recording.hit)
    assert len(found) == found.header.point_count == len(hits)
    placed = recording.end_points(hits, recording.T_odom_base)
    np.testing.assert_allclose(np.array(found.xyz)[:, :2], placed, atol=1e-4)
    assert not np.any(found.z)
    np.testing.assert_allclose(found.header.mins[:2], placed.min(axis=0), atol=1e-4)
    np.testing.assert_allclose(found.header.maxs[:2], placed.max(axis=0), atol=1e-4)
