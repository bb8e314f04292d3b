"""Cameras in simulated worlds: what they show, when and from where, and the truth about it."""

from dataclasses import replace

import numpy as np
import pytest
from marks import slow_params
from true_surfaces import place_parts, project_to_solid, project_to_static

from stillmap import io as recordings
from stillmap.sim import scene_by_name, simulate, write_simulation
from stillmap.sim.camera import SKY, compute_pixel_rays, compute_static_color
from stillmap.sim.options import CameraOptions
from stillmap.sim.truth import load_image_truth

SMALL = {"width": 96, "height": 72, "noise": 0.0}


def _scene(name, camera, lidar=8):
    sensors = {"channels": lidar, "columns": 60}
    looks = {"enabled": True, **SMALL, **camera}
    return scene_by_name(name, {"lidar": sensors, "robot": {"scans": 12}, "camera": looks})


@pytest.fixture(scope="module")
def street():
    return simulate(_scene("street", {"count": 2}), 4)


@pytest.fixture(scope="module")
def rig():
    changes = {
        "rig": {"tilts": True},
        "robot": {"scans": 60, "scan_rate": 37.5},
        "crowd": {"people": 40},
        "camera": {"enabled": True, **SMALL},
    }
    return simulate(scene_by_name("hall", changes), 2)


def _seen(one, image):
    """(h, w, 3) where the pixels' rays end in the world, and the mask."""
    shot, images = one.photographs.render(image), one.recording.images
    T = one.photographs.T_world_camera[image]
    rays = (
        np.moveaxis(compute_pixel_rays(images.cameras[images.camera[image]]), 0, -1) @ T[:3, :3].T
    )
    with np.errstate(invalid="ignore"):
        return T[:3, 3] + shot.distance[..., None] * rays, shot.mask


@pytest.mark.parametrize("which", [*slow_params("street"), "rig"])
def test_pixels_show_the_true_surfaces_in_their_colours(which, request):
    made = request.getfixturevalue(which)
    one = made.tilting if which == "rig" else made
    surfaces, movers = one.photographs.truth(), 0
    for image in range(len(one.recording.images)):
        places, mask = _seen(one, image)
        static = places[mask == 0]
        off, _ = project_to_static(surfaces.standing, static)
        assert off.max() < 1e-4  # float32 of 100 m
        near = np.linalg.norm(static - surfaces.T_world_camera[image, :3, 3], axis=1) < 3.0
        shows = one.recording.images.read(image)[mask == 0][near].astype(float)
        wanted = compute_static_color(static[near], surfaces.colour_seed).astype(float)
        # but for places beside an edge of the texture, and what is averaged within a pixel
        assert np.median(np.abs(shows - wanted)) <= 6.0
        stamp = int(one.recording.images.stamp_ns[image])
        for number in np.unique(mask[(mask > 0) & (mask != SKY)]).tolist():
            moving, at = surfaces.moving, places[mask == number]
            solids = place_parts(moving, moving.parts(number - 1), stamp)
            gaps = [project_to_solid(at, solids, k) - at for k in range(len(solids.form))]
            # a person's legs swing between two scans
            assert np.linalg.norm(gaps, axis=2).min(axis=0).max() < 0.03
            movers += 1
    assert movers > 0


def test_a_ring_of_cameras_looks_all_around_and_sees_the_sky(street):
    images = street.recording.images
    shot = street.photographs.render(0)
    assert np.array_equal(shot.mask == SKY, np.isinf(shot.distance))
    assert 0.1 < np.mean(shot.mask == SKY) < 0.7
    r, _, b = np.median(shot.color[shot.mask == SKY], axis=0)
    assert b > max(r, 200)
    ahead, behind = (np.asarray(camera.T_base_camera) for camera in images.cameras)
    assert np.allclose(ahead[:2, 2], -behind[:2, 2])
    assert np.array_equal(images.camera[:4], [0, 1, 0, 1])
    assert images.stamp_ns[0] == images.stamp_ns[1] < images.stamp_ns[2]


def test_cameras_leave_everything_else_as_it_is():
    with_camera = _scene("street", {})
    seen = simulate(with_camera, 4)
    blind = simulate(replace(with_camera, camera=CameraOptions()), 4)
    assert np.array_equal(seen.recording.points, blind.recording.points)
    assert np.array_equal(seen.recording.stamp_ns, blind.recording.stamp_ns)
    assert np.array_equal(seen.truth.movers, blind.truth.movers, equal_nan=True)
    assert blind.recording.images is None
    assert blind.photographs is None
    assert "camera" not in blind.truth.scene
    assert "colour_seed" not in blind.truth.scene
    assert seen.truth.scene["camera"]["width"] == 96


def test_pictures_are_the_same_however_often_they_are_read():
    scene = _scene("street", {"noise": 5.0, "exposure": 0.2})
    images, others = simulate(scene, 4).recording.images, simulate(scene, 4).recording.images
    assert np.array_equal(images.read(1), images.read(1))
    assert np.array_equal(images.read(1), others.read(1))
    brightness = [float(images.read(image).mean()) for image in range(len(images))]
    assert max(brightness) > 1.05 * min(brightness)


def test_folders_hold_pictures_and_their_truth(rig, tmp_path):
    write_simulation(rig, tmp_path / "rig")
    assert not (tmp_path / "rig/horizontal/images").exists()
    images = recordings.read(tmp_path / "rig/tilting").images
    truth, made = load_image_truth(tmp_path / "rig/tilting"), rig.tilting
    surfaces = made.photographs.truth()
    assert np.array_equal(images.read(2), made.recording.images.read(2))
    assert np.array_equal(truth.mask(2), surfaces.mask(2))
    near = np.isfinite(truth.distance(2))
    assert np.allclose(truth.distance(2)[near], surfaces.distance(2)[near], atol=6e-4)
    assert np.array_equal(truth.T_world_camera, surfaces.T_world_camera)
    assert truth.colour_seed == made.truth.scene["colour_seed"]
    points = np.random.default_rng(0).uniform(-20, 20, (100, 3))
    found, wanted = (project_to_static(one.standing, points) for one in (truth, surfaces))
    assert all(map(np.array_equal, found, wanted))
