"""The corridors around courtyards: large loops that the robot closes, and people in all of them."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from stillmap.sim import Simulation, scene_by_name, simulate

pytestmark = pytest.mark.slow

Float = NDArray[np.float64]

X, Y = (1.4, 48.2, 113.0, 195.8), (1.4, 34.2, 81.0)  # m, the corridors' middles
LOOPS = [
    2 * (east - west + north - south) for west, east in pairwise(X) for south, north in pairwise(Y)
]


@pytest.fixture(scope="module")
def whole() -> Simulation:
    """The whole route with nobody about, and few beams."""
    return simulate(scene_by_name("rounds-empty", {"laser": {"beams": 8}}), 1)


def test_loops_are_large() -> None:
    assert 150.0 < min(LOOPS) < max(LOOPS) < 300.0


@pytest.mark.slow
def test_the_robot_goes_through_every_corridor_and_home(whole: Simulation) -> None:
    robot = whole.truth.T_world_base[:, :2, 2]
    middles = [((a + b) / 2, y) for a, b in pairwise(X) for y in Y]
    middles += [(x, (a + b) / 2) for a, b in pairwise(Y) for x in X]
    assert len(middles) == 17
    for middle in middles:
        assert np.hypot(*(robot - middle).T).min() < 0.3, middle
    assert np.hypot(*(robot[-1] - robot[0])) < 0.3


def test_the_first_loop_is_closed_after_one_round(whole: Simulation) -> None:
    robot = whole.truth.T_world_base[:, :2, 2]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(robot, axis=0).T))])
    home = np.hypot(*(robot - robot[0]).T) < 0.3
    first = along[home & (along > 10.0)][0]
    assert first == pytest.approx(LOOPS[0], abs=5.0)
    assert 1200.0 < along[-1] < 1500.0


@pytest.mark.slow
def test_people_are_everywhere() -> None:
    scene = scene_by_name("rounds", {"laser": {"beams": 60}, "robot": {"scans": 500}})
    truth = simulate(scene, 2).truth
    assert truth.movers.shape[1] == 40
    x, y = truth.movers[0, :, :2].T
    assert np.histogram(x, [-6, 60, 120, 210])[0].min() >= 5
    assert np.histogram(y, [-6, 30, 90])[0].min() >= 5
    assert (truth.mover >= 0).any()


def test_courtyards_have_windows() -> None:
    glass = np.array(scene_by_name("rounds").glass)
    assert len(glass) >= 6
    # in the walls of the courtyards, not in the outer ones
    assert glass[:, [0, 2]].min() > 2.7
    assert glass[:, [1, 3]].min() > 2.7
    assert glass[:, [0, 2]].max() < 194.5
