"""The map of a place as of its sessions."""

from dataclasses import replace

import numpy as np
import pytest
from small_place import BOX, CELL, CHAIR, DOOR, OPEN, ORIGIN, SIZE, make_place

from stillmap.results.colors import KIND_COLORS
from stillmap.results.reader import read_grid
from stillmap.results.report.place import PlacePictures
from stillmap.results.timeline import read_timeline

WHITE, BLACK = (255, 255, 255), (0, 0, 0)
CAME, LEFT = KIND_COLORS["appeared"], KIND_COLORS["gone"]


@pytest.fixture
def place(tmp_path):
    return make_place(tmp_path / "place")


@pytest.fixture
def pictures(place):
    return PlacePictures(read_grid(place), read_timeline(place))


def colors_in(pictures, picture, corner):
    """The colors of a square of cells."""
    first = np.array(ORIGIN) + CELL * np.array(corner)
    centers = first + CELL * (np.indices((SIZE, SIZE)).reshape(2, -1).T + 0.5)
    column, row = np.floor(pictures.view.to_pixels(centers)).astype(int).T
    found = np.array(picture.convert("RGB"))[row, column]
    return {tuple(color) for color in found.tolist()}


@pytest.mark.parametrize(
    ("session", "chair", "box", "door", "opened"),
    [
        (0, WHITE, BLACK, BLACK, WHITE),
        (1, CAME, BLACK, BLACK, WHITE),
        (2, BLACK, BLACK, LEFT, CAME),
        (3, BLACK, LEFT, WHITE, BLACK),
    ],
)
def test_picture_shows_what_stands_and_what_changed(pictures, session, chair, box, door, opened):
    drawn = pictures.draw(session)
    squares = {CHAIR: chair, BOX: box, DOOR: door, OPEN: opened}
    assert {at: colors_in(pictures, drawn, at) for at in squares} == {
        at: {color} for at, color in squares.items()
    }


@pytest.mark.parametrize("session", range(4))
def test_differences_over_the_map_make_the_picture(pictures, session):
    left, top, patch = pictures.draw_difference(session)
    whole = pictures.draw_map().convert("RGBA")
    whole.alpha_composite(patch.convert("RGBA"), (left, top))
    assert whole.convert("RGB").tobytes() == pictures.draw(session).convert("RGB").tobytes()


def test_map_without_changes_has_no_differences(place):
    (place / "changes.json").write_text("[]")
    pictures = PlacePictures(read_grid(place), read_timeline(place))
    assert pictures.draw_difference(3) is None  # the map shows the last session
    assert pictures.draw_difference(0) is not None


def test_small_picture_keeps_what_shares_a_pixel_with_a_change(place):
    """Where a wall and an object share a pixel, the wall stays when the object is not there."""
    grid, timeline = read_grid(place), read_timeline(place)
    column, row = CHAIR
    p_occupied = grid.p_occupied.copy()
    p_occupied[row - 1, column : column + SIZE] = 1.0  # a wall below the chair
    grid = replace(grid, p_occupied=p_occupied)
    small = PlacePictures(grid, timeline, 20 * 15)
    assert small.view.is_reduced
    first = np.array(ORIGIN) + CELL * (np.array([column, row - 1]) + 0.5)
    x, y = np.floor(small.view.to_pixels(first[None])[0]).astype(int)
    assert small.draw(0).convert("RGB").getpixel((x, y)) == BLACK
    without = PlacePictures(read_grid(place), timeline, 20 * 15)
    assert without.draw(0).convert("RGB").getpixel((x, y)) == WHITE


def test_changes_at_the_border_are_in_the_picture(place):
    """The map's own window is that of what stands in it."""
    grid, timeline = read_grid(place), read_timeline(place)
    p_occupied = np.where(np.isnan(grid.p_occupied), np.float32(np.nan), np.float32(0.0))
    p_occupied[30, 40] = 1.0
    pictures = PlacePictures(replace(grid, p_occupied=p_occupied), timeline)
    x0, y0, x1, y1 = pictures.view.window
    low, high = timeline.cells.centers.min(axis=0), timeline.cells.centers.max(axis=0)
    assert x0 < low[0] < high[0] < x1
    assert y0 < low[1] < high[1] < y1
    assert colors_in(pictures, pictures.draw(1), CHAIR) == {CAME}


def test_cells_outside_the_map_are_left_out(place):
    timeline = read_timeline(place)
    far = timeline.cells.cells.copy()
    far[:16] += 10**8
    timeline = replace(timeline, cells=replace(timeline.cells, cells=far))
    pictures = PlacePictures(read_grid(place), timeline)
    assert max(pictures.view.size) < 200
    assert colors_in(pictures, pictures.draw(3), BOX) == {LEFT}
