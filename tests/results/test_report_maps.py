"""Images of maps in the report."""

import dataclasses

import numpy as np
import pytest
from PIL import Image

from stillmap.results.colors import ORANGE
from stillmap.results.map_server import write_map_server
from stillmap.results.report.figures import (
    UNKNOWN,
    MapView,
    count_in_squares,
    draw_map,
    draw_points,
    draw_snapshot,
    draw_thinly_observed,
    map_window,
    reduce_levels,
)
from stillmap.results.report.maps import draw_written_map


def small_map(result, p):
    return dataclasses.replace(result.map, p_occupied=p, origin=(0.0, 0.0, 0.0), resolution=1.0)


@pytest.mark.parametrize("factor", [1, 2, 7])
def test_squares_of_cells(factor):
    rng = np.random.default_rng(factor)
    p = rng.beta(0.3, 0.8, (23, 31)).astype(np.float32)
    p[rng.random(p.shape) < 0.6] = np.nan
    levels, count = reduce_levels(p, factor), count_in_squares(p > 0.5, factor)
    for i, j in np.ndindex(levels.shape):
        square = p[i * factor :, j * factor :][:factor, :factor]
        known = square[~np.isnan(square)].astype(np.float64)
        expected = 101
        if len(known):
            expected = round(100 * (known.max() if known.max() > 0.65 else known.mean()))
        assert levels[i, j] == expected
        assert count[i, j] == (square > 0.5).sum()


def test_map_and_layers_have_a_pixel_for_a_cell(result):
    p = np.array([[0, 1, np.nan], [np.nan, 0, 0]], np.float32)
    pixels = np.asarray(draw_map(small_map(result, p), (0, 0, 3, 2)).convert("RGB"))
    white, black = (255, 255, 255), (0, 0, 0)
    np.testing.assert_array_equal(pixels, [[UNKNOWN, white, white], [white, black, UNKNOWN]])
    points = np.array([[0.5, 0.5], [2.5, 1.5], [9.0, 9.0], [-0.1, 0.5]], np.float32)
    dots = np.asarray(draw_points(points, MapView((0, 0, 3, 2), (3, 2))))
    np.testing.assert_array_equal(dots, [[0, 0, 1], [1, 0, 0]])
    thin = np.array([[0, 1, 0], [0, 0, 1]], bool)
    layer = np.asarray(draw_thinly_observed(small_map(result, p), thin, (-1, 0, 3, 2)))
    np.testing.assert_array_equal(layer, [[0, 0, 0, 1], [0, 0, 1, 0]])


def test_window_contains_every_occupied_cell_of_both_maps(result):
    p = np.zeros((100, 300), np.float32)
    p[40, 50] = p[60, 90] = 0.7
    other = np.zeros((50, 100), np.float32)
    other[10, 20] = 0.7
    b = dataclasses.replace(small_map(result, other), origin=(100.0, 30.0, 0.0))
    assert map_window([small_map(result, p), b]) == (44.0, 34.0, 125.0, 67.0)
    # none occupied: the known cells; none known: the whole map
    p[:] = np.nan
    assert map_window([small_map(result, p)]) == (0.0, 0.0, 300.0, 100.0)
    p[5, 6] = 0.1
    assert map_window([small_map(result, p)]) == (2.0, 1.0, 11.0, 10.0)


def test_layer_of_thinly_observed_cells_is_reduced_as_the_map_is(result):
    p, thin = np.zeros((4000, 4000), np.float32), np.zeros((4000, 4000), bool)
    p[:2000] = np.nan  # only known cells of a square count
    p[:2000, ::7] = 0.0
    thin[:2000, 0:1000:7] = thin[2000:, 1000:2000] = True
    thin[3000, 3000] = True
    occupancy, window = small_map(result, p), (0, 0, 4000, 4000)
    image = draw_thinly_observed(occupancy, thin, window)
    assert image.size == draw_map(occupancy, window).size
    layer = np.asarray(image)
    middle = image.height // 2
    quarter = image.width // 4
    assert layer[: middle - 1, quarter + 1 : 2 * quarter - 1].all()
    assert not layer[: middle - 1, 2 * quarter + 1 :].any()
    columns = np.flatnonzero(layer[middle + 1 :].all(axis=0))
    assert 0 < columns.max() <= quarter
    assert not layer[middle + 1 :, :quarter][:, columns.max() + 1 :].any()


def test_written_map_has_the_pixels_of_each_mode(result, tmp_path):
    p = np.array([[0, 0.1, 0.3, 0.66], [0.8, 1, np.nan, 0.5]], np.float32)
    for mode in ("trinary", "scale"):
        write_map_server(tmp_path, small_map(result, p), mode)
    greys, alpha = np.moveaxis(np.asarray(Image.open(tmp_path / "map.png")), -1, 0)
    drawn = draw_written_map(small_map(result, p), "scale").picture.convert("L")
    assert np.abs(np.asarray(drawn).astype(int) - np.where(alpha, greys, 205)).max() <= 1
    written = np.asarray(Image.open(tmp_path / "map.pgm"))
    for mode in ("trinary", "raw"):
        drawn = draw_written_map(small_map(result, p), mode).picture.convert("L")
        known = np.asarray(drawn)[written != 205]
        np.testing.assert_array_equal(known < 128, written[written != 205] == 0)
    drawn = draw_written_map(small_map(result, p), "trinary")
    np.testing.assert_array_equal(np.asarray(drawn.picture.convert("L")), written)
    assert drawn.window == (0.0, 0.0, 4.0, 2.0)


def test_large_written_maps_keep_every_occupied_pixel(result):
    p = np.zeros((4001, 9000), np.float32)
    p[:, 4000:] = np.nan
    p[:, 1777] = p[2000, 5000] = 1.0
    p[:, 4000] = 0.0
    drawn = draw_written_map(small_map(result, p), "trinary")
    assert drawn.factor == 3
    assert drawn.picture.size == (3000, 1334)
    assert drawn.window == (0.0, 0.0, 9000.0, 4002.0)
    pixels = np.asarray(drawn.picture.convert("L"))[::-1]
    assert (pixels[:, 1777 // 3] == 0).all()
    assert pixels[2000 // 3, 5000 // 3] == 0
    assert (pixels == 0).sum() == 1334 + 1
    # the only known cells of a square are free
    assert (pixels[:, 4000 // 3] == 254).all()
    assert (pixels[:, 1334:] == 205).sum() == pixels[:, 1334:].size - 1


def test_snapshot_shows_map_and_dots(result):
    shown = np.asarray(draw_snapshot(result.snapshots[-1]).convert("RGB"))
    colours = set(map(tuple, shown.reshape(-1, 3).tolist()))
    assert {(255, 255, 255), UNKNOWN, ORANGE} <= colours
    assert min(colours)[0] < 50  # a wall


def test_large_maps_are_reduced_but_keep_thin_walls(result):
    p = np.zeros((4000, 4000), np.float32)
    p[:, 1777] = 1.0
    p[3000:] = np.nan
    image = draw_map(small_map(result, p), (0, 0, 4000, 4000))
    assert image.width * image.height <= 1_500_000
    pixels = np.asarray(image.convert("L")).astype(int)
    wall = 1777 * image.width // 4000
    assert (pixels[image.height // 4 + 2 :, wall] == 0).all()
    assert (
        pixels[: image.height // 4 - 2]
        == np.asarray(Image.new("RGB", (1, 1), UNKNOWN).convert("L"))
    ).all()
    assert (pixels[image.height // 4 + 2 :, : wall - 2] == 255).all()
