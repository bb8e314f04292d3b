"""A moving thing's own frame."""

import numpy as np

from stillmap.mesh.tracked_boxes import ObjectFrame, TrackedBox
from stillmap.tracking.boxes import Box


def _way() -> ObjectFrame:
    box = Box(
        3,
        np.array([0.0, 1.0, 2.0]),
        np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]]),
        np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]),
        np.array([[2.0, 0.0], [2.0, 0.0], [0.0, 2.0]]),
        (1.0, 0.5),
        0.5,
    )
    thing = TrackedBox(box, np.array([0.0, 0.1, 0.3]), 1.5)
    return ObjectFrame(thing, np.array([0.0, 2.0]), np.array([[0.0, 0.0, 0.0], [0.2, -0.4, 0.1]]))


def test_points_go_there_and_back() -> None:
    way, rng = _way(), np.random.default_rng(0)
    points = rng.normal(size=(20, 3))
    for seconds in (-0.2, 0.5, 1.0, 1.7, 2.3):
        T = way.T_map_object(seconds)
        local = way.to_object(np.full(20, seconds), points)
        np.testing.assert_allclose(local @ T[:3, :3].T + T[:3, 3], points, atol=1e-9)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)


def test_offsets_are_those_of_the_frame() -> None:
    way = _way()
    straight = ObjectFrame.from_track(way.box).to_object(
        np.array([2.0]), np.array([[2.0, 3.0, 0.3]])
    )
    np.testing.assert_allclose(straight, [[1.0, 0.0, 0.0]], atol=1e-12)
    turned = way.to_object(np.array([2.0]), np.array([[2.0, 3.0, 0.3]]))
    np.testing.assert_allclose(turned, [[np.cos(0.1) + 0.2, np.sin(0.1) - 0.4, 0.0]], atol=1e-12)
