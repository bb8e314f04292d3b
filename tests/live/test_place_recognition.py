"""Sweeps of one place look alike, however they are turned."""

import numpy as np

from stillmap.live.sweep_loop_closer import find_alike, view_from_above


def make_place(rng):
    """Points of walls and boxes around."""
    angles = np.repeat(rng.uniform(-np.pi, np.pi, 40), 50) + rng.uniform(-0.2, 0.2, 2000)
    distance = np.repeat(rng.uniform(2.0, 30.0, 40), 50)
    height = np.repeat(rng.uniform(0.2, 4.0, 40), 50) * rng.uniform(0.0, 1.0, 2000)
    return np.stack([distance * np.cos(angles), distance * np.sin(angles), height], axis=1)


def turned(points, yaw):
    """The points as seen by a robot that is turned by yaw."""
    c, s = np.cos(yaw), np.sin(yaw)
    return points @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def test_a_place_is_found_again_from_another_heading():
    rng = np.random.default_rng(0)
    places = [make_place(rng) for _ in range(20)]
    earlier = np.array([view_from_above(points) for points in places])
    for number, yaw in ((3, 0.0), (7, 1.1), (12, 2.0), (19, 4.5)):
        again = turned(places[number][::2], yaw) + rng.normal(0.0, 0.1, (1000, 3))
        best, *others = find_alike(view_from_above(again), earlier, 3)
        assert best.number == number
        assert abs(np.angle(np.exp(1j * (best.yaw - yaw)))) < 0.12
        assert len(others) == 2
        assert best.similarity > 1.3 * others[0].similarity
