"""Distances to the true surfaces of simulated worlds, against dense points on them."""

import numpy as np
import pytest
from marks import slow_params

from stillmap.sim.geometry import BOX, CYLINDER, ELLIPSOID, Faces, Ground, Solids
from stillmap.sim.truth_surfaces import (
    MovingSurfaces,
    StaticSurfaces,
    project_to_solid,
    sample_mover,
    to_local,
    to_world,
)

STREET = Ground(np.zeros(2), np.zeros(2), np.array([[2.0, -9.0, 9.0, 9.0]]), 0.12)


def _solid(form: int, half: tuple[float, float], z: tuple[float, float]) -> Solids:
    pose = np.array([[[1.0, -2.0, 0.7, 0.3]]])
    mover = np.zeros(1, np.int32)
    return Solids(pose, np.array([form], np.int8), np.array([half]), np.array([z]), mover)


@pytest.mark.parametrize(
    ("form", "half", "z"),
    [
        (BOX, (1.0, 0.4), (0.1, 0.9)),
        (CYLINDER, (0.5, 0.5), (0.0, 2.0)),
        (CYLINDER, (0.15, 0.25), (0.8, 1.4)),
        *slow_params((ELLIPSOID, (1.5, 1.5), (2.0, 4.0))),
        (ELLIPSOID, (0.1, 0.08), (1.4, 1.7)),
    ],
)
def test_nearest_places_of_solids(
    form: int, half: tuple[float, float], z: tuple[float, float]
) -> None:
    solids = _solid(form, half, z)
    surface, _ = sample_mover(MovingSurfaces(np.zeros(1, np.int64), solids), 0, 0, 0.02)
    rng = np.random.default_rng(3)
    points = rng.uniform((-1.5, -4.5, -0.5), (3.5, 0.5, 4.5), (300, 3))
    # within it, and on its axes
    points[:50] = to_world(
        rng.uniform(-0.9, 0.9, (50, 3)) * (*half, 0) + (0, 0, np.mean(z)), solids.pose[0, 0]
    )
    points[0] = to_world(np.array([[0.0, 0.0, np.mean(z)]]), solids.pose[0, 0])
    points[1] = to_world(np.array([[0.0, 0.01 * half[1], np.mean(z)]]), solids.pose[0, 0])
    found = project_to_solid(points, solids, 0)
    distance = np.linalg.norm(found - points, axis=1)
    slow = np.linalg.norm(points[:, None] - surface, axis=2).min(axis=1)
    # points 0.02 m apart lie up to 0.0142 m beside the nearest place
    assert np.all(distance <= slow + 1e-9)
    assert np.all(slow <= distance + 0.015)
    again = project_to_solid(found, solids, 0)
    assert np.allclose(again, found, atol=1e-7)


def test_nearest_places_of_faces_and_ground() -> None:
    wall = Faces(np.array([[0.0, 0.0, 0.0, 4.0]]), np.array([[-0.5, 2.5]]), np.zeros(1, bool))
    none = _solid(BOX, (1.0, 1.0), (0.0, 1.0)).select(np.zeros(1, bool))
    points = np.array(
        [
            (0.3, 1.0, 1.0),  # before the wall
            (0.3, 4.4, 1.0),  # past its end
            (0.0, 1.0, 2.8),  # above it
            (-3.0, 1.0, 0.05),  # over the street
            (5.0, 1.0, 0.05),  # below the pavement
            (-3.0, 1.0, 2.9),  # below the ceiling
        ]
    )
    wanted = [0.3, 0.5, 0.2, 0.05, 0.07, 0.1]
    distance, places = StaticSurfaces(wall, none, STREET, 3.0).project(points)
    assert np.allclose(distance, wanted)
    assert np.allclose(np.linalg.norm(places - points, axis=1), wanted)
    assert np.allclose(StaticSurfaces(wall, none, STREET, None).project(points)[0][-1], 2.9)


