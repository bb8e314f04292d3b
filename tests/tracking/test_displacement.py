"""Which tracks in 3D are listed: those that travel, and what is seen to come or leave."""

import dataclasses

import numpy as np
import pytest

from stillmap import Recording
from stillmap.tracking import MovingObject
from stillmap.tracking.displacement import select_movers

SCANS, PERIOD, HEIGHT = 60, 0.1, 1.5
AT = np.array([4.0, 0.0])


def sweep(there, width=0.5):
    """A wall 8 m ahead, before which a thing stands or does not."""
    a, e = np.meshgrid(np.radians(np.arange(-20, 20.1, 0.5)), np.radians(np.arange(-15, 8, 1.0)))
    d = np.column_stack([np.ones(a.size), np.tan(a.ravel()), np.tan(e.ravel()) / np.cos(a.ravel())])
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
    return MovingObject(
        number,
        scan,
        recording.stamp_ns[scan],
        xy,
        np.zeros_like(xy),
        (0.5, 0.5, 0.8),
        np.arange(5),
        1.0,
        np.full(len(scan), HEIGHT),
    )


def scans(*ranges):
    there = np.zeros(SCANS, bool)
    for first, last in ranges:
        there[first:last] = True
    return there


@pytest.mark.parametrize(
    ("there", "listed"),
    [
        (scans((0, SCANS)), False),  # it is there all the time
        (scans((20, 40)), True),
        (scans((0, 40)), True),  # left
        (scans((20, SCANS)), True),  # came
        (scans((0, 21), (22, SCANS)), False),
    ],
    ids=["always", "for a while", "left", "came", "missed once"],
)
def test_standing(there, listed):
    recording, poses = street(there)
    found = select_movers([an_object(recording, 20, 40)], recording, poses)
    assert len(found) == listed


@pytest.mark.parametrize("width", [0.04, 0.1])
def test_beams_beside_a_thin_post_do_not_empty_its_place(width):
    recording, poses = street(scans((0, SCANS)), width=width)
    assert select_movers([an_object(recording, 20, 40)], recording, poses) == []


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


@pytest.mark.parametrize(("travel", "listed"), [(0.4, False), (0.6, True)])
def test_travel(travel, listed):
    recording, poses = street(scans((0, SCANS)))
    found = select_movers([an_object(recording, 20, 40, travel)], recording, poses)
    assert len(found) == listed


def test_without_other_looks_nothing_shows_that_it_moved():
    recording, poses = street(scans((0, SCANS)))
    assert select_movers([an_object(recording, 0, SCANS)], recording, poses) == []


def test_ids_are_counted_anew():
    recording, poses = street(scans((0, SCANS)))
    objects = [an_object(recording, 20, 40, travel, k) for k, travel in enumerate((1.0, 0.0, 2.0))]
    found = select_movers(objects, recording, poses)
    assert [one.id for one in found] == [0, 1]
    assert [np.ptp(one.xy[:, 1]) for one in found] == [1.0, 2.0]
    assert select_movers([], recording, poses) == []
