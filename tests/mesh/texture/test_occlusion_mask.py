"""What beams say of a picture."""

import numpy as np
import pytest

from stillmap.core.camera import Camera
from stillmap.mesh import visibility
from stillmap.mesh.views import View
from stillmap.mesh.visibility import build_occlusion_mask

CAMERA = Camera(
    "eye",
    640,
    480,
    np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]]),
    "",
    np.zeros(0),
    np.eye(4),
)
# the camera's own frame is the map's: z is ahead
AHEAD = View(0, 0, CAMERA, np.eye(4))


@pytest.fixture(autouse=True)
def wide_outlines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(visibility, "OUTLINE_MARGIN", 0.15)


def _shown(points: np.ndarray, p: np.ndarray, asked: np.ndarray) -> np.ndarray:
    found = build_occlusion_mask(AHEAD, points, p.astype(np.float32))
    uv = 400.0 * asked[:, :2] / asked[:, 2:] + [320.0, 240.0]
    return found.p_unoccluded(uv, asked[:, 2], np.full(len(asked), 0.9))


def test_behind_what_moves_nothing_is_seen_and_before_it_all() -> None:
    mover, p = np.array([[0.0, 0.0, 3.0]]), np.array([0.02])
    asked = np.array([[0.0, 0, 6.0], [0.0, 0.0, 2.0], [3.0, 0.0, 6.0]])
    got = _shown(mover, p, asked)
    np.testing.assert_allclose(got, [0.02, 0.9, 0.9], atol=1e-6)


def test_what_moves_is_larger_than_where_beams_met_it() -> None:
    mover, p = np.array([[0.0, 0.0, 3.0]]), np.array([0.0])
    aside = np.linspace(0.0, 0.5, 26)
    asked = np.stack([2.0 * aside, np.zeros(26), np.full(26, 6.0)], axis=1)
    hidden = _shown(mover, p, asked) < 0.5
    # 0.15 m and 1 cm per metre to the side, on cells of 8 pixels: 6 cm there
    assert hidden[aside <= 0.12].all()
    assert not hidden[aside >= 0.27].any()


def test_beams_that_end_on_what_stands_still_speak_for_a_picture() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-1, 1, (4000, 2)), np.full(4000, 5.0)])
    asked = np.array([[0.0, 0.0, 5.0], [3.0, 0.0, 5.0]])
    got = _shown(wall, np.ones(4000), asked)
    assert got[0] > 0.99
    assert got[1] < 0.91
