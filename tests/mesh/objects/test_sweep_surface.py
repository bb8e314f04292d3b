"""The surface of what one look saw of a thing."""

import numpy as np
import pytest

from stillmap.mesh.segmentation import ObjectBeams, triangulate_beams


def _beams(hit_at: float, step: float, rows: int = 21) -> tuple[ObjectBeams, ObjectBeams]:
    """A board 0.6 m wide and 1 m high before a wall at 6 m, seen from the origin."""
    angle = (np.arange(rows) - rows // 2) * step
    y, z = (a.ravel() for a in np.meshgrid(np.tan(angle), np.tan(angle)))
    looking = np.stack([np.ones(len(y)), y, z], axis=1)
    on = (np.abs(looking[:, 1] * hit_at) <= 0.3) & (np.abs(looking[:, 2] * hit_at) <= 0.5)
    zero = np.zeros((len(y), 3))
    return ObjectBeams(looking[on] * hit_at, zero[on]), ObjectBeams(looking[~on] * 6.0, zero[~on])


def test_a_board_is_a_surface_that_faces_the_sensor() -> None:
    own, others = _beams(3.0, 0.02)
    mesh = triangulate_beams(own, others, 2.5, 0.6)
    assert len(mesh.vertices) == len(own.points)
    np.testing.assert_allclose(mesh.vertices[:, 0], 3.0, atol=0.01)
    assert (mesh.normals()[:, 0] < -0.9).all()
    width, height = np.ptp(own.points[:, 1]), np.ptp(own.points[:, 2])
    assert mesh.areas().sum() == pytest.approx(width * height, rel=0.05)


def test_there_is_no_surface_where_beams_passed() -> None:
    own, others = _beams(3.0, 0.02)
    hole = np.linalg.norm(own.points[:, 1:], axis=1) < 0.1
    through = ObjectBeams(own.points[hole] * 2.0, own.origin[hole])
    own = ObjectBeams(own.points[~hole], own.origin[~hole])
    both = ObjectBeams(*(np.concatenate([a, b]) for a, b in zip(others, through, strict=True)))
    with_hole = triangulate_beams(own, both, 10.0, 0.6)
    closed = triangulate_beams(own, others, 10.0, 0.6)
    assert np.linalg.norm(with_hole.centers[:, 1:], axis=1).min() > 0.06
    assert np.linalg.norm(closed.centers[:, 1:], axis=1).min() < 0.06


def test_steps_and_few_beams_are_no_surface() -> None:
    own, others = _beams(3.0, 0.02)
    far = own.points[:, 1] > 0.0
    step = own._replace(points=np.where(far[:, None], own.points * 1.5, own.points))
    mesh = triangulate_beams(step, others, 2.5, 0.6)
    depth = mesh.corners[:, :, 0]
    assert (np.ptp(depth, axis=1) < 0.5).all()
    assert (
        len(triangulate_beams(ObjectBeams(own.points[:2], own.origin[:2]), others, 2.5, 0.6)) == 0
    )
    line = ObjectBeams(own.points[:3], own.origin[:3])
    line.points[:] = np.outer([1.0, 1.1, 1.2], [3.0, 0.0, 0.1])
    assert len(triangulate_beams(line, others, 2.5, 0.6)) == 0
