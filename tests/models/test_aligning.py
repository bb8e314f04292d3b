"""Sweeps of one rigid thing, laid over each other."""

import numpy as np
import pytest

from stillmap.models.aligning import Sweep, aligned, moved

HALF = np.array([2.1, 0.9, 0.7])


def _car(rng: np.random.Generator, from_where: np.ndarray, n: int) -> Sweep:
    """What is seen of a box with a lower bonnet, from one side."""
    points, normals = [], []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        normal = np.zeros(3)
        normal[axis] = sign
        if normal @ (from_where - normal * HALF) <= 0.1:
            continue
        side = rng.uniform(-1, 1, (n, 3)) * HALF
        side[:, axis] = sign * HALF[axis]
        side[(side[:, 0] > 1.2) & (side[:, 2] > 0.1), 2] -= 0.6
        points.append(side)
        normals.append(np.tile(normal, (n, 1)))
    at = np.concatenate(points) + rng.normal(0, 0.02, (n * len(points), 3))
    return Sweep(at, np.concatenate(normals), np.ones(len(at)))


@pytest.mark.parametrize("seed", range(3))
def test_a_car_that_passes_by_becomes_sharp(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sweeps, off = [], []
    for ahead in np.linspace(-12.0, 12.0, 13):
        sweep = _car(rng, np.array([ahead, 4.0, 1.0]), 150)
        # as the middle of what is seen goes, and some noise
        wrong = np.array([0.03 * ahead, 0.2, 0.02]) + rng.normal(0, [0.1, 0.05, 0.01])
        sweeps.append(sweep._replace(points=moved(sweep.points, wrong)))
        off.append(wrong)
    offsets = aligned(sweeps)
    # all of them lie as the best one does: compare where one corner of the car comes to lie
    corner = np.array([[2.1, 0.9, 0.0]])
    at = np.stack([moved(moved(corner, w), o)[0] for w, o in zip(off, offsets, strict=True)])
    before = np.stack([moved(corner, w)[0] for w in off])
    apart, apart_before = (np.linalg.norm(x - np.median(x, axis=0), axis=1) for x in (at, before))
    assert apart_before.max() > 0.35
    assert apart.max() < 0.2
    assert apart.mean() < 0.07


def test_where_little_is_seen_the_track_counts() -> None:
    rng = np.random.default_rng(7)
    few = Sweep(rng.normal(size=(5, 3)), np.tile([0.0, 1.0, 0.0], (5, 1)), np.ones(5))
    np.testing.assert_array_equal(aligned([few, few]), 0.0)
    assert aligned([]).shape == (0, 3)


def test_along_a_flat_side_the_track_counts() -> None:
    rng = np.random.default_rng(8)

    def side() -> Sweep:
        at = np.column_stack([rng.uniform(-2, 2, 400), np.full(400, 0.9), rng.uniform(0, 1, 400)])
        return Sweep(at, np.tile([0.0, 1.0, 0.0], (400, 1)), np.ones(400))

    one, other = side(), side()
    other = other._replace(points=other.points + np.array([0.0, 0.15, 0.0]))
    offsets = aligned([one, other])
    ahead, aside, turn = offsets[1] - offsets[0]
    assert abs(ahead) < 0.02
    assert abs(aside + 0.15) < 0.02
    assert abs(turn) < 0.01
