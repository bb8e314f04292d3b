"""Which pictures are used, and from where they were taken."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap.core import se2, se3
from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.mesh import views as views_module
from stillmap.mesh.views import filter_readable, find_views

S = 10**9
K = np.array([[10.0, 0.0, 7.5], [0.0, 10.0, 5.5], [0.0, 0.0, 1.0]])
# looks ahead from half a metre above the robot
T_BASE_CAMERA = np.array(
    [[0.0, 0.0, 1.0, 0.2], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0]]
)
CAMERA = Camera("front", 16, 12, K, "", np.zeros(0), T_BASE_CAMERA)
TWIST = np.array([2.0, 0.3, 0.1, 0.05, -0.1, 0.4])  # m/s, rad/s


def colours(image: int) -> np.ndarray:
    return np.full((12, 16, 3), image, np.uint8)


def images(seconds, cameras=(CAMERA,), camera=None, load=colours) -> Images:
    stamp_ns = np.array([round(s * S) for s in seconds], np.int64)
    number = np.zeros(len(stamp_ns)) if camera is None else np.array(camera)
    return Images(stamp_ns, number.astype(np.int32), tuple(cameras), load)


def recording(seconds, pictures: Images | None) -> Recording:
    T = len(seconds)
    return of_one_sensor(
        np.array([round(s * S) for s in seconds], np.int64),
        np.arange(T + 1, dtype=np.int64),
        np.ones((T, 3), np.float32),
        np.ones(T, bool),
        images=pictures,
    )


def screw(seconds) -> np.ndarray:
    """Poses of steady motion."""
    return se3.exp(np.asarray(seconds, float)[:, None] * TWIST)


def test_a_picture_between_scans_is_taken_from_between_their_poses():
    scans = [0.0, 0.1, 0.25, 0.3]
    taken = [0.0, 0.04, 0.1, 0.2, 0.3]
    views, left_out = find_views(recording(scans, images(taken)), screw(scans))
    assert left_out == {}
    assert [view.image for view in views] == [0, 1, 2, 3, 4]
    assert [view.stamp_ns for view in views] == [round(s * S) for s in taken]
    for view, T in zip(views, screw(taken), strict=True):
        np.testing.assert_allclose(se2.inverse(view.T_camera_map), T @ T_BASE_CAMERA, atol=1e-12)
        # what is ahead of the robot is ahead of the camera, half a metre lower
        ahead = (T @ [3.2, 0.0, 0.0, 1.0])[None, :3]
        np.testing.assert_allclose(view.to_camera(ahead), [[0.0, 0.5, 3.0]], atol=1e-12)


def test_shortly_before_and_after_the_scans_the_motion_goes_on():
    scans = [1.0, 1.1, 1.2]
    taken = [0.85, 0.92, 1.25, 1.31]
    views, left_out = find_views(recording(scans, images(taken)), screw(scans))
    assert [view.image for view in views] == [1, 2]
    assert left_out == {"taken outside the time of the scans": 2}
    for view, T in zip(views, screw([0.92, 1.25]), strict=True):
        np.testing.assert_allclose(se2.inverse(view.T_camera_map), T @ T_BASE_CAMERA, atol=1e-12)


def test_in_a_gap_between_scans_only_a_robot_at_rest_is_known(monkeypatch):
    scans = [0.0, 0.1, 5.0, 5.1, 9.0]
    poses = screw([0.0, 0.1, 0.4, 0.4, 0.4])
    taken = [0.15, 2.0, 4.95, 7.0]
    views, left_out = find_views(recording(scans, images(taken)), poses)
    assert [view.image for view in views] == [0, 2, 3]
    what = "taken in a gap between scans in which the robot moved"
    assert left_out == {what: 1}
    np.testing.assert_allclose(se2.inverse(views[2].T_camera_map), poses[3] @ T_BASE_CAMERA)
    monkeypatch.setattr(views_module, "MAX_SCAN_GAP", 10.0)
    assert len(find_views(recording(scans, images(taken)), poses)[0]) == 4


def test_without_scans_or_pictures_there_are_no_views():
    poses = np.empty((0, 4, 4))
    what = {"taken outside the time of the scans": 1}
    assert find_views(recording([], images([0.0])), poses) == ([], what)
    assert find_views(recording([], None), poses) == ([], {})
    assert find_views(recording([0.0], images([])), screw([0.0])) == ([], {})


POSELESS = replace(CAMERA, T_base_camera=np.full((4, 4), np.nan))
UNUSABLE = [
    (replace(CAMERA, K=None), colours, "a camera without calibration"),
    (replace(CAMERA, T_base_camera=None), colours, "a camera without a known pose on the robot"),
    (POSELESS, colours, "whose pose on the robot is not finite"),
    (CAMERA, lambda _: np.zeros((12, 16), np.uint16), "without color (depth, or 16 bits)"),
    (CAMERA, lambda _: np.zeros((24, 32, 3), np.uint8), "of 32 x 24 pixels, calibrated for 16 x"),
]


@pytest.mark.parametrize(("camera", "load", "why"), UNUSABLE)
def test_cameras_whose_pictures_cannot_be_used(camera, load, why):
    def either(image: int) -> np.ndarray:
        return colours(image) if image == 1 else load(image)

    both = images([0.0, 0.0, 0.1], (camera, CAMERA), [0, 1, 0], either)
    views, left_out = find_views(recording([0.0, 0.1], both), screw([0.0, 0.1]))
    assert [view.image for view in views] == [1]
    ((reason, count),) = left_out.items()
    assert why in reason
    assert count == 2


def test_damaged_pictures_are_found_when_they_are_wanted():
    def load(image: int) -> np.ndarray:
        if image in (0, 2):
            raise InputError("is no picture")
        return colours(image)[: 6 if image == 3 else 12]

    pictures = images([0.0, 0.01, 0.02, 0.03], load=load)
    views, left_out = find_views(recording([0.0, 0.1], pictures), screw([0.0, 0.1]))
    assert len(views) == 4
    assert left_out == {}
    told = []
    kept, unread = filter_readable(pictures, views, lambda *done: told.append(done))
    assert [view.image for view in kept] == [1]
    assert unread[:2] == ["is no picture"] * 2
    assert "got (6, 16, 3)" in unread[2]
    assert told == [(k, 4) for k in (1, 2, 3, 4)]

    def never(image: int) -> np.ndarray:
        raise InputError(f"{image} is no picture")

    views, left_out = find_views(recording([0.0], images([0.0] * 9, load=never)), screw([0.0]))
    assert (views, left_out) == ([], {"images that cannot be read": 9})
