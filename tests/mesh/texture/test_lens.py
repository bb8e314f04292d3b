"""Points in pictures, against numbers by OpenCV 4 and formulas written out by hand."""

import numpy as np
import pytest

from stillmap.core import camera as camera_module
from stillmap.core.camera import Camera

K = np.array([[500.0, 0.0, 320.5], [0.0, 480.0, 239.25], [0.0, 0.0, 1.0]])
POINTS = np.array([[0.27392337, -0.46042657, 1.75053227], [-0.91805295, -0.96694473, 2.14565516]])
# cv2.projectPoints and cv2.fisheye.projectPoints of the two points above
BY_OPENCV = [
    (
        "plumb_bob",
        [0.2624, -0.9531, -0.0054, 0.0026, 1.1633],
        [[400.4912467499093, 110.1278544739227], [100.90086891736871, 15.699165409979685]],
    ),
    (
        "rational_polynomial",
        [0.8, -2.2, 5e-4, -3e-4, 1.4, 0.7, -2.0, 1.35],
        [[399.26878291016135, 112.14655880965691], [104.17212907409237, 20.666574338258044]],
    ),
    (
        "equidistant",
        [-0.01, 0.02, -0.005, 0.001],
        [[396.37052244636766, 116.82345476153054], [129.33375636340966, 45.956896852167574]],
    ),
    (
        "equidistant",
        [],
        [[396.4259357096546, 116.7340385539461], [129.08134815223738, 45.70168042133042]],
    ),
]
FOLDING = [  # models whose polynomials fall again
    ("plumb_bob", [-0.3, 0.0, 0.0, 0.0]),
    ("rational_polynomial", [-0.3, 0.0, 0.001, 0.0, 0.0, -0.2, 0.0, 0.0]),
    ("equidistant", [-0.3, 0.0, 0.0, 0.0]),
]


def camera(model: str = "", distortion: tuple[float, ...] | list[float] = ()) -> Camera:
    return Camera("c", 640, 480, K, model, np.array(distortion, np.float64), None)


def fan(n: int = 41, widest: float = 88.0) -> np.ndarray:
    """Points in all directions ahead, up to so many degrees from the axis."""
    angle, around = np.meshgrid(
        np.radians(np.linspace(0.0, widest, n)), np.linspace(0.0, 2.0 * np.pi, 33)
    )
    aside = np.sin(angle)
    return np.stack(
        [aside * np.cos(around), aside * np.sin(around), np.cos(angle)], axis=-1
    ).reshape(-1, 3)


@pytest.mark.parametrize(("model", "distortion", "expected"), BY_OPENCV)
def test_pixels_are_those_of_opencv(model, distortion, expected):
    uv, ok = camera_module.project(camera(model, distortion), POINTS)
    assert ok.all()
    np.testing.assert_allclose(uv, expected, atol=1e-9)


@pytest.mark.parametrize("model", ["", "plumb_bob", "rational_polynomial", "equidistant"])
def test_what_lies_behind_or_beside_is_not_seen(model):
    points = np.array(
        [[0.1, 0.1, -1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 1.0], [0.0, 0.0, np.nan]]
    )
    uv, ok = camera_module.project(camera(model), points)
    assert not ok.any()
    assert np.isnan(uv).all()


@pytest.mark.parametrize(("model", "distortion"), FOLDING)
def test_no_two_directions_share_a_pixel(model, distortion):
    folding = camera(model, distortion)
    points = fan(181)
    uv, ok = camera_module.project(folding, points)
    assert 0.1 < ok.mean() < 0.95
    # within the limit, the way back is the way there
    found = camera_module.unproject(folding, uv[ok])
    np.testing.assert_allclose(found[:, :2], points[ok][:, :2] / points[ok][:, 2:], atol=1e-4)


@pytest.mark.parametrize(("model", "distortion", "_"), [*BY_OPENCV, ("", [], [])])
def test_rays_lead_through_their_pixels(model, distortion, _):
    seen_by = camera(model, distortion)
    columns, rows = np.meshgrid(np.arange(0, 640, 7.0), np.arange(0, 480, 7.0))
    uv = np.column_stack([columns.ravel(), rows.ravel()])
    directions = camera_module.unproject(seen_by, uv)
    np.testing.assert_array_equal(directions[:, 2], 1.0)
    again, ok = camera_module.project(seen_by, 3.7 * directions)
    assert ok.all()
    np.testing.assert_allclose(again, uv, atol=1e-6)


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (Camera("c", 1, 1, np.zeros((3, 3)), "", np.zeros(0), None), "invalid calibration"),
        (Camera("c", 1, 1, np.full((3, 3), np.nan), "", np.zeros(0), None), "invalid calibration"),
        (Camera("c", 1, 1, np.full((3, 3), 1e200), "", np.zeros(0), None), "invalid calibration"),
        (camera("plumb_bob", [0.1, 1e200, 0.0, 0.0]), "far too large"),
        (camera("plumb_bob", [0.1, 0.2]), "2 parameters (plumb_bob)"),
    ],
)
def test_what_cannot_be_used_says_why(given, why):
    assert why in camera_module.calibration_error(given)
    with pytest.raises(ValueError, match="c: a "):
        camera_module.project(given, POINTS)
