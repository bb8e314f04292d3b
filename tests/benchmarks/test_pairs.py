import numpy as np
import pytest
from pairs import errors_of, near_pairs

from stillmap.core import se2


def line(T):
    """A metre a second along x, and back."""
    x = np.concatenate([np.arange(T), np.arange(T)[::-1]]).astype(float)
    return se2.matrix(x, np.zeros(2 * T), np.repeat([0.0, np.pi], T))


def test_pairs_are_near_in_space_and_anywhere_in_time():
    positions = line(100)[:, :2, 2]
    first, second = near_pairs(positions, np.random.default_rng(0), 3000, 5.0)
    assert len(first) == 3000
    assert np.all(first < second)
    assert np.linalg.norm(positions[first] - positions[second], axis=1).max() <= 5.0
    # half of the near scans are those of the way back
    assert np.mean(second - first > 10) == pytest.approx(0.5, abs=0.06)
    again = near_pairs(positions, np.random.default_rng(0), 3000, 5.0)
    np.testing.assert_array_equal((first, second), again)


def test_errors_are_those_of_the_displacements():
    truth, stamp_ns = line(50), 10**18 + np.arange(100) * 10**8
    pairs = near_pairs(truth[:, :2, 2], np.random.default_rng(0), 200)
    elsewhere = se2.matrix(3.0, -2.0, 1.0) @ truth
    assert errors_of(stamp_ns, elsewhere, truth, *pairs).translation.max < 1e-9
    poses = truth.copy()
    poses[50:, 0, 2] += 0.25  # the way back lies off
    errors = errors_of(stamp_ns, poses, truth, *pairs)
    across = np.mean((pairs[0] < 50) & (pairs[1] >= 50))
    assert (errors.used, errors.relations) == (200, 200)
    assert errors.translation.max == pytest.approx(0.25)
    assert errors.translation.mean == pytest.approx(0.25 * across)
    assert errors.rotation.max < 1e-9
