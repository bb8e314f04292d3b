"""Things that came or left in space, from cells made up by hand."""

import dataclasses

import numpy as np
import pytest
from recordings import of_one_sensor
from synthetic_histories import EVERY_SECOND, S, course, recording, seconds, together

from stillmap.em.change_hmm import select_changed_cells
from stillmap.mapping import Change, detect_changes_3d
from stillmap.mapping.changed_objects import measure_dwell_times

VOXEL = 0.15
CAR, GROUND = (20, 8, 9), (40, 20, 2)


def box(x, y, z, size):
    """(n, 3) the cells of the surface of a box."""
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), -1).reshape(-1, 3)
    outside = ((cells == 0) | (cells == np.array(size) - 1)).any(axis=1)
    return cells[outside] + [x, y, z]


def watching(cells, *stands):
    """A lidar at the origin that meets every one of these cells from one second to another."""
    met = [any(first <= t <= last for first, last in stands) for t in range(100)]
    n, ends = len(cells), ((cells + 0.5) * VOXEL).astype(np.float32)
    return of_one_sensor(
        EVERY_SECOND.stamp_ns,
        np.concatenate([[0], np.cumsum(np.multiply(met, n))]).astype(np.int64),
        np.tile(ends, (sum(met), 1)),
        np.ones(sum(met) * n, bool),
    )


def things(*parts, seen=None):
    """By default things are seen as long as they stand there."""
    courses = together(*parts)
    if seen is None:
        seen = watching(courses.cells, (0, 99))
    poses = np.tile(np.eye(4), (seen.n_scans, 1, 1))
    changed = select_changed_cells(courses)
    return detect_changes_3d(changed, seen, poses, VOXEL, 1.0)


def test_a_car_that_left_is_one_place_in_space():
    cells = box(10, 20, 1, CAR)
    [one] = things(course(cells, False, (40, 42), p=0.3, static=0.7))
    assert one.kind == "left"
    assert seconds(one) == (40.0, 42.0, 42.0)
    assert one.size == pytest.approx((3.0, 1.2, 1.35))
    assert (one.x, one.y, one.z) == pytest.approx((cells.mean(axis=0) + 0.5) * VOXEL)
    assert one.times == 1
    plan = np.stack(np.meshgrid(np.arange(10, 30), np.arange(20, 28)), -1).reshape(-1, 2)
    assert set(map(tuple, one.cells)) == set(map(tuple, plan))
    np.testing.assert_array_equal(one.swept_cells, one.cells)


def test_one_that_came_and_left_is_two():
    one = course(box(0, 0, 1, CAR), False, (20, 21), (60, 61))
    assert [(c.kind, seconds(c)[:2]) for c in things(one)] == [
        ("came", (20.0, 21.0)),
        ("left", (60.0, 61.0)),
    ]


def test_things_apart_or_at_other_times_are_several():
    here, there = box(0, 0, 1, CAR), box(30, 0, 1, CAR)
    assert len(things(course(here, True, (40, 41)), course(there, True, (40, 41)))) == 2
    beside = box(20, 0, 1, CAR)
    assert len(things(course(here, True, (40, 41)), course(beside, True, (40, 41)))) == 1
    assert len(things(course(here, True, (40, 41)), course(beside, True, (60, 61)))) == 2
    assert len(things(course(here, True, (40, 41)), course(beside, False, (40, 41)))) == 2


@pytest.mark.parametrize(
    ("cells", "between"),
    [
        (box(0, 0, 0, GROUND), [(40, 41)]),  # lines on the ground
        (box(0, 0, 1, (3, 3, 3)), [(40, 41)]),  # too small
        (box(0, 0, 1, CAR), [(5, 6)]),  # nobody knows that it stood there before
        (box(0, 0, 1, CAR), [(95, 96)]),  # or will
        (box(0, 0, 1, CAR), [(40, 41), (50, 51)]),  # waited
        (box(0, 0, 1, CAR), [(20, 21), (40, 41), (60, 61)]),  # comes and goes
    ],
)
def test_what_is_no_thing_that_came_to_stay(cells, between):
    assert things(course(cells, True, *between)) == []


def test_cells_that_anything_else_explains_as_well_say_nothing():
    """The share of all cells that changed is 0.1 in these courses."""
    cells = box(0, 0, 1, CAR)
    assert things(course(cells, True, (40, 41), p=0.2, static=0.7)) == []
    assert len(things(course(cells, True, (40, 41), p=0.25, static=0.7))) == 1
    assert len(things(course(cells, True, (40, 41), p=1.0, static=0.0))) == 1


@pytest.mark.parametrize("scans", [[0.0], [0.0, 50.0]])
def test_no_cells_and_hardly_any_scan(scans):
    nothing = course(np.empty((0, 3)), True, (40, 41))
    seen = dataclasses.replace(
        recording(scans), points=np.empty((0, 3), np.float32), T_base_sensor=np.eye(4)[None]
    )
    assert things(nothing, seen=seen) == []


@pytest.mark.parametrize(
    ("there", "between", "stands", "listed"),
    [
        (True, (40, 41), (41, 60), True),
        (True, (40, 41), (41, 44), False),  # drove along, or was hidden soon after
        (True, (40, 41), (0, 40), False),
        (False, (40, 41), (10, 40), True),
        (False, (40, 41), (35, 40), False),
        (False, (40, 41), (41, 99), False),
    ],
)
def test_a_thing_was_seen_to_stand_there_for_a_while(there, between, stands, listed):
    cells = box(0, 0, 1, CAR)
    one = course(cells, there, between)
    assert len(things(one, seen=watching(cells, stands))) == listed
    # by most of its voxels
    for share, enough in ((0.9, listed), (0.5, False)):
        seen = watching(cells[: int(share * len(cells))], stands)
        assert len(things(one, seen=seen)) == enough


def test_how_long_things_at_the_same_place_were_seen():
    """Against a plain account of every voxel."""
    rng = np.random.default_rng(3)
    cells = box(-3, -2, -1, (4, 3, 5))
    places = []
    for start, kind in ((0, "came"), (20, "left"), (0, "left")):
        mine = cells[start : start + 30]
        stamp = int(rng.integers(20, 80))
        before, after = EVERY_SECOND.stamp_ns[[stamp, stamp + 2]].tolist()
        places.append(Change(kind, 0.0, 0.0, (1.0,) * 3, mine, VOXEL, before, after, after, 1, 0.5))
    seen = watching(cells, (0, 99))
    kept = rng.uniform(size=seen.n_beams) < 0.1
    seen = dataclasses.replace(seen, hit=kept)
    T = np.tile(np.eye(4), (100, 1, 1))
    T[:, :3, 3] = [0.3, -0.45, 0.15]
    shifted = dataclasses.replace(seen, points=seen.points - T[0, :3, 3].astype(np.float32))
    second, cell = np.divmod(np.arange(seen.n_beams), len(cells))
    stamps, expected = seen.stamp_ns[second], []
    for one in places:
        spans = []
        for mine in one.cells:
            at = stamps[kept & (cells[cell] == mine).all(axis=1)]
            at = at[at >= one.stamp_ns] if one.appeared else at[at <= one.before_ns]
            shown = at.max(initial=one.stamp_ns) - one.stamp_ns
            if not one.appeared:
                shown = one.before_ns - at.min(initial=one.before_ns)
            spans.append(shown / S)
        expected.append(sorted(spans)[int(0.25 * (len(spans) - 1))])
    assert measure_dwell_times(places, shifted, T, VOXEL) == pytest.approx(expected)
    assert max(expected) > 5.0
    assert measure_dwell_times([], shifted, T, VOXEL) == []
