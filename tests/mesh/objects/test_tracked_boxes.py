"""Things that stand between a camera and what it sees."""

import numpy as np

from stillmap.mesh.inputs import OrientedBox, TrackedBox, boxes_at, is_in_or_behind_box
from stillmap.tracking.boxes import Box


def _walker() -> TrackedBox:
    box = Box(
        0,
        np.array([0.0, 1.0, 2.0]),
        np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]),
        np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]),
        np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]),
        (0.2, 0.3),
        0.5,
    )
    return TrackedBox(box, np.array([0.0, 0.0, 0.2]), 1.8)


def test_a_thing_is_on_its_way_and_a_little_beyond() -> None:
    (half_way,) = boxes_at([_walker()], 0.5)
    np.testing.assert_allclose(half_way.center, [0.5, 0.0, 0.9])
    np.testing.assert_allclose(half_way.half_size, [0.2, 0.3, 0.9])
    (later,) = boxes_at([_walker()], 2.4)
    np.testing.assert_allclose(later.center, [1.0, 1.4, 1.1])
    np.testing.assert_allclose(later.heading, [0.0, 1.0])
    (before,) = boxes_at([_walker()], -0.3)
    np.testing.assert_allclose(before.center, [-0.3, 0.0, 0.9])
    assert boxes_at([_walker()], 2.6) == []
    assert boxes_at([_walker()], -0.6) == []


def _meets_by_sampling(start: np.ndarray, end: np.ndarray, half: np.ndarray) -> bool:
    s = np.linspace(0.0, 1.0, 20001)[:, None]
    return bool((np.abs(start + s * (end - start)) <= half).all(axis=1).any())


def test_what_lies_behind_a_box_or_within_it() -> None:
    box = OrientedBox(np.array([2.0, 0.0, 1.0]), np.array([0.6, 0.8]), np.array([0.5, 0.2, 1.0]))
    rng = np.random.default_rng(3)
    place, points = np.array([0.0, 0.3, 1.2]), rng.uniform([0, -2, 0], [5, 2, 2], (400, 3))
    found = is_in_or_behind_box([box], place, points)
    start, ends = box.local(place[None])[0], box.local(points)
    expected = [_meets_by_sampling(start, end, box.half_size) for end in ends]
    assert 20 < np.sum(expected) < 380
    assert np.mean(found != expected) <= 0.005  # grazed edges
    other = box._replace(center=np.array([2.0, 1.5, 1.0]))
    both = is_in_or_behind_box([box, other], place, points)
    np.testing.assert_array_equal(both, found | is_in_or_behind_box([other], place, points))
    assert not is_in_or_behind_box([], place, points).any()
