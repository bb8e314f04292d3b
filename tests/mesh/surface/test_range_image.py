"""Polygons of range images: how sensors look about, and which triangles are surface."""

import numpy as np
import pytest

from stillmap.mesh import range_image, triangulation
from stillmap.mesh.range_image import find_scan_layout, triangulate_scans
from stillmap.mesh.triangulation import split_rows


@pytest.fixture(autouse=True)
def loose(monkeypatch):
    """The beams of these tests lie far apart."""
    monkeypatch.setattr(triangulation, "_MAX_EDGE", 5.0)
    monkeypatch.setattr(triangulation, "_MAX_EDGE_SHARE", 2.0)


def patches(recording, poses):
    order = find_scan_layout(recording, np.arange(recording.n_scans))
    return order, [make() for make in triangulate_scans(recording, poses, order)]


def looks_back(patch):
    """Whether each face is counter-clockwise seen from the sensor."""
    a, b, c = np.moveaxis(patch.points[patch.faces], 1, 0)
    sight = patch.origin[patch.faces[:, 0]] - a
    return np.einsum("ni,ni->n", np.cross(b - a, c - a), sight) > 0


@pytest.mark.parametrize(
    ("sensor", "made", "length"),
    [
        ("lidar", (), 24),
        ("lidar", (240, 24, "rings"), 240),
        ("lidar", (360, 16), 16),
        ("lidar", (1800, 16, "rings"), 1800),
        ("picture", (), 64),
        ("picture", (40, 60), 40),
    ],
)
def test_rows_are_found(room, sensor, made, length):
    looking = getattr(room, sensor)(*made)
    assert range_image.find_row_length(looking) == length
    noisy = looking.copy()
    noisy[np.random.default_rng(0).random(len(noisy)) < 0.2] = np.nan
    assert range_image.find_row_length(noisy) == length


def test_planar_lasers_are_told_from_others(room):
    assert range_image.is_planar(room.nodding()[7])
    assert not range_image.is_planar(room.lidar())
    assert not range_image.is_planar(room.picture())
    assert not range_image.is_planar(np.tile([1.0, 0.0, 0.0], (50, 1)))


def test_any_order_makes_the_same_surface(room):
    looking = np.random.default_rng(0).permutation(room.lidar())
    recording = room.scans(looking, room.standing())
    _, (patch,) = patches(recording, room.standing())
    assert len(patch.faces) > 0.9 * 2 * 23 * 240
    assert looks_back(patch).all()
    azimuth = np.arctan2(*patch.points[patch.faces].mean(axis=1)[:, 1::-1].T)
    assert np.histogram(azimuth, 24, (-np.pi, np.pi))[0].min() > 0.9 * len(azimuth) / 24


@pytest.mark.parametrize("rows_are", ["columns", "rings"])
@pytest.mark.parametrize("sense", [1, -1])
def test_rows_with_gaps_make_the_same_surface(room, rows_are, sense):
    """Beams are lost at random and in a whole sector."""
    looking = room.lidar(240, 40, rows_are) * [1, sense, 1]
    rng = np.random.default_rng(0)
    sector = np.arctan2(looking[:, 1], looking[:, 0])
    looking = looking[(rng.random(len(looking)) < 0.95) & (np.abs(sector - 1.0) > 0.2)]
    found = split_rows(looking)
    assert len(found.first) - 1 == (240 - 15 if rows_are == "columns" else 40)
    recording = room.scans(looking, room.standing())
    _, (patch,) = patches(recording, room.standing())
    looking = patch.points[patch.faces]
    area = 0.5 * np.linalg.norm(
        np.cross(looking[:, 1] - looking[:, 0], looking[:, 2] - looking[:, 0]), axis=1
    )
    _, (whole,) = patches(*[room.scans(room.lidar(240, 40), room.standing()), room.standing()])
    all_of_it = whole.points[whole.faces]
    most = 0.5 * np.linalg.norm(
        np.cross(all_of_it[:, 1] - all_of_it[:, 0], all_of_it[:, 2] - all_of_it[:, 0]), axis=1
    )
    assert 0.8 * most.sum() < area.sum() < 0.99 * most.sum()
    assert looks_back(patch).all()
    middle = looking.mean(axis=1)
    assert (np.abs(np.arctan2(middle[:, 1], middle[:, 0]) - 1.0) > 0.15).all()


def test_scans_of_a_nodding_laser_are_rows_while_the_robot_drives(room):
    poses = room.standing(60)
    poses[:, 0, 3] = 0.01 * np.arange(60)
    recording = room.scans(room.nodding(), poses)
    order, (patch,) = patches(recording, poses)
    assert order.is_planar
    assert len(patch.faces) > 0.85 * 2 * 59 * 60
    assert looks_back(patch).all()
    scan = patch.beam[patch.faces] // 61
    assert np.ptp(scan, axis=1).max() <= 2  # where it turns round, a row may be left out
    np.testing.assert_allclose(patch.origin[:, 0], 0.01 * (patch.beam // 61), atol=1e-12)


@pytest.mark.parametrize(("sensor", "made"), [("picture", (160, 120, 120.0)), ("lidar", (400, 60))])
def test_no_triangle_leads_from_a_thing_to_the_wall_behind(room, sensor, made):
    looking = getattr(room, sensor)(*made)
    box = [[1.5, -0.4, -0.5], [2.0, 0.4, 0.5]]
    poses = room.standing()
    recording = room.scans(looking, poses, box=box, noise=0.005)
    _, (patch,) = patches(recording, poses)
    on_box = (np.abs(patch.points - 1.75) < 0.3)[:, 0] & (room.off_walls(patch.points) > 0.1)
    assert on_box.sum() > 100
    mixed = np.ptp(on_box[patch.faces].astype(int), axis=1) > 0
    assert mixed.sum() == 0
    assert on_box[patch.faces].all(axis=1).sum() > 150


def test_the_floor_far_ahead_is_surface(room):
    looking = room.lidar(400, 60)
    _, (patch,) = patches(room.scans(looking, room.standing()), room.standing())
    floor = np.abs(patch.points[:, 2] + 1.2) < 1e-3
    far = patch.points[patch.faces][floor[patch.faces].all(axis=1)].mean(axis=1)
    assert np.linalg.norm(far[:, :2], axis=1).max() > 4.5
