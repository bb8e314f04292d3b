"""Voxels of a known map in 3D that stand or are gone: what was seen of the voxels around counts."""

import numpy as np

from stillmap.live.known_cloud import _share_evidence

P_UNSEEN, P_MISSED, P_HIT = 0.967, 0.003, 0.9999


def wall_of(rows, columns, y):
    """(rows x columns, 3) voxels of a vertical wall."""
    return np.array([[x, y, z] for x in range(columns) for z in range(rows)])


def in_order(cells, p_occupied):
    order = np.lexsort(cells.T[::-1])
    return np.ascontiguousarray(cells[order]), p_occupied[order]


def test_what_no_ring_of_the_sweeps_met_goes_with_its_thing():
    cells = wall_of(8, 6, 0)
    is_seen = cells[:, 2] % 3 == 0
    cells, p_occupied = in_order(cells, np.where(is_seen, P_MISSED, P_UNSEEN))
    assert (p_occupied > 0.5).sum() == 30
    assert _share_evidence(cells, p_occupied, P_UNSEEN).max() < 0.5


def test_a_wall_behind_what_is_gone_stays_where_it_was_hit():
    box, wall = wall_of(8, 6, 0), wall_of(8, 20, 1)
    of_each = [
        np.where(part[:, 2] % 3 == 0, p, P_UNSEEN) for part, p in ((box, P_MISSED), (wall, P_HIT))
    ]
    cells, p_occupied = in_order(np.concatenate([box, wall]), np.concatenate(of_each))
    stands = _share_evidence(cells, p_occupied, P_UNSEEN) > 0.5
    is_wall = cells[:, 1] == 1
    assert stands[is_wall & (p_occupied == P_HIT)].all()
    assert stands[is_wall & (cells[:, 0] > 6)].all()
    assert not stands[~is_wall & (p_occupied == P_MISSED)].any()
