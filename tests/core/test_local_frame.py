"""The frame near the robot: where its origin lies, and that it gives back what it took."""

import numpy as np
import pytest

from stillmap.core.local_frame import FAR, LocalFrame

UTM = np.array([500_000.0, 5_300_000.0, 800.0])


def poses_at(positions):
    """(T, D+1, D+1) poses without rotation."""
    positions = np.asarray(positions, float)
    T = np.tile(np.eye(positions.shape[1] + 1), (len(positions), 1, 1))
    T[:, :-1, -1] = positions
    return T


@pytest.mark.parametrize("dimension", [2, 3])
def test_near_poses_stay_as_they_are(dimension):
    poses = poses_at(np.linspace(-1.0, 0.9 * FAR, 7 * dimension).reshape(7, dimension))
    frame = LocalFrame.near(poses)
    assert not frame.is_shifted
    assert frame.to_local(poses) is poses
    assert frame.to_map(poses) is poses


@pytest.mark.parametrize("dimension", [2, 3])
def test_far_poses_come_near_and_go_back(dimension):
    ways = np.linspace(0.0, 30.0, 5)[:, None] + UTM[:dimension]
    poses = poses_at(ways)
    frame = LocalFrame.near(poses)
    np.testing.assert_array_equal(
        frame.origin, np.append(UTM, 0.0)[:3] * (np.arange(3) < dimension)
    )
    local = frame.to_local(poses)
    assert np.abs(local[:, :-1, -1]).max() <= 30.0
    np.testing.assert_array_equal(frame.to_map(local), poses)
    np.testing.assert_array_equal(frame.points_to_map(frame.points_to_local(ways)), ways)
    corner = frame.corner_to_local((UTM[0] + 1.5, UTM[1] - 2.0, 0.25))
    assert corner == (1.5, -2.0, 0.25)
    assert frame.corner_to_map(corner) == (UTM[0] + 1.5, UTM[1] - 2.0, 0.25)


def test_zeros_of_a_receiver_without_a_fix():
    positions = np.tile(UTM, (20, 1))
    positions[:4] = 0.0
    np.testing.assert_array_equal(LocalFrame.near(poses_at(positions)).origin, UTM)
