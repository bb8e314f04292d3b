"""map.pgm and map.yaml against the rules of map_server, written out here once more."""

import dataclasses

import numpy as np
import pytest
import yaml
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


def read_pgm(path):
    """(H, W) pixels of a binary PGM."""
    data = path.read_bytes()
    magic, size, top, body = data.split(b"\n", 3)
    width, height = map(int, size.split())
    assert (magic, top, len(body)) == (b"P5", b"255", width * height)
    return np.frombuffer(body, np.uint8).reshape(height, width)


def nav2_cells(folder):
    """Occupancy as nav2's map_io reads it, row 0 at the bottom; -1 unknown."""
    meta = yaml.safe_load((folder / "map.yaml").read_text())
    path = folder / meta["image"]
    if path.suffix == ".pgm":
        grey, alpha = read_pgm(path), None
    else:
        grey, alpha = np.moveaxis(np.asarray(Image.open(path).convert("LA")), -1, 0)
    cells = np.empty(grey.shape, int)
    for at in np.ndindex(grey.shape):
        shade = grey[at] / 255
        occ = shade if meta["negate"] else 1 - shade
        high, low = meta["occupied_thresh"], meta["free_thresh"]
        if meta["mode"] == "raw":
            cells[at] = grey[at] if grey[at] <= 100 else -1
        elif meta["mode"] == "scale" and alpha[at] != 255:
            cells[at] = -1
        elif occ > high:
            cells[at] = 100
        elif occ < low:
            cells[at] = 0
        else:
            scaled = round((occ - low) / (high - low) * 100)
            cells[at] = scaled if meta["mode"] == "scale" else -1
    return cells[::-1], meta


@pytest.fixture
def small(result):
    return dataclasses.replace(result.map, p_occupied=P, origin=(-1.5, 2.25, 0.0), resolution=0.05)


def test_trinary_reads_as_meant(tmp_path, small):
    write_map_server(tmp_path, small)
    cells, meta = nav2_cells(tmp_path)
    np.testing.assert_array_equal(cells, TRINARY)
    assert meta == {
        "image": "map.pgm",
        "mode": "trinary",
        "resolution": 0.05,
        "origin": [-1.5, 2.25, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    assert set(np.unique(read_pgm(tmp_path / "map.pgm"))) == {0, 205, 254}


def test_origin_is_written_without_rounding_errors(tmp_path, small):
    off = -509 * 0.05
    assert str(off) != "-25.45"
    write_map_server(tmp_path, dataclasses.replace(small, origin=(off, 0.1 + 0.2, 0.0)))
    assert "origin: [-25.45, 0.3, 0.0]" in (tmp_path / "map.yaml").read_text()


def test_top_row_of_the_picture_is_the_highest_y(tmp_path, small):
    p = np.full((2, 3), np.nan, np.float32)
    p[1, 0] = 1.0
    write_map_server(tmp_path, dataclasses.replace(small, p_occupied=p))
    np.testing.assert_array_equal(read_pgm(tmp_path / "map.pgm"), [[0, 205, 205], [205, 205, 205]])
    np.testing.assert_array_equal(
        np.asarray(Image.open(tmp_path / "map.pgm")), read_pgm(tmp_path / "map.pgm")
    )


def test_raw_is_percent(tmp_path, small):
    write_map_server(tmp_path, small, "raw")
    cells, meta = nav2_cells(tmp_path)
    assert meta["mode"] == "raw"
    expected = np.where(np.isnan(P), -1, np.round(np.nan_to_num(100 * P.astype(float))))
    np.testing.assert_array_equal(cells, expected)
    assert raw_pixels(P)[1, 3] == 255


def test_scale_grades_what_lies_between_and_agrees_with_trinary_elsewhere(tmp_path, small):
    p = np.concatenate([np.linspace(0, 1, 4001), [np.nan]]).astype(np.float32)[None]
    write_map_server(tmp_path, dataclasses.replace(small, p_occupied=p), "scale")
    cells, meta = nav2_cells(tmp_path)
    assert (meta["mode"], meta["image"]) == ("scale", "map.png")
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
    np.testing.assert_array_equal(nav2_cells(tmp_path)[0], [[-1]])


def test_input_is_left_alone():
    before = P.copy()
    trinary_pixels(P)
    np.testing.assert_array_equal(P, before)
