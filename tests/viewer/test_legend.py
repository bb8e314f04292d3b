"""Legend and scale bar."""

import re

import pytest

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

from stillmap.results.colors import BLUE, ORANGE, TEAL
from stillmap.results.viewer.legend import (
    legend_html,
    scale_length,
)
from stillmap.results.viewer.scene import read_scene


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


def test_color_map_of_heights_has_numbers(window):
    html = legend_html(window._layers, "height", is_2d=False)
    low, high = window._layers.heights
    shown = [float(one) for one in re.findall(r"<span>(-?[\d.]+)</span>", html)]
    assert shown == pytest.approx([low + n / 4 * (high - low) for n in range(5)], abs=0.051)
    assert "height z in m" in html


def test_2d_legend_says_what_is_unknown(result_of, opened):
    flat = opened(read_scene(result_of(2)), None)
    assert "unknown" in legend_html(flat._layers, "label", is_2d=True)


@pytest.mark.parametrize(
    ("longest", "length"), [(0.3, 0.2), (1.0, 1.0), (4.9, 2.0), (5.0, 5.0), (99.0, 50.0)]
)
def test_scale_length(longest, length):
    assert scale_length(longest) == pytest.approx(length)
