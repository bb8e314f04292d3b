"""Scores of objects, counted by hand."""

import numpy as np
import pytest
from object_scores import compute_true_flow_map, find_sightings, score_objects

from stillmap.tracking import MovingObject

T, N = 40, 4  # scans at 5 Hz; beams of each
OFFSET = np.arange(T + 1) * N
SECONDS = 0.2 * np.arange(T)


def walkers():
    """Mover 0 on beams 0 and 1 of every scan, mover 1 on beam 2 but for 2.4 s, a wall on beam 3."""
    mover = np.tile(np.array([0, 0, 1, -1], np.int32), (T, 1))
    mover[20:33, 2] = -1
    return mover.reshape(-1)


def where():
    """0 walks at 1 m/s along x, 1 stands."""
    at = np.zeros((T, 2, 3))
    at[:, 0, 0] = SECONDS
    at[:, 1, 1] = 5.0
    return at


def thing(beams, speed=1.0):
    beams = np.sort(np.asarray(beams))
    scan = np.unique(beams // N)
    stamps, xy = (2e8 * scan).astype(np.int64), np.zeros((len(scan), 2))
    return MovingObject(0, scan, stamps, xy, xy + np.array([speed, 0]), (0.5, 0.3), beams, 1.0)


def beams_of(mover, first=0, last=T):
    beams = np.flatnonzero(walkers() == mover)
    return beams[(beams // N >= first) & (beams // N < last)]


def scores(*objects, chosen=(0, 1)):
    return score_objects(objects, walkers(), where(), OFFSET, SECONDS, chosen)


def test_a_mover_that_was_not_seen_for_a_while_is_seen_anew():
    found = find_sightings(walkers(), OFFSET, SECONDS, (0, 1), min_seconds=1.0)
    sizes = [(one.mover, len(one.scans), len(one.beams)) for one in found]
    assert sizes == [(0, 40, 80), (1, 20, 20), (1, 7, 7)]
    assert len(find_sightings(walkers(), OFFSET, SECONDS, (0, 1))) == 2  # 7 scans are 1.4 s


def test_all_right():
    found = scores(thing(beams_of(0)), thing(beams_of(1, 0, 20), 0.0), thing(beams_of(1, 33), 0.0))
    assert (found.sightings, found.whole, found.objects) == (2, 2, 3)
    assert (found.lost, found.split, found.merged, found.switches, found.false) == (0,) * 5
    assert found.speed_error == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("objects", "whole", "lost", "split", "switches"),
    [
        ([], 0, 1, 0, 0),
        ([(0, 20)], 0, 1, 0, 0),
        ([(0, 26), (26, T)], 0, 0, 1, 1),
        ([(0, 34), (34, T)], 1, 0, 0, 1),
    ],
)
def test_lost_split_and_switched(objects, whole, lost, split, switches):
    found = scores(*(thing(beams_of(0, *scans)) for scans in objects), chosen=(0,))
    assert found.sightings == 1
    assert (found.whole, found.lost, found.split, found.switches) == (whole, lost, split, switches)
    assert np.isnan(found.speed_error) == (not objects)


def test_merged_and_false():
    found = scores(thing(np.flatnonzero(walkers() >= 0)))
    assert (found.whole, found.merged) == (0, 2)
    walls = thing(np.flatnonzero(walkers() == -1))  # what is static
    found = scores(thing(beams_of(0)), walls)
    assert (found.objects, found.false) == (2, 1)


def test_true_crossings_lie_in_the_map():
    seen = find_sightings(walkers(), OFFSET, SECONDS, (0,))
    stamps = (1e9 * SECONDS).astype(np.int64)
    T_map_world = np.array([[1.0, 0.0, 10.0], [0.0, 1.0, 3.0], [0.0, 0.0, 1.0]])
    found = compute_true_flow_map(seen, where(), stamps, T_map_world, 1.0)
    assert found.origin == (10.0, 3.0, 0.0)
    np.testing.assert_array_equal(found.crossings, [[1] * 8])