def test_distance_to_a_slope_is_at_right_angles() -> None:
    slope = Ground(np.array([0.1, 0.0]), np.zeros(2), np.empty((0, 4)), 0.0)
    nothing = Faces(np.empty((0, 4)), np.empty((0, 2)), np.empty(0, bool))
    none = _solid(BOX, (1.0, 1.0), (0.0, 1.0)).select(np.zeros(1, bool))
    distance, places = StaticSurfaces(nothing, none, slope, None).project(
        np.array([[10.0, 3.0, 2.0]])
    )
    assert np.allclose(distance, 1.0 / np.sqrt(1.01))
    assert np.allclose(places[:, 2], 0.1 * places[:, 0])


def test_frames_of_solids_are_undone() -> None:
    pose = np.array([1.0, 2.0, 0.4, 0.1])
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert np.allclose(to_local(to_world(points, pose), pose), points)


def test_movers_go_on_evenly_between_scans_but_for_leaps() -> None:
    pose = np.zeros((3, 2, 4))
    pose[:, 0, 0] = [0.0, 1.0, 2.0]
    pose[:, 0, 2] = [3.1, -3.1, -3.0]  # round past the back
    pose[:, 1, 0] = [0.0, 90.0, 91.0]
    solids = Solids(
        pose,
        np.full(2, BOX, np.int8),
        np.ones((2, 2)),
        np.tile([0.0, 1.0], (2, 1)),
        np.arange(2, dtype=np.int32),
    )
    moving = MovingSurfaces(np.array([0, 10**9, 2 * 10**9]), solids)
    x, _, heading, _ = moving.at(moving.parts(0), 5 * 10**8).pose[0, 0]
    assert x == 0.5
    assert abs(abs(heading) - np.pi) < 1e-9
    assert moving.at(moving.parts(1), 5 * 10**8).pose[0, 0, 0] == 0.0
    assert moving.at(moving.parts(1), 15 * 10**8).pose[0, 0, 0] == 90.5
    # the last scan takes as long as the one before, and nobody knows what comes later
    assert moving.at(moving.parts(0), 25 * 10**8).pose[0, 0, 0] == 2.5
    assert moving.at(moving.parts(0), 9 * 10**9).pose[0, 0, 0] == 3.0


def test_what_lies_within_another_part_is_no_surface() -> None:
    one, other = _solid(BOX, (0.5, 0.5), (0.0, 1.0)), _solid(CYLINDER, (0.2, 0.2), (0.5, 2.0))
    both = MovingSurfaces(np.zeros(1, np.int64), one.concatenate(other))
    points, part = sample_mover(both, 0, 0, 0.05)
    local = to_local(points, one.pose[0, 0])
    assert local[part == 1][:, 2].min() >= 1.0
    hole = (part == 0) & (np.hypot(local[:, 0], local[:, 1]) < 0.19) & (local[:, 2] > 0.9)
    assert not hole.any()


def test_many_places_far_apart_are_each_as_if_alone() -> None:
    walls = np.array([[-30.0, 9.0, 40.0, 9.0], [12.0, -3.0, 12.0, 7.0], [0.0, 0.0, 0.4, 0.0]])
    faces = Faces(walls, np.tile([0.0, 3.0], (3, 1)), np.zeros(3, bool))
    standing = StaticSurfaces(faces, _solid(BOX, (1.0, 0.4), (0.1, 0.9)), STREET, None)
    rng = np.random.default_rng(0)
    points = rng.uniform((-40.0, -20.0, -1.0), (50.0, 30.0, 12.0), (400, 3))
    distance, places = standing.project(points)
    alone = [standing.project(one[None]) for one in points]
    np.testing.assert_array_equal(distance, [d[0] for d, _ in alone])
    np.testing.assert_array_equal(places, [at[0] for _, at in alone])
    assert len(np.unique(np.floor(points[:, :2] / 4.0), axis=0)) > 150
    empty, nowhere = standing.project(np.zeros((0, 3)))
    assert empty.shape == (0,)
    assert nowhere.shape == (0, 3)
