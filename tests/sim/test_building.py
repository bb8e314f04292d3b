"""The building that grows: more scans see more of it, and come back to what they saw."""

import math
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.sim import Scene, Simulation, scene_by_name, simulate

Float = NDArray[np.float64]

EARLY = {"laser": {"beams": 12}, "robot": {"scans": 1000}}


@pytest.fixture(scope="module")
def early() -> Simulation:
    return simulate(scene_by_name("building", EARLY), 3)


def sized(scans: int) -> Scene:
    return scene_by_name("building", {"robot": {"scans": scans}})


def metres(route: tuple[tuple[float, float], ...]) -> float:
    return sum(math.dist(a, b) for a, b in pairwise(route))


def entered(scene: Scene) -> list[tuple[float, float]]:
    """The points of the floors' corridors at which the route turns into a wing, in order."""
    turns = []
    for a, b in pairwise(scene.route):
        if abs(a[0] - b[0]) < 1e-9 and 2.0 < abs(b[1] - a[1]) < 5.0 and a[1] % 46.8 < 1e-9:
            turns.append((a[0], b[1]))
    return turns


def test_it_grows_with_the_scans() -> None:
    sizes = [sized(scans) for scans in (300, 1000, 10_000, 100_000)]
    wings = [len(set(entered(scene))) for scene in sizes]
    assert wings[0] == 1
    assert wings[1] <= 2
    assert 6 <= wings[2] <= 12
    assert 35 <= wings[3] <= 90
    for scene, scans in zip(sizes, (300, 1000, 10_000, 100_000), strict=True):
        driven = scans * scene.robot.speed / scene.robot.scan_rate
        assert 0.8 * driven <= metres(scene.route) < 1.0 * driven + 400.0


def test_more_scans_begin_like_fewer() -> None:
    small, large = sized(1000), sized(10_000)
    beginning = small.route[:-3]  # then it goes home
    assert large.route[: len(beginning)] == beginning
    wing = [w for w in small.walls if 5.0 < w[1] < 22.0 and 0.0 < w[0] < 34.0]
    assert len(wing) > 100
    assert set(wing) <= set(large.walls)


def test_wings_differ() -> None:
    walls = np.array(sized(3000).walls)
    first = walls[(walls[:, 0] < 34) & (walls[:, 1] > 2) & (walls[:, 1] < 22)]
    other = walls[(walls[:, 0] >= 34) & (walls[:, 0] < 68) & (walls[:, 1] > 2) & (walls[:, 1] < 22)]
    shifted = {tuple(np.round(w - [34, 0, 34, 0], 6)) for w in other}
    alike = sum(tuple(np.round(w, 6)) in shifted for w in first)
    assert alike < 0.1 * len(first)


def test_it_comes_back_as_a_patrol_does() -> None:
    scene = sized(10_000)
    visits = entered(scene)
    assert len(visits) > 1.2 * len(set(visits))
    # and leaves each wing where it came in
    for door in set(visits):
        inside = (door[0], door[1])
        assert scene.route.count(inside) >= 2 * visits.count(door)


def test_the_robot_gets_through_most_of_its_route(early: Simulation) -> None:
    robot = early.truth.T_world_base[:, :2, 2]
    way = np.hypot(*np.diff(robot, axis=0).T).sum()
    assert 0.65 * 160 < way < 0.95 * 160
    seen = [np.hypot(*(robot - point).T).min() < 0.4 for point in early.scene.route[:-3]]
    assert all(seen[: len(seen) // 2])


def test_the_robot_closes_a_loop_around_the_first_wing(early: Simulation) -> None:
    robot = early.truth.T_world_base[:, :2, 2]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(robot, axis=0).T))])
    near = np.hypot(*np.moveaxis(robot[::5, None] - robot[None, ::5], -1, 0)) < 0.5
    later = along[::5, None] - along[None, ::5]
    assert later[near].max() > 65.0


def test_a_few_people_walk_about(early: Simulation) -> None:
    assert 5 <= early.scene.crowd.people <= 12
    assert sized(100_000).crowd.people < 100


def test_it_has_rooms_that_are_seen_from_inside(early: Simulation) -> None:
    """The robot leaves the corridors' middle lines by more than a metre, several times."""
    robot = early.truth.T_world_base[:, :2, 2]
    x, y = robot.T
    in_wing = (y > 3.5) & (x > 5) & (x < 29)
    off = np.minimum.reduce([abs(y - 4.0), abs(y - 17.0), abs(x - 6.3), abs(x - 27.7)])
    inside = in_wing & (off > 1.2)
    assert np.count_nonzero(np.diff(inside.astype(int)) == 1) >= 2


def test_empty_it_grows_too() -> None:
    bare = scene_by_name("building-empty", {"robot": {"scans": 5000}})
    assert bare.crowd.people == 0
    assert bare.name == "building-empty"
    assert bare.walls == sized(5000).walls


@pytest.mark.parametrize("robot", [{"scans": 0}, {"scans": 2.5}, {"scans": -4}, 3])
def test_bad_numbers_of_scans_are_refused(robot: object) -> None:
    with pytest.raises(InputError):
        scene_by_name("building", {"robot": robot})
