"""Color maps of P(static), heights and ids."""

import numpy as np

from stillmap.results import colors
from stillmap.results.colors import ORANGE


def test_color_by_p_static():
    shown = colors.color_by_p_static(np.array([0.0, 0.5, 1.0], np.float32))
    assert shown.dtype == np.uint8
    assert shown[0].tolist() == list(ORANGE)
    assert shown[2].tolist() == list(colors.BLUE)
    assert len(set(shown[1].tolist())) == 1  # grey


def test_colors_of_successive_ids_differ():
    shown = colors.color_by_id(range(40)).astype(int)
    assert np.abs(np.diff(shown, axis=0)).sum(axis=1).min() > 100
    assert colors.color_by_id([]).shape == (0, 3)
