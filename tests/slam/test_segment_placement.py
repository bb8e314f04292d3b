"""Segments of a trajectory, placed by the evidence of the map with the scans before."""

import dataclasses
import functools

import numpy as np
from driven import driven

from stillmap.core import se2
from stillmap.sim.walls import box
from stillmap.slam.relocalization import relocalize_segments
from stillmap.slam.scan_matching import FAULT_COST
from stillmap.slam.segment_placement import Segment

NARROW = np.diag(np.square([0.3, 0.3, 0.05]))


@functools.cache
def twice_round():
    """A room that the robot drives round twice, at true poses."""
    walls = (*box(0, 0, 16, 10), *box(-5, 1, 2, 1), *box(3, -1, 1, 3))
    route = ((-7, -4), (7, -4), (7, 4), (-7, 4), (-7, -4), (7, -4), (7, 4), (-7, 4))
    context = driven(walls, route, {"beams": 180, "max_range": 30.0})
    e = np.ones_like(context.e)
    return dataclasses.replace(context, e=e)


def moved(context, first, x, y, theta):
    """The trajectory with the scans from `first` on elsewhere."""
    poses = context.poses.copy()
    wrong = se2.matrix(x, y, theta)
    poses[first:] = poses[first] @ wrong @ se2.inverse(poses[first]) @ poses[first:]
    return dataclasses.replace(context, poses=poses)


def halfway(context):
    return int(np.searchsorted(context.travelled, 0.5 * context.travelled[-1]))


def test_evidence_prefers_the_right_place():
    context = twice_round()
    first, last = halfway(context), len(context.poses)
    right = Segment(context, first, last, NARROW).follow_odometry()
    assert right.is_likely
    assert right.cost < 20.0  # however many keyframes follow the first one
    shifted = moved(context, first, 0.2, -0.2, 0.03)
    followed = Segment(shifted, first, last, NARROW).follow_odometry()
    np.testing.assert_allclose(followed.C @ shifted.poses[first], context.poses[first], atol=0.03)
    assert 0.8 * right.score < followed.score < right.score
    far_context = moved(context, first, 3.0, 2.0, 0.7)
    far = Segment(far_context, first, last, 1e-4 * NARROW)
    assert not far.follow_odometry().is_likely
    place = max(far.find_places(), key=lambda placement: placement.score)
    assert place.is_likely
    assert place.is_elsewhere
    assert place.score < right.score
    driven = far.continue_motion()  # from its last pose: odometry failed
    assert not driven.is_elsewhere
    assert FAULT_COST < driven.motion_cost < 0.5 * place.motion_cost
    np.testing.assert_allclose(driven.C @ far_context.poses[first], context.poses[first], atol=0.03)


def test_what_follows_a_segment_moves_with_it():
    # odometry errs in the first gap only; after the second one it leads on from there
    context = twice_round()
    first, last = halfway(context), len(context.poses)
    second = (first + last) // 2
    drift = context.drift.copy()
    drift[first] = np.diag(np.square([0.5, 0.5, 0.2]))
    shifted = dataclasses.replace(moved(context, first, 0.6, -0.4, 0.2), drift=drift)
    placed = relocalize_segments(shifted, [first, second])
    assert placed.breaks == []
    assert placed.ambiguous == []
    assert placed.closures == []  # no place was searched for
    d = se2.parameters(se2.inverse(context.poses) @ placed.context.poses)
    np.testing.assert_allclose(d, 0.0, atol=0.05)
