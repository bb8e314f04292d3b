"""The pose graph as others read it: a parser of its own, and GTSAM."""

import dataclasses
from collections import defaultdict

import numpy as np
import pytest

from stillmap.core import se2, se3
from stillmap.core.errors import InputError
from stillmap.results.pose_graph_g2o import read_g2o, write_g2o
from stillmap.slam.pose_graph import Constraint, PoseGraph, optimize_poses, squared_mahalanobis

gtsam = pytest.importorskip("gtsam")


def way(scans, rng):
    """A winding way through these scans with loops, noisily measured; covariances of any shape."""
    K = len(scans)
    poses = se2.matrix(*np.cumsum(rng.normal([1, 0.2, 0.4], [0.3, 0.3, 0.5], (K, 3)), axis=0).T)
    pairs = [(k, k + 1) for k in range(K - 1)] + [(0, K - 1), (2, K - 2), (1, K // 2)]
    constraints = []
    for i, j in pairs:
        root = rng.normal(size=(3, 3)) * [0.05, 0.02, 0.03]
        covariance = root @ root.T + 1e-5 * np.eye(3)
        noise = se2.matrix(*rng.multivariate_normal(np.zeros(3), covariance))
        constraints.append(Constraint(i, j, se2.inverse(poses[i]) @ poses[j] @ noise, covariance))
    found = optimize_poses(poses, constraints[: K - 1], constraints[K - 1 :], None)
    return PoseGraph(np.array(scans), found, constraints)


@pytest.fixture
def graph():
    return way([0, 3, 4, 9, 12, 20, 21, 35, 36, 40], np.random.default_rng(3))


def all_poses(graph, rng=None, spread=0.0):
    """Poses of all scans, those of keyframes as the graph has them, or moved about."""
    T = np.tile(se2.matrix(7.0, 7.0, 7.0), (graph.keyframes[-1] + 5, 1, 1))
    T[graph.keyframes] = graph.poses
    if rng is not None:
        moves = rng.normal(scale=spread, size=(len(graph.keyframes), 3))
        moves[0] = 0
        T[graph.keyframes] = graph.poses @ se2.matrix(*moves.T)
    return T


def parsed(path):
    """Lines by their first word, the rest as numbers."""
    rows = defaultdict(list)
    for line in path.read_text(encoding="ascii").splitlines():
        tag, *numbers = line.split()
        rows[tag].append([float(number) for number in numbers])
    return rows


def test_what_is_written(tmp_path, graph):
    write_g2o(tmp_path / "graph.g2o", graph, all_poses(graph))
    rows = parsed(tmp_path / "graph.g2o")
    assert set(rows) == {"VERTEX_SE2", "FIX", "EDGE_SE2"}
    assert [row[0] for row in rows["VERTEX_SE2"]] == graph.keyframes.tolist()
    vertices = np.array(rows["VERTEX_SE2"])[:, 1:]
    np.testing.assert_array_equal(vertices, se2.parameters(graph.poses))
    assert rows["FIX"] == [[0.0]]
    for row, constraint in zip(rows["EDGE_SE2"], graph.constraints, strict=True):
        assert row[:2] == [graph.keyframes[constraint.first], graph.keyframes[constraint.second]]
        np.testing.assert_array_equal(row[2:5], se2.parameters(constraint.T))
        information = np.linalg.inv(constraint.covariance)
        expected = [information[a, b] for a in range(3) for b in range(a, 3)]
        np.testing.assert_allclose(row[5:], expected, rtol=1e-9)


def test_gtsam_reads_our_errors(tmp_path, graph):
    # small ones: those of GTSAM go along the curve of a turn
    exact = [
        dataclasses.replace(r, T=se2.inverse(graph.poses[r.first]) @ graph.poses[r.second])
        for r in graph.constraints
    ]
    graph = dataclasses.replace(graph, constraints=exact)
    poses = all_poses(graph, np.random.default_rng(1), 1e-4)
    write_g2o(tmp_path / "graph.g2o", graph, poses)
    factors, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), False)
    assert factors.size() == len(graph.constraints)
    errors = [2.0 * factors.at(k).error(values) for k in range(factors.size())]
    expected = squared_mahalanobis(poses[graph.keyframes], graph.constraints)
    np.testing.assert_allclose(errors, expected, rtol=1e-2)


def test_one_scan_is_a_graph_without_edges(tmp_path):
    alone = PoseGraph(np.array([0]), np.eye(3)[None], [])
    write_g2o(tmp_path / "graph.g2o", alone, alone.poses)
    assert (tmp_path / "graph.g2o").read_text() == "VERTEX_SE2 0 0.0 0.0 0.0\nFIX 0\n"


def way_3d(rng):
    """Six poses in space with a loop."""
    poses = se3.exp(np.cumsum(rng.normal([1, 0, 0, 0, 0, 0.2], 0.1, (6, 6)), axis=0))
    constraints = []
    for i, j in [*((k, k + 1) for k in range(5)), (0, 5)]:
        root = rng.normal(size=(6, 6)) * 0.02
        T = se2.inverse(poses[i]) @ poses[j] @ se3.exp(rng.normal(size=6) * 0.01)
        constraints.append(Constraint(i, j, T, root @ root.T + 1e-4 * np.eye(6)))
    return PoseGraph(np.array([0, 2, 5, 6, 7, 9]), poses, constraints)


def assert_same(found, graph):
    np.testing.assert_array_equal(found.keyframes, graph.keyframes)
    np.testing.assert_allclose(found.poses, graph.poses, atol=1e-12)
    for one, other in zip(found.constraints, graph.constraints, strict=True):
        assert (one.first, one.second) == (other.first, other.second)
        np.testing.assert_allclose(one.T, other.T, atol=1e-12)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-7)


def test_what_is_written_is_read_again(tmp_path, graph):
    write_g2o(tmp_path / "graph.g2o", graph, all_poses(graph))
    assert_same(read_g2o(tmp_path / "graph.g2o"), graph)


def test_a_graph_in_3d_is_read_again_by_us_and_by_gtsam(tmp_path):
    graph = way_3d(np.random.default_rng(5))
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[graph.keyframes] = graph.poses
    write_g2o(tmp_path / "graph.g2o", graph, poses)
    assert_same(read_g2o(tmp_path / "graph.g2o"), graph)
    factors, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    for scan, pose in zip(graph.keyframes.tolist(), graph.poses, strict=True):
        np.testing.assert_allclose(values.atPose3(scan).matrix(), pose, atol=1e-9)
    error = sum(factors.at(k).error(values) for k in range(len(graph.constraints)))
    expected = 0.5 * squared_mahalanobis(graph.poses, graph.constraints).sum()
    np.testing.assert_allclose(error, expected, rtol=0.05)  # of second order in small rotations


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("VERTEX_SE2 x 0 0 0", "line 12"),
        ("VERTEX_SE2 99 0 nan 0", "line 12"),
        ("EDGE_SE2 0 77 1 0 0 1 0 0 1 0 1", "has no vertex"),
        ("EDGE_SE2 0 3 1 0 0 1 0 0 -1 0 1", "positive definite"),
        ("EDGE_SE3:QUAT 0 3 1", "expected 9 finite"),
    ],
)
def test_damage_is_named(tmp_path, graph, line, words):
    path = tmp_path / "graph.g2o"
    write_g2o(path, graph, all_poses(graph))
    lines = path.read_text().splitlines()
    lines.insert(11 if line.startswith("VERTEX") else len(lines), line)
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=words):
        read_g2o(path)
