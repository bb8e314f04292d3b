"""map.pgm and map.yaml against the rules of map_server."""

import dataclasses

import numpy as np
import pytest
import yaml
from map_server_rules import load
from PIL import Image

from stillmap.results.map_server import raw_pixels, trinary_pixels, write_map_server

P = np.array(
    [
        [0.0, 0.1959, 0.196, 0.5],
        [0.65, 0.6501, 1.0, np.nan],
        [0.64999, 0.19601, np.nan, 0.3],
    ],
    np.float32,
)
# read off the numbers above; -1 unknown, row 0 lowest y
TRINARY = np.array([[0, 0, -1, -1], [-1, 100, 100, -1], [-1, -1, -1, -1]])


def pixels_of(folder):
    return np.asarray(Image.open(folder / "map.pgm"))


@pytest.fixture
def small(result):
    return dataclasses.replace(result.map, p_occupied=P, origin=(-1.5, 2.25, 0.0), resolution=0.05)


def test_trinary_reads_as_meant(tmp_path, small):
    write_map_server(tmp_path, small)
    np.testing.assert_array_equal(load(tmp_path / "map.yaml").cells, TRINARY)
    assert yaml.safe_load((tmp_path / "map.yaml").read_text()) == {
        "image": "map.pgm",
        "mode": "trinary",
        "resolution": 0.05,
        "origin": [-1.5, 2.25, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    assert set(np.unique(pixels_of(tmp_path))) == {0, 205, 254}


def test_origin_is_written_without_rounding_errors(tmp_path, small):
    off = -509 * 0.05
    assert str(off) != "-25.45"
    write_map_server(tmp_path, dataclasses.replace(small, origin=(off, 0.1 + 0.2, 0.0)))
    assert "origin: [-25.45, 0.3, 0.0]" in (tmp_path / "map.yaml").read_text()


def test_top_row_of_the_picture_is_the_highest_y(tmp_path, small):
    p = np.full((2, 3), np.nan, np.float32)
    p[1, 0] = 1.0
    write_map_server(tmp_path, dataclasses.replace(small, p_occupied=p))
    np.testing.assert_array_equal(pixels_of(tmp_path), [[0, 205, 205], [205, 205, 205]])


def test_raw_is_percent(tmp_path, small):
    write_map_server(tmp_path, small, "raw")
    cells = load(tmp_path / "map.yaml").cells
    expected = np.where(np.isnan(P), -1, np.round(np.nan_to_num(100 * P.astype(float))))
    np.testing.assert_array_equal(cells, expected)
    assert raw_pixels(P)[1, 3] == 255


def test_scale_grades_what_lies_between_and_agrees_with_trinary_elsewhere(tmp_path, small):
    p = np.concatenate([np.linspace(0, 1, 4001), [np.nan]]).astype(np.float32)[None]
    write_map_server(tmp_path, dataclasses.replace(small, p_occupied=p), "scale")
    cells = load(tmp_path / "map.yaml").cells
    assert not (tmp_path / "map.pgm").exists()
    known = cells[0, :-1]
    assert cells[0, -1] == -1
    np.testing.assert_array_equal(known == 100, p[0, :-1] > np.float32(0.65))
    free = p[0, :-1] < np.float32(0.196)
    assert np.all(known[free] == 0)
    between = ~free & (known != 100)
    expected = (p[0, :-1][between] - 0.196) / (0.65 - 0.196) * 100
    assert np.abs(known[between] - expected).max() <= 0.5 + 100 / 255 / 2 / (0.65 - 0.196) + 0.5


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
def test_a_map_without_cells_is_one_unknown_pixel(tmp_path, small, mode):
    write_map_server(
        tmp_path, dataclasses.replace(small, p_occupied=np.zeros((0, 0), np.float32)), mode
    )
    np.testing.assert_array_equal(load(tmp_path / "map.yaml").cells, [[-1]])


def test_input_is_left_alone():
    before = P.copy()
    trinary_pixels(P)
    np.testing.assert_array_equal(P, before)
