"""The heading that walls suggest whose directions were seen before."""

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.live.scan_odometry import WallDirections, correct_heading
from stillmap.slam.heading_alignment import HeadingOffset
from stillmap.slam.scan_hits import Scan


def look(normals_deg, weight=1.0):
    """A scan of flat surfaces whose normals have these directions in its frame."""
    angles = np.radians(normals_deg)
    n = len(angles)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1).astype(np.float32)
    flat = np.zeros(n, np.float32)
    return Scan(np.zeros_like(normals), np.full(n, weight, np.float32), np.eye(3), normals, flat)


def rectangular(rng, count=120, off=0.0):
    return rng.choice([0.0, 90.0, 180.0, 270.0], count) + off + rng.normal(0.0, 1.0, count)


def turned(degrees):
    return se2.matrix(0.0, 0.0, np.radians(degrees))


@pytest.fixture
def walls():
    """Of a rectangular building, 17 degrees off the axes of the frame."""
    found, rng = WallDirections(), np.random.default_rng(0)
    for _ in range(40):
        found.add(look(rectangular(rng)), turned(17.0), 0.5)
    return found


@pytest.mark.parametrize("heading", [17.0, 107.0, -73.0])
@pytest.mark.parametrize("error", [-1.5, 0.0, 0.4, 2.0])
def test_the_heading_follows_walls_that_were_never_seen(walls, heading, error):
    scan = look(rectangular(np.random.default_rng(1)))
    offset = walls.measure(scan, turned(heading + error))
    assert np.degrees(offset.value) == pytest.approx(-error, abs=0.3)
    assert 0.2 < np.degrees(np.sqrt(offset.variance)) < 1.0


def test_walls_at_another_angle_say_nothing(walls):
    scan = look(rectangular(np.random.default_rng(1), off=30.0))
    assert walls.measure(scan, turned(17.0)) is None


def test_a_heading_takes_the_position_along():
    covariance = np.array([[0.04, 0.0, 0.01], [0.0, 0.04, 0.0], [0.01, 0.0, 0.01]])
    T = correct_heading(np.eye(3), covariance, HeadingOffset(0.1, 0.01))
    np.testing.assert_allclose(se2.parameters(T), [0.05, 0.0, 0.05], atol=1e-12)
