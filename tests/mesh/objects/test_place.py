"""How probably a picture shows what stands still: by beams, and by what is followed."""

import numpy as np
import pytest
from made_up_rooms import looking, rectangle
from recordings import of_one_sensor

from stillmap.mesh.inputs import MeshInputs, TrackedBox
from stillmap.mesh.place import _P_UNOBSERVED, p_unoccluded
from stillmap.mesh.view_selection import MIN_P_VISIBLE
from stillmap.tracking.boxes import Box

# 4 m ahead of a camera at the origin; faces of 0.2 m
WALL = rectangle([-1.0, 4.0, -1.0], [2.0, 0, 0], [0, 0, 2.0], 10)
VIEW = looking([0.0, 0, 0], [0.0, 1, 0])


def beams(ends, p, beside=0.3):
    """One scan from a laser to the left of the camera."""
    points = np.add(ends, [beside, 0.0, 0.0])
    recording = of_one_sensor(
        np.zeros(1, np.int64),
        np.array([0, len(points)]),
        points.astype(np.float32),
        np.ones(len(points), np.bool_),
    )
    T = np.eye(4)[None].copy()
    T[0, 0, 3] = -beside
    return recording, T, np.asarray(p, np.float32)


def person(x, y):
    seconds = np.array([0.0, 1.0])
    still, ahead = np.tile([x, y], (2, 1)), np.tile([1.0, 0.0], (2, 1))
    box = Box(3, seconds, still, ahead, np.zeros((2, 2)), (0.2, 0.2), 0.5)
    return TrackedBox(box, np.full(2, -1.0), 2.0)


def probabilities(found, things):
    recording, T, p = found
    inputs = MeshInputs(recording, recording, T, p, [], things, 0)
    return p_unoccluded(WALL, np.arange(len(WALL)), VIEW, inputs)


def on_wall():
    x, z = np.meshgrid(np.arange(-1.4, 1.4, 0.03), np.arange(-1.4, 1.4, 0.03))
    return np.column_stack([x.ravel(), np.full(x.size, 4.0), z.ravel()])


def test_where_no_beam_tells_the_boxes_do():
    x = WALL.centers[:, 0]
    p = probabilities(beams([[9.0, 9.0, 0.0]], [1.0]), [person(0.0, 2.0)])
    np.testing.assert_allclose(p[np.abs(x) > 0.95], _P_UNOBSERVED, atol=0.02)
    # 0.4 m wide, twice as far away
    assert (p[np.abs(x) < 0.4] < 0.1).all()


def test_beams_on_the_wall_speak_for_it_but_not_behind_a_thing():
    """The laser sees past it what the camera does not."""
    ends = on_wall()
    p = probabilities(beams(ends, np.ones(len(ends))), [])
    assert (p > 0.99).all()
    p = probabilities(beams(ends, np.ones(len(ends))), [person(0.0, 2.0)])
    x = np.abs(WALL.centers[:, 0])
    assert (p[x < 0.25] < MIN_P_VISIBLE).all()
    assert (p[x > 0.7] > 0.99).all()


def test_beams_that_end_on_what_moves_are_believed_at_once():
    p = probabilities(beams([[0.3, 2.0, 0.0]], [0.1]), [])
    at = WALL.centers[:, [0, 2]]
    near = np.hypot(at[:, 0] - 0.6, at[:, 1]) < 0.15
    assert near.any()
    np.testing.assert_allclose(p[near], 0.1, atol=1e-6)
    assert p[np.hypot(at[:, 0] - 0.6, at[:, 1]) > 0.6] == pytest.approx(_P_UNOBSERVED)
