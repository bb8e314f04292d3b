"""Pictures that differ from all others of a face."""

import numpy as np
from made_up_rooms import looking, rectangle

from stillmap.mesh.view_selection import (
    Candidates,
    reject_inconsistent_views,
    sample_face_colors,
)

WALL = rectangle([-0.5, 4.0, -0.5], [1.0, 0, 0], [0, 0, 1.0], 2)


def left(shades, odd=40.0):
    views = [looking([0.0, 0, 0], [0.0, 1, 0], number) for number in range(len(shades))]
    candidates, n = Candidates.empty(len(WALL), 6), len(WALL)
    for number in range(len(shades)):
        p = np.full(n, 0.9)
        candidates.add(number, np.arange(n), np.full(n, -float(number)), p)

    def colours(view):
        shade = shades[view.image]
        return None if shade is None else np.full((300, 400, 3), shade, np.uint8)

    found = reject_inconsistent_views(
        candidates, sample_face_colors(WALL, candidates, views, colours), odd
    )
    assert (found.view == found.view[0]).all()
    assert (np.isfinite(found.utility) == (found.view >= 0)).all()
    return [k for k in found.view[0].tolist() if k >= 0]


def test_one_that_most_contradict_is_left_out():
    assert left([200, 100, 104, 98]) == [1, 2, 3]
    assert left([100, 110, 104, 98]) == [0, 1, 2, 3]


def test_of_two_nobody_knows():
    assert left([200, 100]) == [0, 1]


def test_where_most_do_not_agree_all_stay():
    assert left([10, 80, 150, 220]) == [0, 1, 2, 3]
