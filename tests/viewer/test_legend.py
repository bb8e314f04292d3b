"""Legend and scale bar."""

import re

import pytest

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

from stillmap.results.colors import BLUE, ORANGE, TEAL
from stillmap.results.viewer.legend import (
    legend_html,
    scale_length,
)


def colors(html):
    return {tuple(map(int, one)) for one in re.findall(r"rgb\((\d+), (\d+), (\d+)\)", html)}


def test_legend_names_visible_layers_alone(window):
    def told():
        window.step()
        return legend_html(window._layers, window._coloring.value, is_2d=False)

    assert "rays" not in told()
    window._boxes["Rays"].value = True
    window._boxes["Objects"].value = False
    html = told()
    assert "rays from the sensor" in html
    assert {TEAL, ORANGE, BLUE} <= colors(html)
    assert "moving objects" not in html
    for box in window._boxes.values():
        box.value = False
    assert colors(told()) == set()


@pytest.mark.parametrize(
    ("longest", "length"), [(0.3, 0.2), (1.0, 1.0), (4.9, 2.0), (5.0, 5.0), (99.0, 50.0)]
)
def test_scale_length(longest, length):
    assert scale_length(longest) == pytest.approx(length)
