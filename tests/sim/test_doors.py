"""Doors: how a leaf swings, for whom it opens, onto whom it does not close, who sees it."""

import numpy as np
import pytest

from stillmap.core.config import override
from stillmap.sim import Scene, simulate
from stillmap.sim.dynamics import Doors, split_into_segments
from stillmap.sim.options import DoorOptions
from stillmap.sim.planner import compute_segment_distance
from stillmap.sim.scene import Door
from stillmap.sim.walls import box

DOOR = Door((1.0, 2.0), 0.9, 0.0, np.pi / 2)
NOBODY, NO_WAYS = np.empty((0, 2)), np.empty((0, 4))
FAR = np.array([[20.0, 20.0]])


def followed(doors, steps, standing=NOBODY, ways=NO_WAYS, dt=0.1):
    angles = []
    for _ in range(steps):
        doors.step(dt, standing, ways)
        angles.append(doors.angle)
    return np.array(angles)


def until(state, seed=0, options=None):
    """A door that has just come to be closed (0) or open (1)."""
    doors = Doors((DOOR,), options or DoorOptions(), np.random.default_rng(seed))
    while doors.share[0] == state:
        doors.step(0.1, FAR, NO_WAYS)
    while doors.share[0] != state:
        doors.step(0.1, FAR, NO_WAYS)
    return doors


@pytest.mark.parametrize("seed", range(5))
def test_a_leaf_swings_evenly_and_stays_as_long_as_it_may(seed):
    options = DoorOptions(min_open=4, max_open=9, min_closed=6, max_closed=20, swing=1.5)
    angle = followed(until(0.0, seed, options), 3000)[:, 0]
    assert angle.min() == pytest.approx(0.0)
    assert angle.max() == pytest.approx(np.pi / 2)
    speed = np.abs(np.diff(angle)) / 0.1
    swinging = speed > 1e-9
    np.testing.assert_allclose(speed[swinging].max(), np.pi / 2 / 1.5)
    # seconds that it rests, open or closed, the first and the last left out
    changes = np.flatnonzero(np.diff(swinging.astype(int)))
    spans = np.diff(changes) * 0.1
    opens = angle[changes[:-1] + 1] > 1.0
    rests = ~swinging[changes[:-1] + 1]
    assert rests.sum() > 20
    # a rest includes the instants at which the next swing begins and the last one ends
    for state, low, high in ((True, 4, 9), (False, 6, 20)):
        stay = spans[rests & (opens == state)]
        swings = 1.5  # counted from when the door begins to swing
        assert stay.min() > low - swings - 0.3
        assert stay.max() < high - swings + 0.3
        assert np.ptp(stay) > 0.3 * (high - low)
    np.testing.assert_allclose(spans[~rests], 1.5, atol=0.11)


def test_a_closing_leaf_stops_for_somebody():
    doors = until(1.0)
    while doors.share[0] == 1.0:
        doors.step(0.1, FAR, NO_WAYS)
    angle = followed(doors, 50, np.array([[1.4, 1.2]]))
    np.testing.assert_array_equal(angle, angle[0, 0])
    assert 0.0 < angle[0, 0] < np.pi / 2


def test_a_door_opens_for_whoever_comes_but_not_for_who_goes_by():
    options = DoorOptions(min_closed=1000.0, max_closed=1000.0)
    standing = np.array([[1.4, 0.5]])
    by = split_into_segments(np.array([[[0.4, 1.0], [3.4, 1.0], [5.0, 1.0]]]))
    through = split_into_segments(np.array([[[1.4, 0.5], [1.5, 1.5], [1.5, 3.0]]]))
    doors = until(0.0, options=options)
    np.testing.assert_array_equal(followed(doors, 100, standing, by), 0.0)
    assert followed(doors, 16, standing, through)[-1, 0] == pytest.approx(np.pi / 2)


def standing_before_a_door(**doors):
    walls = [*box(0, 0, 8, 8), (4.0, 0.5, 1.0, 0.5), (-4.0, 0.5, 0.0, 0.5)]
    leaf, route = Door((0.02, 0.5), 0.96, 0.0, 1.8), ((0.5, -3.0), (0.5, -2.95))
    scene = Scene(name="door", walls=tuple(walls), route=route, leaves=(leaf,))
    options = {
        "crowd": {"people": 0},
        "robot": {"scans": 600, "speed": 0.001},
        "laser": {"beams": 181, "fov": 2 * np.pi, "range_noise": 0.0},
        "doors": doors,
    }
    return simulate(override(scene, options), 2)


def test_beams_meet_the_leaf_where_it_is(end_points):
    run = standing_before_a_door(max_closed=10.0, max_open=10.0)
    xy, scan = end_points(run)
    truth = run.truth
    assert truth.scene["mover_kinds"] == ["door"]
    heading = truth.movers[:, 0, 2]
    assert np.ptp(heading) == pytest.approx(1.8)
    for t in range(0, 600, 7):
        faces = np.array([0.02, 0.5, *truth.movers[t, 0, :2]])
        tip = faces[:2] + 2 * (faces[2:] - faces[:2])
        mine = xy[(scan == t) & (truth.mover == 0)]
        off = compute_segment_distance(mine, np.array([*faces[:2], *tip]))
        assert off.max(initial=0.0) < 1e-5
        direction = tip - faces[:2]
        assert np.arctan2(direction[1], direction[0]) == pytest.approx(heading[t])
        if heading[t] == 0.0:
            # closed, straight ahead, one metre wide at 3.4 m: 16 degrees, a beam every two
            assert 7 <= len(mine) <= 9
    assert not truth.static[truth.mover == 0].any()
