"""Colours of points on what moves: one board that is carried before a camera."""

from types import SimpleNamespace

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap.core.camera import Camera, Images
from stillmap.mesh.inputs import MeshInputs, TrackedBox
from stillmap.mesh.mover_colors import color_moving
from stillmap.mesh.place import Background, ViewAssignment
from stillmap.mesh.returns import DynamicReturns
from stillmap.mesh.texture import GRAY
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.mesh.views import View, read_color_image
from stillmap.tracking.boxes import Box

SPEED, AHEAD = 2.0, 3.0  # m/s to the right, along x; m from the camera, along y
BOARD = np.stack(np.meshgrid(np.arange(-0.5, 0.51, 0.05), np.arange(0.2, 1.81, 0.05)), -1)
BOARD = BOARD.reshape(-1, 2)  # x, z
INNER = (np.abs(BOARD - [0.0, 1.0]) < [0.2, 0.5]).all(axis=1)
TIMES = (0.0, 0.1)  # s, of two scans that see all of it
NOTHING = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
K = np.array([[200.0, 0, 160], [0, 200.0, 120], [0, 0, 1]])
CAMERA = Camera("camera", 320, 240, K, "", np.zeros(0), np.eye(4))
T_CAMERA_MAP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 1], [0, 1, 0, 0], [0, 0, 0, 1]])  # 1 m high


def thing(number: int, x: float, y: float, half: tuple[float, float], speed: float) -> TrackedBox:
    at = np.array([[x, y], [x + speed, y]])
    ahead, velocity = np.tile([1.0, 0.0], (2, 1)), np.tile([speed, 0.0], (2, 1))
    box = Box(number, np.array([0.0, 1.0]), at, ahead, velocity, half, 0.5)
    return TrackedBox(box, np.zeros(2), 2.0)


def board_seen(*others: TrackedBox) -> DynamicReturns:
    n = len(BOARD)
    ends = [
        np.column_stack([BOARD[:, 0] + SPEED * t, np.full(n, AHEAD), BOARD[:, 1]]) for t in TIMES
    ]
    recording = of_one_sensor(
        np.array([round(1e9 * t) for t in TIMES]),
        np.array([0, n, 2 * n]),
        np.concatenate(ends).astype(np.float32),
        np.ones(2 * n, np.bool_),
    )
    sources = MeshInputs(
        recording=recording,
        deskewed=recording,
        poses=np.tile(np.eye(4), (2, 1, 1)),
        p_static=np.full(2 * n, 0.1, np.float32),
        objects=[SimpleNamespace(id=7, beams=np.arange(2 * n))],
        boxes=[thing(7, 0.0, AHEAD, (0.6, 0.2), SPEED), *others],
        start_ns=0,
    )
    return DynamicReturns.collect(sources).tracked()


def view(number: int, seconds: float) -> View:
    return View(number, round(1e9 * seconds), CAMERA, T_CAMERA_MAP)


def pictures(load) -> Images:
    cameras = np.zeros(9, np.int32)
    return Images(np.arange(9, dtype=np.int64), cameras, (CAMERA,), load)


def columns(image: int) -> np.ndarray:
    """Red and green say in which column of which picture one looks."""
    out = np.zeros((240, 320, 3), np.uint8)
    out[..., 0], out[..., 1], out[..., 2] = np.arange(320) // 2, 20 * image, 200
    return out


def tint(moving, views, load=columns, place=NOTHING):
    n = moving.inputs.recording.n_beams
    out, late = np.full((n, 3), GRAY[0], np.uint8), np.full(n, np.inf, np.float32)
    images, none = pictures(load), np.full(len(place), -1)
    still = ViewAssignment(place, none, np.zeros(len(place), np.float32), none < 0)
    ahead = Background(still, views, lambda one: read_color_image(images, one))
    for number in range(len(views)):
        color_moving(out, late, moving, number, ahead)
    return out.reshape(2, -1, 3), late.reshape(2, -1)


def test_points_are_looked_up_where_the_thing_has_gone_to():
    colours, late = tint(board_seen(), [view(1, 0.3)])
    for scan, time in enumerate(TIMES):
        has = (colours[scan] != GRAY).any(axis=1)
        assert 0.3 < has.mean() < 1.0
        assert late[scan, has] == pytest.approx(0.3 - time)
        expected = 160.0 + 200.0 * (BOARD[:, 0] + SPEED * 0.3) / AHEAD
        np.testing.assert_allclose(colours[scan, has, 0], expected[has] / 2.0, atol=1.0)
        # its edge may show what is behind, the more the longer it went
        inside = np.minimum(0.5 - np.abs(BOARD[:, 0]), 0.8 - np.abs(BOARD[:, 1] - 1.0))
        needed = 0.02 + 0.1 * SPEED * (0.3 - time)
        assert inside[has].min() > needed - 0.04
        assert has[inside > needed + 0.04].all()


def wall(y: float) -> Mesh:
    """To the left of x = 0, facing the camera."""
    corners = np.array([[-9.0, y, -9.0], [0.0, y, -9.0], [0.0, y, 9.0], [-9.0, y, 9.0]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def test_what_stands_still_hides_what_is_behind_it():
    left = BOARD[:, 0] < -0.05
    near, _ = tint(board_seen(), [view(1, 0.0)], place=wall(2.0))
    assert (near[0, left] == GRAY).all()
    assert (near[0, ~left] != GRAY).any()
    behind, _ = tint(board_seen(), [view(1, 0.0)], place=wall(4.0))
    assert (behind[0, left] != GRAY).any()


def test_another_thing_hides_what_is_behind_it():
    other = thing(8, 0.0, 1.5, (0.05, 0.05), 0.0)
    covered, _ = tint(board_seen(other), [view(1, 0.0)])
    alone, _ = tint(board_seen(), [view(1, 0.0)])
    assert (covered[0, INNER] == GRAY).all()
    assert (alone[0, INNER] != GRAY).any()
    far, _ = tint(board_seen(thing(8, 0.0, 4.5, (0.05, 0.05), 0.0)), [view(1, 0.0)])
    np.testing.assert_array_equal(far, alone)
