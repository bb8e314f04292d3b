"""The search for alignments of two maps, and their refinement, on made-up floors."""

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.places.alignment import MapRefiner, propose_alignments, search_alignments
from stillmap.places.surface_map import SurfaceMap, compare_maps, find_sides

EDGE = 0.1
FLOOR = [(0, 0, 14, 0), (14, 0, 14, 5), (14, 5, 6, 5), (6, 5, 6, 11), (6, 11, 0, 11), (0, 11, 0, 0)]
WINGS = [(0, 0, 12, 0), (12, 0, 12, 6), (12, 6, 0, 6), (0, 6, 0, 0), (6, 0, 6, 2), (6, 3.2, 6, 6)]


def make_map(walls, T=None, inside=((0.4, 0.4, 13.6, 4.6),)):
    """Walls (x0, y0, x1, y1) and rectangles of free space, moved by T (3, 3), on squares."""
    T = np.eye(3) if T is None else T
    points = [np.linspace((a, b), (c, d), 400) for a, b, c, d in walls]
    surface = move(T, np.concatenate(points))
    boxes = [
        np.stack(np.meshgrid(np.arange(a, c, 0.04), np.arange(b, d, 0.04)), axis=-1).reshape(-1, 2)
        for a, b, c, d in inside
    ]
    free = move(T, np.concatenate(boxes))
    every = np.floor(np.concatenate([surface, free]) / EDGE).astype(np.int64)
    low = every.min(axis=0) - 2
    shape = tuple((every.max(axis=0) + 3 - low).tolist())
    near, is_free = np.zeros((2, *shape), bool)
    squares = np.unique(np.floor(surface / EDGE).astype(np.int64), axis=0)
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            near[tuple((squares - low + (dx, dy)).T)] = True
    is_free[tuple((np.floor(free / EDGE).astype(np.int64) - low).T)] = True
    centres = ((squares + 0.5) * EDGE).astype(np.float32)
    return SurfaceMap(centres, low, near, is_free & ~near, find_sides(is_free), EDGE)


def move(T, points):
    return points @ T[:2, :2].T + T[:2, 2]


def distance(T, other, session):
    """m at the middle of the session, and rad."""
    middle = np.append(session.surface.mean(axis=0), 1.0)
    turn = se2.parameters(se2.inverse(T) @ other)[2]
    return np.linalg.norm(((T - other) @ middle)[:2]), abs(turn)


@pytest.mark.parametrize("heading", [0.0, 0.4, 2.0, -2.9])
def test_the_best_alignment_is_the_true_one(heading):
    true = se2.matrix(-7.3, 21.9, heading)
    place, session = make_map(FLOOR), make_map(FLOOR, se2.inverse(true))
    metres, radians = distance(search_alignments(place, session)[0], true, session)
    assert metres < 0.45
    assert radians < 0.1
    metres, radians = distance(propose_alignments(place, session)[0].T, true, session)
    assert metres < EDGE
    assert radians < 0.01


def test_free_space_tells_a_small_overlap_from_a_room_that_fits_by_half():
    """Of the second room the place saw one wall; its first room is as wide, but not as deep."""
    place = make_map(WINGS[:5], inside=[(0.4, 0.4, 5.6, 5.6)])
    session = make_map(
        [(6, 0, 12, 0), (12, 0, 12, 6), (12, 6, 6, 6), (6, 0, 6, 2), (9, 2, 10, 4)],
        inside=[(6.4, 0.4, 8.6, 5.6), (10.4, 0.4, 11.6, 5.6)],
    )
    best = propose_alignments(place, session)[0]
    metres, _ = distance(best.T, np.eye(3), session)
    assert metres < 0.1
    assert best.comparison.conflict == 0


def test_refinement_reaches_the_optimum_nearby():
    place = make_map(FLOOR)
    session = make_map(FLOOR, se2.inverse(se2.matrix(3.0, -2.0, 0.7)))
    true = se2.matrix(3.0, -2.0, 0.7)
    start = se2.matrix(0.25, -0.2, 0.02) @ true
    refined = MapRefiner(place, session).refine(start)
    metres, radians = distance(refined, true, session)
    assert metres < EDGE
    assert radians < 0.01
    before, after = (compare_maps(place, session, T).score for T in (start, refined))
    assert after > before


def test_the_other_face_of_a_wall_does_not_agree():
    """A room beside another one, which share a wall: both see it, each from its own side."""
    room = [(0, 0, 6, 0), (6, 0, 6, 4), (6, 4, 0, 4), (0, 4, 0, 0)]
    west = make_map(room, inside=[(0.1, 0.1, 5.9, 3.9)])
    same = compare_maps(west, west, np.eye(3))
    beside = compare_maps(west, west, se2.matrix(6.0, 0.0, 0.0))
    assert same.agree > 300
    assert beside.agree < 0.05 * same.agree
    assert beside.conflict == 0


def test_nothing_is_found_in_an_empty_map():
    nothing = np.zeros((5, 5), bool)
    points, low = np.zeros((0, 2), np.float32), np.zeros(2, np.int64)
    empty = SurfaceMap(points, low, nothing, nothing, find_sides(nothing), EDGE)
    floor = make_map(FLOOR)
    assert search_alignments(empty, floor) == []
    assert propose_alignments(floor, empty) == []
