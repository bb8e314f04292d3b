"""Surroundings: what lets some beams pass is static, what moves past it is dynamic.

The street has a hedge, a fence of thin posts, and a car with windows.
"""

from typing import Any, NamedTuple

import numpy as np
import pytest

from stillmap import Recording, em
from stillmap.em import occupancy_hmm
from stillmap.em.observations import likelihood_of_misses

SENSOR_HEIGHT, SPEED = 1.5, 0.9  # m above the ground, m/s along x
HEDGE, POST, CAR, WALKER, SOLID = range(5)

_WALL = 9.0  # m to the wall behind all, along y
_PERIOD = 0.1  # s
_LEAVES = 2.0  # m that beams travel among the leaves of a hedge of 0.7 m, on average


class Street(NamedTuple):
    """The recording, poses (T, 4, 4), what each beam ended on (M,)."""

    recording: Recording
    poses: Any
    thing: Any


def watch(sweeps=80, seed=0):
    """Sweeps of a lidar that drives along the street, while somebody walks before the hedge."""
    rng = np.random.default_rng(seed)
    direction = _directions()
    poses = np.tile(np.eye(4), (sweeps, 1, 1))
    poses[:, 0, 3] = SPEED * _PERIOD * np.arange(sweeps)
    poses[:, 2, 3] = SENSOR_HEIGHT
    clouds, things = [], []
    for t, T in enumerate(poses):
        ranges, thing = _cast(T[:3, 3], direction, t * _PERIOD, rng)
        noisy = ranges + rng.normal(scale=0.01, size=len(ranges))
        clouds.append((noisy[:, None] * direction).astype(np.float32))
        things.append(thing)
    recording = Recording.from_clouds(_PERIOD * np.arange(sweeps), clouds)
    return Street(recording, poses, np.concatenate(things))


def _directions():
    azimuth = np.radians(90.0 + np.arange(-60.0, 60.5, 0.75))
    elevation = np.radians(np.arange(-20.0, 3.0, 1.0))
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation))
    return np.column_stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def _cast(start, direction, time, rng):
    """(N,) ranges in metres, and what beams of these directions (N, 3) end on."""
    n = len(direction)
    with np.errstate(divide="ignore"):
        to_ground = np.where(direction[:, 2] < 0, -start[2] / direction[:, 2], np.inf)
    ranges, thing = np.minimum(to_ground, (_WALL - start[1]) / direction[:, 1]), np.full(n, SOLID)

    def meet(distance, what):
        nearer = distance < ranges
        ranges[nearer], thing[nearer] = distance[nearer], what

    low, high = _cross_box(start, direction, (-6.0, 4.0, 0.0), (1.0, 4.7, 1.3))
    inside = low + rng.exponential(_LEAVES, n)
    meet(np.where(inside < high, inside, np.inf), HEDGE)
    for x in np.arange(1.5, 4.0, 0.5):
        meet(_cross_cylinder(start, direction, (x, 4.3), 0.025, 1.2), POST)
    _cast_car(start, direction, rng, meet)
    walker = (-3.0 + 1.3 * time, 3.0)
    meet(_cross_cylinder(start, direction, walker, 0.25, 1.7), WALKER)
    return ranges, thing


def _cast_car(start, direction, rng, meet):
    """A body to 0.8 m, and above it windows, of which four beams in ten come back."""
    low, high = _cross_box(start, direction, (5.0, 4.0, 0.2), (9.0, 5.7, 0.8))
    meet(np.where(low < high, low, np.inf), SOLID)
    low, high = _cross_box(start, direction, (5.5, 4.1, 0.8), (8.5, 5.6, 1.4))
    inside = low + np.where(rng.random(len(low)) < 0.4, 0.0, rng.exponential(1.0, len(low)))
    meet(np.where(inside < high, inside, np.inf), CAR)


def _cross_box(start, direction, lower, upper):
    """Ranges (N,) at which beams enter and leave a box; where they miss it, enter after leaving."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(np.asarray(corner) - start) / direction for corner in (lower, upper)])
    low, high = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
    return np.where(low > 0, low, np.inf), high


def _cross_cylinder(start, direction, at, radius, height):
    """Ranges (N,) at which beams meet an upright cylinder; inf: they do not."""
    to, d = np.asarray(at) - start[:2], direction[:, :2]
    length = np.linalg.norm(d, axis=1)
    along = d @ to / length
    depth = radius**2 - (to @ to - along**2)
    distance = (along - np.sqrt(np.maximum(depth, 0.0))) / length
    meets = (depth > 0) & (along > 0) & (start[2] + distance * direction[:, 2] < height)
    return np.where(meets, distance, np.inf)


@pytest.fixture(scope="module")
def seen():
    return watch()


def dynamic_share(found, seen, thing):
    return float((found.p_static[seen.thing == thing] < 0.5).mean())


@pytest.fixture(scope="module")
def found(seen):
    return occupancy_hmm.e_step_3d(seen.recording, seen.poses, 0.15, em.EmOptions())


@pytest.fixture(scope="module")
def without(seen):
    """As if nothing was known of surroundings."""
    collect = occupancy_hmm.collect_observations

    def collect_without(*args, with_surroundings=False, **kwargs):  # noqa: ARG001
        return collect(*args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(occupancy_hmm, "collect_observations", collect_without)
        return occupancy_hmm.e_step_3d(seen.recording, seen.poses, 0.15, em.EmOptions())


@pytest.mark.parametrize("thing", [HEDGE, POST, CAR])
def test_porous_things_are_static(found, seen, thing):
    assert (seen.thing == thing).sum() > 3000
    assert dynamic_share(found, seen, thing) < 0.06


def test_surroundings_tell_it(found, without, seen):
    for thing in (HEDGE, CAR):
        assert dynamic_share(found, seen, thing) < 0.4 * dynamic_share(without, seen, thing)


def test_the_walker_is_dynamic(found, seen):
    assert dynamic_share(found, seen, WALKER) > 0.99
    assert dynamic_share(found, seen, SOLID) < 0.01


def counts(*rows):
    return np.array(rows, np.float32)


def test_without_misses_surroundings_say_nothing():
    np.testing.assert_array_equal(likelihood_of_misses(counts((0, 0), (0.4, 0.4))), 1.0)


def test_likelihood_of_misses():
    # Beta(9, 1): P(hit around | one miss) is 9 / 10, and 1 / 10 where surroundings empty
    p = likelihood_of_misses(counts((1, 1), (1, 0), (2, 1)))
    assert p.dtype == np.float32
    np.testing.assert_allclose(p, [[1, 1 / 9], [1 / 9, 1], [1, 1]], rtol=1e-5)
    # B(11, 1) / B(9, 1) and B(3, 9) / B(1, 9)
    np.testing.assert_allclose(
        likelihood_of_misses(counts((2, 2)))[0, 1], (2 / (10 * 11)) / (9 / 11), rtol=1e-5
    )


def test_many_misses_count_as_twenty():
    few, many = likelihood_of_misses(counts((20, 15), (400, 300)))
    np.testing.assert_array_equal(few, many)
    assert np.isfinite(likelihood_of_misses(counts((1e6, 1e6), (1e6, 0)))).all()
