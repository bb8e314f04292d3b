"""Beams on what stood somewhere for a while are on no object on its way."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_histories import RESOLUTION, block, course, found, recording

from stillmap.core import se2
from stillmap.mapping import find_changed_object_beams
from stillmap.mapping.labelled_recording import LabelledRecording

BOX = block(10, 20, 4, 3)


INSIDE = [1.25, 2.15]


def left_out(*parts, at=INSIDE, p=0.1, hit=True, least=1, poses=None):
    """In which of a hundred seconds beams that end there are on something that stood there."""
    seen = recording(range(100), beams=1)
    points = np.tile(np.array(at, np.float32), (100, 1))
    seen = replace(seen, points=points, hit=np.full(100, hit))
    poses = np.tile(np.eye(3), (100, 1, 1)) if poses is None else poses
    before = np.full(100, p, np.float32)
    places = found(*parts, seen=seen, least=least)
    assert len(places) > 0
    known = LabelledRecording(seen, poses, before, RESOLUTION)
    beams = find_changed_object_beams(known, places, [])
    return np.sort(beams).tolist()


@pytest.mark.parametrize(
    ("there", "between", "stood"),
    [
        (True, [(40, 43)], [*range(41, 100)]),
        (False, [(40, 43)], [*range(41)]),
        # who walks there while it is away stays an object
        (False, [(20, 22), (60, 64)], [*range(21, 61)]),
        (True, [(20, 22), (60, 64)], [*range(21), *range(61, 100)]),
    ],
)
def test_a_thing_stands_there_from_when_it_came_until_it_left(there, between, stood):
    assert left_out(course(BOX, there, *between)) == stood


def test_a_door_is_no_object_at_any_time():
    leaves = np.concatenate([block(10, 20, 9, 2), block(10, 20, 2, 9)])
    door = course(leaves, False, (10, 12), (80, 82), count=5)
    assert left_out(door, at=[1.75, 2.05]) == [*range(100)]
    # who walks where it sweeps over is none of its leaf
    assert left_out(door, at=[1.45, 2.55]) == []


def test_only_cells_that_changed_count_and_not_what_lies_between():
    corner = np.concatenate([block(0, 0, 10, 1), block(0, 1, 1, 9)])
    assert left_out(course(corner, True, (40, 43)), at=[0.45, 0.05])
    assert left_out(course(corner, True, (40, 43)), at=[0.55, 0.55]) == []


@pytest.mark.parametrize(("p", "hit"), [(0.5, True), (0.9, True), (0.1, False)])
def test_what_is_static_or_met_nothing_stays_as_it_is(p, hit):
    assert left_out(course(BOX, True, (40, 43)), p=p, hit=hit) == []


def test_poses_and_sensors_say_where_a_beam_ended():
    poses = np.tile(se2.matrix(-3.0, 1.0, np.pi / 2), (100, 1, 1))
    there = se2.inverse(poses[0]) @ [*INSIDE, 1.0]
    moved = left_out(course(BOX, True, (40, 43)), at=there[:2].tolist(), poses=poses)
    assert moved == [*range(41, 100)]
    assert left_out(course(BOX, True, (40, 43)), poses=poses) == []
