"""Calibration of the color camera against depth edges."""

import numpy as np
import pytest
from PIL import Image

from stillmap.io import read
from stillmap.io.rgbd import T_BASE_CAMERA

W, H = 320, 240
DEPTH = (292.5, 160.0, 120.0, 0.0, 0.0)  # focal length, centre, metres to the right and down
BESIDE = (264.0, 161.5, 118.8, 0.029, -0.004)


def boards(rng: np.random.Generator) -> np.ndarray:
    """(n, 5) x0, y0, x1, y1, z of boards that face the camera, the nearest first."""
    z = np.sort(rng.uniform(1.0, 3.0, 12))
    x, y = rng.uniform(-0.6, 0.5, 12) * z, rng.uniform(-0.45, 0.35, 12) * z
    wide, high = rng.uniform(0.15, 0.5, (2, 12))
    return np.column_stack([x, y, x + wide, y + high, z])


def seen(camera, placed: np.ndarray) -> np.ndarray:
    """(H, W) which board a camera sees in each pixel, the number of boards for the wall behind."""
    f, cx, cy, right, down = camera
    columns, rows = np.meshgrid(np.arange(W), np.arange(H))
    out = np.full((H, W), len(placed))
    for number in reversed(range(len(placed))):
        x0, y0, x1, y1, z = placed[number]
        x, y = (columns - cx) / f * z + right, (rows - cy) / f * z + down
        out[(x >= x0) & (x < x1) & (y >= y0) & (y < y1)] = number
    return out


def write(folder, colour_camera):
    """Six views of boards, each of a colour, before a wall."""
    for k in range(6):
        rng = np.random.default_rng(k)
        placed = boards(rng)
        depth = np.append(placed[:, 4], 4.0)[seen(DEPTH, placed)]
        colours = rng.integers(30, 226, (13, 3))[seen(colour_camera, placed)]
        noisy = np.clip(colours + rng.normal(0.0, 4.0, colours.shape), 0, 255).astype(np.uint8)
        name = folder / f"frame-{k:06d}"
        Image.fromarray(np.round(1000.0 * depth).astype(np.uint16)).save(f"{name}.depth.png")
        Image.fromarray(noisy).save(f"{name}.color.png")
    f, cx, cy, *_ = DEPTH
    np.savetxt(folder / "camera-intrinsics.txt", [[f, 0, cx], [0, f, cy], [0, 0, 1]])
    return folder


def pixels(camera, points: np.ndarray) -> np.ndarray:
    f, cx, cy, right, down = camera
    return np.column_stack(
        [
            f * (points[:, 0] - right) / points[:, 2] + cx,
            f * (points[:, 1] - down) / points[:, 2] + cy,
        ]
    )


def test_a_colour_camera_beside_is_found(tmp_path):
    found = read(write(tmp_path, BESIDE))
    (camera,) = found.images.cameras
    assert camera.K[0, 0] == pytest.approx(BESIDE[0], rel=0.02)
    assert any("not registered to color" in warning for warning in found.source.warnings)
    # what counts is where things are seen
    offset = (np.linalg.inv(T_BASE_CAMERA) @ camera.T_base_camera)[:3, 3]
    as_found = (camera.K[0, 0], camera.K[0, 2], camera.K[1, 2], *offset[:2])
    rng = np.random.default_rng(9)
    z = rng.uniform(1.0, 4.0, 200)
    points = np.column_stack([rng.uniform(-0.4, 0.4, 200) * z, rng.uniform(-0.3, 0.3, 200) * z, z])
    error = np.linalg.norm(pixels(as_found, points) - pixels(BESIDE, points), axis=1)
    assert np.median(error) < 0.5
    assert error.max() < 1.5


def test_where_depth_is_laid_over_both_are_one(tmp_path):
    found = read(write(tmp_path, DEPTH))
    (camera,) = found.images.cameras
    assert camera.K[0, 0] == DEPTH[0]
    np.testing.assert_array_equal(camera.T_base_camera, T_BASE_CAMERA)
    assert len(found.source.warnings) == 1  # no times


@pytest.mark.parametrize("spoilt", ["grey", "damaged", "flat"])
def test_pictures_that_tell_nothing(tmp_path, spoilt):
    write(tmp_path, BESIDE)
    for file in tmp_path.glob("*.png"):
        if "color" in file.name and spoilt == "grey":
            Image.fromarray(np.full((H, W), 90, np.uint8)).save(file)
        elif "color" in file.name and spoilt == "damaged":
            file.write_bytes(file.read_bytes()[:400])
        elif "depth" in file.name and spoilt == "flat":
            Image.fromarray(np.full((H, W), 2000, np.uint16)).save(file)
    found = read(tmp_path)
    assert found.images.cameras[0].K[0, 0] == DEPTH[0]
