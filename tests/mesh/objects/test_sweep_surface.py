"""The surface of what one look saw of a thing."""

import numpy as np
import pytest

from stillmap.mesh.partial_scans import PartialScan, triangulate_partial_scan


def _scan(hit_at: float = 3.0, step: float = 0.02, rows: int = 21) -> PartialScan:
    """A board 0.6 m wide and 1 m high before a wall at 6 m, seen from the origin."""
    angle = (np.arange(rows) - rows // 2) * step
    y, z = (a.ravel() for a in np.meshgrid(np.tan(angle), np.tan(angle)))
    looking = np.stack([np.ones(len(y)), y, z], axis=1)
    on = (np.abs(looking[:, 1] * hit_at) <= 0.3) & (np.abs(looking[:, 2] * hit_at) <= 0.5)
    points = looking * np.where(on, hit_at, 6.0)[:, None]
    return PartialScan(points, np.zeros_like(points), on, (0.0, 0.0))


def test_a_board_is_a_surface_that_faces_the_sensor() -> None:
    scan = _scan()
    mesh, board = triangulate_partial_scan(scan, False, 0.0), scan.points[scan.own]
    assert len(mesh.vertices) == len(board)
    np.testing.assert_allclose(mesh.vertices[:, 0], 3.0, atol=0.01)
    assert (mesh.normals()[:, 0] < -0.9).all()
    width, height = np.ptp(board[:, 1]), np.ptp(board[:, 2])
    assert mesh.areas().sum() == pytest.approx(width * height, rel=0.05)


def test_there_is_no_surface_where_beams_passed() -> None:
    scan = _scan()
    hole = scan.own & (np.linalg.norm(scan.points[:, 1:], axis=1) < 0.05)
    assert hole.sum() == 1
    points = np.where(hole[:, None], 2.0 * scan.points, scan.points)
    passed = triangulate_partial_scan(scan._replace(points=points, own=scan.own & ~hole), False, 0)
    known = PartialScan(*(part[~hole] for part in scan[:3]), scan.span)
    closed = triangulate_partial_scan(known, False, 0.0)
    assert np.linalg.norm(passed.centers[:, 1:], axis=1).min() > 0.05
    assert np.linalg.norm(closed.centers[:, 1:], axis=1).min() < 0.05


def test_steps_and_few_beams_are_no_surface() -> None:
    scan = _scan()
    far = scan.own & (scan.points[:, 1] > 0.0)
    step = scan._replace(points=np.where(far[:, None], scan.points * 1.5, scan.points))
    depth = triangulate_partial_scan(step, False, 0.0).corners[:, :, 0]
    assert len(depth)
    assert (np.ptp(depth, axis=1) < 0.5).all()
    few = np.flatnonzero(scan.own)[:3]
    straight = np.outer([1.0, 1.1, 1.2], [3.0, 0.0, 0.1])
    line = PartialScan(straight, np.zeros((3, 3)), np.ones(3, bool), (0.0, 0.0))
    two = PartialScan(scan.points[few[:2]], np.zeros((2, 3)), np.ones(2, bool), (0.0, 0.0))
    for scan in (line, two):
        assert len(triangulate_partial_scan(scan, False, 0.0)) == 0
