"""The corridors that look the same do, and the robot goes through all of them."""

import numpy as np
import pytest
from numpy.typing import NDArray

from stillmap.sim import Simulation, scene_by_name, simulate
from stillmap.sim.laser import Movers, cast_beams, compute_beam_angles

pytestmark = pytest.mark.slow

Float = NDArray[np.float64]

MIDDLES = 1.1 + 6.0 * np.arange(10)  # m, x of the corridors
NOBODY = Movers(np.empty((9, 0, 2)), np.empty((9, 0)), np.empty((0, 2)), np.empty(0, np.int32))


@pytest.fixture(scope="module")
def whole() -> Simulation:
    """The whole route with nobody about, and few beams."""
    return simulate(scene_by_name("ten-corridors-empty", {"laser": {"beams": 8}}), 1)


def seen_from(x: float, facing: float) -> Float:
    """(9, 360) ranges at places along a corridor, up to what the laser sees."""
    scene = scene_by_name("ten-corridors")
    poses = np.column_stack([np.full(9, x), np.linspace(2.5, 29.5, 9), np.full(9, facing)])
    found = cast_beams(
        poses, compute_beam_angles(360, 2 * np.pi), np.array(scene.walls), NOBODY
    ).range
    return np.minimum(found, scene.laser.max_range)


@pytest.mark.parametrize("facing", [np.pi / 2, -np.pi / 2])
def test_no_corridor_tells_itself_from_another(facing: float) -> None:
    one = seen_from(MIDDLES[1], facing)
    assert np.ptp(one) > 5.0
    for x in MIDDLES[2:9]:
        np.testing.assert_allclose(seen_from(x, facing), one, atol=1e-6)
    # the two outermost show where the corridors across end, if anything
    for x in MIDDLES[[0, 9]]:
        assert (np.abs(seen_from(x, facing) - one) > 0.01).mean() < 0.02
    # while its two ends do not look the same
    assert np.abs(seen_from(MIDDLES[1], -facing)[::-1] - one).max() > 1.0


@pytest.mark.slow
def test_the_robot_goes_through_all_and_through_two_again(whole: Simulation) -> None:
    x, y = whole.truth.T_world_base[:, :2, 2].T
    visits = []
    for middle in MIDDLES:
        inside = (np.abs(x - middle) < 0.6) & (y > 4) & (y < 28)
        visits.append(int(np.count_nonzero(np.diff(inside.astype(int), prepend=0) == 1)))
    assert visits == [1, 1, 1, 2, 1, 1, 2, 1, 1, 1]
    assert np.hypot(x[-1] - x[0], y[-1] - y[0]) < 0.3


def test_odometry_is_as_bad_as_usual() -> None:
    scene = scene_by_name("ten-corridors")
    assert scene.odometry == scene_by_name("hall").odometry
    assert scene.laser == scene_by_name("hall").laser
