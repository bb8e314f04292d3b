"""The frame near the robot: where its origin lies, and that it gives back what it took."""

from dataclasses import dataclass

import numpy as np
import pytest

from stillmap.core.local_frame import FAR, Shift, find_origin, shift, shift_poses

UTM = np.array([500_000.0, 5_300_000.0, 800.0])


@dataclass(frozen=True, eq=False)
class Seen:
    """Something with fields that depend on the frame."""

    poses: np.ndarray
    points: np.ndarray
    corner: tuple[float, float, float]
    cells: np.ndarray
    parts: list["Seen"]
    z: float | None = None


FIELDS = {
    Seen: {
        **{name: name for name in ("poses", "points", "corner", "cells", "z")},
        "parts": "part",
    }
}


def poses_at(positions):
    """(T, D+1, D+1) poses without rotation."""
    positions = np.asarray(positions, float)
    T = np.tile(np.eye(positions.shape[1] + 1), (len(positions), 1, 1))
    T[:, :-1, -1] = positions
    return T


def seen_at(ways, z=None):
    corner = (float(ways[0, 0]), float(ways[0, 1]), 0.25)
    cells = np.round(ways / 0.5).astype(np.int64)
    part = Seen(poses_at(ways), ways, corner, cells, [], z)
    return Seen(poses_at(ways), ways, corner, cells, [part], z)


@pytest.mark.parametrize("dimension", [2, 3])
def test_near_poses_stay_as_they_are(dimension):
    poses = poses_at(np.linspace(-1.0, 0.9 * FAR, 7 * dimension).reshape(7, dimension))
    origin, seen = find_origin(poses, FAR), seen_at(poses[:, :-1, -1])
    assert not origin.any()
    assert shift_poses(poses, origin) is poses
    assert shift(seen, Shift.of(origin, 0.5), FIELDS) is seen


@pytest.mark.parametrize(("dimension", "z"), [(2, None), (3, 801.5)])
def test_far_ones_come_near_and_go_back(dimension, z):
    ways = np.linspace(0.0, 30.0, 5)[:, None] + UTM[:dimension]
    origin, seen = find_origin(poses_at(ways)), seen_at(ways, z)
    np.testing.assert_array_equal(origin, np.append(UTM, 0.0)[:3] * (np.arange(3) < dimension))
    near = shift(seen, Shift.of(-origin, 0.5), FIELDS)
    back = shift(near, Shift.of(origin, 0.5), FIELDS)
    for one, before in ((near, back), (near.parts[0], back.parts[0])):
        assert np.abs(one.poses[:, :-1, -1]).max() <= 30.0
        np.testing.assert_array_equal(one.points, ways - UTM[:dimension])
        np.testing.assert_array_equal(one.cells, seen.cells - np.round(UTM / 0.5)[:dimension])
        assert one.corner == (0.0, 0.0, 0.25)
        assert one.z == (None if z is None else 1.5)
        np.testing.assert_array_equal(before.poses, seen.poses)
        np.testing.assert_array_equal(before.cells, seen.cells)
        assert before.corner == seen.corner


def test_zeros_of_a_receiver_without_a_fix():
    positions = np.tile(UTM, (20, 1))
    positions[:4] = 0.0
    np.testing.assert_array_equal(find_origin(poses_at(positions)), UTM)
