"""Polygons of range images: how sensors look about, and which triangles are surface."""

import dataclasses

import numpy as np
import pytest

from stillmap.mesh import range_image, triangulation
from stillmap.mesh.range_image import find_scan_layout, triangulate_scans
from stillmap.mesh.triangle_mesh import Mesh
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


def test_no_rows_where_there_is_no_order(room):
    rng = np.random.default_rng(1)
    assert range_image.find_row_length(rng.permutation(room.lidar())) == 0
    assert range_image.find_row_length(room.lidar()[rng.random(24 * 240) < 0.8][:4500]) == 0
    assert range_image.find_row_length(np.full((1000, 3), np.nan)) == 0


def test_planar_lasers_are_told_from_others(room):
    assert range_image.is_planar(room.nodding()[7])
    assert not range_image.is_planar(room.lidar())
    assert not range_image.is_planar(room.picture())
    assert not range_image.is_planar(np.tile([1.0, 0.0, 0.0], (50, 1)))


@pytest.mark.parametrize("rows_are", ["columns", "rings"])
def test_a_turn_closes(room, rows_are):
    recording = room.scans(room.lidar(rows_are=rows_are), room.standing())
    _, (patch,) = patches(recording, room.standing())
    # all squares between 24 rings, all around, but those that go around an edge of the room
    assert len(patch.faces) > 0.97 * 2 * 23 * 240
    assert looks_back(patch).all()
    azimuth = np.arctan2(*patch.points[patch.faces].mean(axis=1)[:, 1::-1].T)
    assert np.histogram(azimuth, 24, (-np.pi, np.pi))[0].min() > 0.9 * len(azimuth) / 24


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


def test_the_joint_may_be_told_by_where_the_laser_sits(room):
    """As in bags: each scan is of a sensor of its own."""
    poses = room.standing(60)
    turned = room.scans(room.nodding(), poses)
    R = np.tile(np.eye(4), (60, 1, 1))
    R[:, :3, :3] = room.nods(60)
    points = np.einsum("tji,tnj->tni", R[:, :3, :3], turned.points.reshape(60, -1, 3))
    told = dataclasses.replace(
        turned,
        points=points.reshape(-1, 3).astype(np.float32),
        T_base_sensor=R,
        sensor=np.arange(60, dtype=np.int32),
    )
    _, (one,) = patches(turned, poses)
    _, (other,) = patches(told, poses)
    assert looks_back(other).all()
    areas = [Mesh(patch.points, patch.faces).areas().sum() for patch in (one, other)]
    assert areas[1] == pytest.approx(areas[0], rel=0.01)  # rounding chooses between diagonals


def test_no_triangle_spans_a_pause(room):
    recording = room.scans(room.nodding(), room.standing(60))
    recording.stamp_ns[30:] += 5 * 10**9
    _, two = patches(recording, room.standing(60))
    assert len(two) == 2
    assert two[0].beam.max() < 30 * 61 <= two[1].beam.min()


def test_points_beams_and_distances_belong_together(room):
    poses = room.standing(1, [0.5, 0.2, 0.1])
    recording = room.scans(room.lidar(), poses)
    recording.hit[::7] = False
    recording.points[3::11] = np.nan
    _, (patch,) = patches(recording, poses)
    np.testing.assert_allclose(patch.points, recording.end_points(patch.beam, poses), atol=1e-9)
    assert recording.hit[patch.beam].all()
    assert np.isfinite(patch.points).all()
    across = np.abs(patch.points[:, None] - np.array([[-3, -2, -1.2], [5, 3, 1.6]]))
    wall = across.reshape(-1, 6).argmin(axis=1)
    middle = np.abs(poses[0, :3, 3] - np.array([[-3, -2, -1.2], [5, 3, 1.6]])).ravel()[wall]
    flat = np.sort(across.reshape(-1, 6), axis=1)[:, 1] > 0.5  # far from edges
    assert flat.mean() > 0.4
    # normals are those of what is around, at edges of the room too
    assert np.mean(np.abs(patch.standoff - middle)[flat] < 0.02) > 0.85


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


def test_noise_makes_no_holes(room):
    """Beams lie closer together than ranges are exact."""
    looking = room.picture(160, 120, 300.0)
    _, (clean,) = patches(room.scans(looking, room.standing()), room.standing())
    _, (noisy,) = patches(room.scans(looking, room.standing(), noise=0.03), room.standing())
    assert len(noisy.faces) > 0.97 * len(clean.faces)


def test_long_edges_are_holes(room, monkeypatch):
    recording = room.scans(room.lidar(), room.standing())
    _, (loose,) = patches(recording, room.standing())
    monkeypatch.setattr(triangulation, "_MAX_EDGE", 0.3)
    monkeypatch.setattr(triangulation, "_MAX_EDGE_SHARE", 0.1)
    _, (patch,) = patches(recording, room.standing())
    assert 0 < len(patch.faces) < len(loose.faces)
    corners = patch.points[patch.faces]
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max() <= 0.3


def test_scans_without_surface_are_no_trouble(room):
    recording = room.scans(room.lidar(), room.standing(3))
    recording.hit[:] = False
    _, three = patches(recording, room.standing(3))
    assert [len(one.faces) for one in three] == [0, 0, 0]
    assert [len(one.points) for one in three] == [0, 0, 0]


def test_returns_at_the_sensor_are_no_trouble(room):
    looking = np.random.default_rng(0).permutation(room.lidar())
    recording = room.scans(looking, room.standing())
    recording.points[5:8] = 0.0
    _, (patch,) = patches(recording, room.standing())
    assert len(patch.faces) > 5000
    assert not np.isin([5, 6, 7], patch.beam).any()
