"""The building that grows: more scans see more of it, and come back to what they saw."""

import math
from itertools import pairwise

from stillmap.sim import Scene, scene_by_name


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


def test_empty_it_grows_too() -> None:
    bare = scene_by_name("building-empty", {"robot": {"scans": 5000}})
    assert bare.crowd.people == 0
    assert bare.name == "building-empty"
    assert bare.walls == sized(5000).walls
