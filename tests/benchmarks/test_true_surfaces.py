"""Distances to the true surfaces of simulated worlds, against dense points on them."""

import numpy as np
import pytest
from marks import slow_params
from scipy.spatial import KDTree
from trimesh import creation
from true_surfaces import place_parts, project_to_solid, project_to_static, to_world

from stillmap.sim.geometry import (
    BOX,
    CYLINDER,
    ELLIPSOID,
    Faces,
    Ground,
    MovingSurfaces,
    Solids,
    StaticSurfaces,
)

STREET = Ground(np.zeros(2), np.array([[2.0, -9.0, 9.0, 9.0]]), 0.12)


def _solid(form, half, z):
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
def test_nearest_places_of_solids(form, half, z):
    solids = _solid(form, half, z)
    meshes = {BOX: creation.box((2, 2, 2)), CYLINDER: creation.cylinder(1, 2, sections=256)}
    mesh = meshes.get(form) or creation.icosphere(subdivisions=5)
    mesh.apply_scale((*half, (z[1] - z[0]) / 2))
    middle, pose = np.array([0.0, 0.0, np.mean(z)]), solids.pose[0, 0]
    surface = KDTree(to_world(mesh.subdivide_to_size(0.02).vertices + middle, pose))
    rng = np.random.default_rng(3)
    points = rng.uniform((-1.5, -4.5, -0.5), (3.5, 0.5, 4.5), (300, 3))
    # within it, and on its axes
    within = rng.uniform(-0.9, 0.9, (50, 3)) * (*half, 0)
    within[:2] = (0.0, 0.0, 0.0), (0.0, 0.01 * half[1], 0.0)
    points[:50] = to_world(within + middle, pose)
    found = project_to_solid(points, solids, 0)
    distance = np.linalg.norm(found - points, axis=1)
    slow = surface.query(points)[0]
    assert np.all(distance <= slow + 2e-3)  # facets lie within what is round
    assert np.all(slow <= distance + 0.015)
    assert np.allclose(project_to_solid(found, solids, 0), found, atol=1e-7)


def test_nearest_places_of_faces_and_ground():
    wall = Faces(np.array([[0.0, 0.0, 0.0, 4.0]]), np.array([[-0.5, 2.5]]), np.zeros(1, bool))
    none = _solid(BOX, (1.0, 1.0), (0.0, 1.0)).select(np.zeros(1, bool))
    cases = {
        (0.3, 1.0, 1.0): 0.3,  # before the wall
        (0.3, 4.4, 1.0): 0.5,  # past its end
        (0.0, 1.0, 2.8): 0.2,  # above it
        (-3.0, 1.0, 0.05): 0.05,  # over the street
        (5.0, 1.0, 0.05): 0.07,  # below the pavement
        (-3.0, 1.0, 2.9): 0.1,  # below the ceiling
    }
    points, wanted = np.array(list(cases)), list(cases.values())
    distance, places = project_to_static(StaticSurfaces(wall, none, STREET, 3.0), points)
    assert np.allclose(distance, wanted)
    assert np.allclose(np.linalg.norm(places - points, axis=1), wanted)
    distance, _ = project_to_static(StaticSurfaces(wall, none, STREET, None), points)
    assert distance[-1] == pytest.approx(2.9)


def test_movers_go_on_evenly_between_scans_but_for_leaps():
    pose = np.zeros((3, 2, 4))
    pose[:, 0, 0] = [0.0, 1.0, 2.0]
    pose[:, 0, 2] = [3.1, -3.1, -3.0]  # round past the back
    pose[:, 1, 0] = [0.0, 90.0, 91.0]
    z, movers = np.tile([0.0, 1.0], (2, 1)), np.arange(2, dtype=np.int32)
    solids = Solids(pose, np.full(2, BOX, np.int8), np.ones((2, 2)), z, movers)
    moving = MovingSurfaces(np.array([0, 10**9, 2 * 10**9]), solids)

    def at(mover, seconds):
        return place_parts(moving, moving.parts(mover), round(1e9 * seconds)).pose[0, 0]

    assert abs(abs(at(0, 0.5)[2]) - np.pi) < 1e-9
    # the last scan takes as long as the one before, and nobody knows what comes later
    assert [at(0, seconds)[0] for seconds in (0.5, 2.5, 9.0)] == [0.5, 2.5, 3.0]
    assert [at(1, seconds)[0] for seconds in (0.5, 1.5)] == [0.0, 90.5]
