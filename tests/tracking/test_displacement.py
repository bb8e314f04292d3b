"""Which tracks in 3D are listed: those that travel, and what is seen to come or leave.

Parts of static surfaces are not.
"""

import dataclasses

import numpy as np
import pytest

from stillmap import Recording
from stillmap.tracking import MovingObject
from stillmap.tracking.displacement import count_neighbors, drop_surface_parts, select_movers

SCANS, PERIOD, HEIGHT = 60, 0.1, 1.5
AT = np.array([4.0, 0.0])


def directions(azimuth, elevation):
    """(N, 3) one metre along x."""
    a, e = azimuth.ravel(), elevation.ravel()
    return np.column_stack([np.ones(a.size), np.tan(a), np.tan(e) / np.cos(a)])


def sweep(there, width=0.5):
    """A wall 8 m ahead, before which a thing stands or does not."""
    beams = np.radians(np.arange(-20, 20.1, 0.5)), np.radians(np.arange(-15, 8, 1.0))
    d = directions(*np.meshgrid(*beams))
    on = there & (np.abs(d[:, 1] * AT[0] - AT[1]) < 0.5 * width)
    return (np.where(on, AT[0], 8.0)[:, None] * d).astype(np.float32)


def street(there, **thing):
    """A recording in whose sweeps (T,) bool the thing is there, and its poses."""
    poses = np.tile(np.eye(4), (len(there), 1, 1))
    poses[:, 2, 3] = HEIGHT
    clouds = [sweep(bool(one), **thing) for one in there]
    return Recording.from_clouds(PERIOD * np.arange(len(there)), clouds), poses


def an_object(recording, first, last, travel=0.0, number=3):
    scan = np.arange(first, last)
    xy = AT + np.column_stack([np.zeros(len(scan)), np.linspace(0, travel, len(scan))])
    still, z = np.zeros_like(xy), np.full(len(scan), HEIGHT)
    of_scans = scan, recording.stamp_ns[scan], xy, still
    return MovingObject(number, *of_scans, (0.5, 0.5, 0.8), np.arange(5), 1.0, z)


def scans(*ranges):
    there = np.zeros(SCANS, bool)
    for first, last in ranges:
        there[first:last] = True
    return there


@pytest.mark.parametrize(
    ("there", "width", "listed"),
    [
        (scans((0, SCANS)), 0.5, False),  # it is there all the time
        (scans((0, SCANS)), 0.04, False),  # beams pass beside a thin post
        (scans((0, SCANS)), 0.1, False),
        (scans((20, 40)), 0.5, True),  # for a while
        (scans((0, 40)), 0.5, True),  # left
        (scans((20, SCANS)), 0.5, True),  # came
        (scans((0, 21), (22, SCANS)), 0.5, False),  # missed once
    ],
)
def test_standing(there, width, listed):
    recording, poses = street(there, width=width)
    found = select_movers([an_object(recording, 20, 40)], recording, poses)
    assert len(found) == listed


@pytest.mark.parametrize(("share", "listed"), [(0.2, False), (1.0, True)], ids=["bush", "person"])
def test_few_beams_empty_the_place_of_what_stops_all(share, listed):
    """Before and after one beam passes through the outline, and others do beside it."""
    there = scans((20, 40))
    recording, poses = street(there)
    points = recording.points.reshape(SCANS, -1, 3).copy()
    hit = np.ones(points.shape[:2], bool)
    direction = points[0] / points[0][:, :1]
    on = np.abs(direction[:, 1] * AT[0]) < 0.25
    passing = on & (np.random.default_rng(1).random(len(on)) > share)
    points[:, passing] = 8.0 * direction[passing]
    hit[~there] = ~on
    hit[~there, np.flatnonzero(on)[np.count_nonzero(on) // 2]] = True
    recording = dataclasses.replace(recording, points=points.reshape(-1, 3), hit=hit.reshape(-1))
    assert len(select_movers([an_object(recording, 20, 40)], recording, poses)) == listed


def test_those_that_travel_have_ids_from_0():
    recording, poses = street(scans((0, SCANS)))
    ways = enumerate((0.6, 0.4, 2.0))
    objects = [an_object(recording, 20, 40, travel, k) for k, travel in ways]
    found = select_movers(objects, recording, poses)
    assert [one.id for one in found] == [0, 1]
    assert [np.ptp(one.xy[:, 1]) for one in found] == [0.6, 2.0]
    # without other scans nothing shows that it moved
    assert select_movers([an_object(recording, 0, SCANS)], recording, poses) == []
    assert select_movers([], recording, poses) == []


SWEEPS = 6
ACROSS, UP = np.meshgrid(np.radians(np.arange(-20, 20.1, 1.0)), np.radians(np.arange(-9, 10, 2.0)))
DIRECTIONS = directions(ACROSS, UP)


def room(distance):
    """Sweeps of what lies at a depth in m, one for each direction, and P(static) = 1."""
    cloud = (np.asarray(distance)[:, None] * DIRECTIONS).astype(np.float32)
    recording = Recording.from_clouds(0.1 * np.arange(SWEEPS), [cloud] * SWEEPS)
    return recording, np.ones(recording.n_beams, np.float32)


def part_of(recording, own):
    """One of which the beams `own` of each sweep are."""
    beams = np.concatenate([t * len(own) + np.flatnonzero(own) for t in range(SWEEPS)])
    return dataclasses.replace(an_object(recording, 0, SWEEPS), beams=beams)


def degrees(low, high):
    return (np.degrees(ACROSS.ravel()) > low) & (np.degrees(ACROSS.ravel()) < high)


PATCH = degrees(-3, 3) & (np.abs(np.degrees(UP.ravel())) < 6)


def labelled(p_static, *dynamic):
    p = p_static.reshape(SWEEPS, -1)
    for own in dynamic:
        p[:, own] = 0.0
    return p.reshape(-1)


@pytest.mark.parametrize(("depth", "kept"), [(1.0, True), (4.5, True), (5.0, False)])
def test_an_object_before_a_wall_is_kept_and_a_patch_of_it_is_none(depth, kept):
    recording, p = room(np.where(PATCH, depth, 5.0))
    one = part_of(recording, PATCH)
    assert drop_surface_parts([one], recording, labelled(p, PATCH)) == [one] * kept


def test_surface_on_one_side_does_not_count_enough():
    recording, p = room(np.where(PATCH | degrees(2, 8), 3.0, 6.0))
    one = part_of(recording, PATCH)
    on_it, behind = count_neighbors([one], recording, labelled(p, PATCH))[0]
    assert 0 < on_it < behind
    assert drop_surface_parts([one], recording, labelled(p, PATCH)) == [one]


def test_neighbors_that_move_do_not_count():
    """People side by side."""
    recording, p = room(np.where(degrees(-20, 20), 3.0, 6.0))
    one = part_of(recording, PATCH)
    p = labelled(p, PATCH, ~PATCH)
    assert count_neighbors([one], recording, p).tolist() == [[0, 0]]
    assert drop_surface_parts([one], recording, p) == [one]


def test_a_single_beam_and_no_object():
    recording, p = room(np.full(len(DIRECTIONS), 5.0))
    own = np.arange(len(DIRECTIONS)) == len(DIRECTIONS) // 2
    on_it, behind = count_neighbors([part_of(recording, own)], recording, p)[0]
    assert on_it > 0
    assert behind == 0
    assert drop_surface_parts([], recording, p) == []
