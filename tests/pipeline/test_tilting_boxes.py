"""A box cuts what it should, and nothing else."""

import dataclasses

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap.em import EmOptions
from stillmap.pipeline import tilting
from stillmap.pipeline.tilting import PlanarResult, apply_boxes, build_tilting
from stillmap.pipeline.tilting_beams import BoxBeams, object_height
from stillmap.tracking import MovingObject
from stillmap.tracking.boxes import fit_boxes

MS = 1_000_000
STAMPS = np.arange(0, 2001, 100, dtype=np.int64) * MS


def walker(seconds, size=(0.6, 0.4)):
    """Along y at 1 m/s through (2, 0) at one second."""
    seconds = np.asarray(seconds, float)
    xy = np.stack([np.full(len(seconds), 2.0), seconds - 1.0], axis=1)
    return MovingObject(
        id=7,
        scan=np.round(10 * seconds).astype(np.intp),
        stamp_ns=np.round(1e9 * seconds).astype(np.int64),
        xy=xy,
        velocity=np.tile([0.0, 1.0], (len(seconds), 1)),
        size=size,
        beams=np.arange(len(seconds)),
        p_dynamic=0.9,
    )


def flat_recording(points, offset):
    """Of a laser at the origin that stands."""
    xy, hit = np.asarray(points, np.float32).reshape(-1, 2), np.ones(int(offset[-1]), bool)
    return of_one_sensor(STAMPS, np.asarray(offset, np.int64), xy, hit)


def standing():
    return np.tile(np.eye(3), (len(STAMPS), 1, 1))


def box_of(one):
    empty = flat_recording(np.zeros((0, 2)), np.zeros(len(STAMPS) + 1))
    return fit_boxes(empty, standing(), np.zeros(0, np.float32), [one])[0]


def test_box_moves_and_turns_with_its_object():
    box = box_of(walker([0.5, 1.0, 1.5]))
    seconds = np.full(6, 1.25)
    xy = [[2.0, 0.25], [2.0, 0.54], [2.19, 0.25], [2.0, 0.56], [2.21, 0.25], [2.0, -0.1]]
    held = box.contains(seconds, np.array(xy), 0.0)
    assert held.tolist() == [True, True, True, False, False, False]
    assert box.contains(seconds, np.array(xy), 0.02).tolist()[:5] == [True] * 5


def test_box_persists_for_half_a_second():
    box = box_of(walker([0.5, 1.0, 1.5]))
    seconds = np.array([0.05, 1.95, -0.05, 2.05])
    xy = np.stack([np.full(4, 2.0), seconds - 1.0], axis=1)
    assert box.contains(seconds, xy, 0.0).tolist() == [True, True, False, False]


def test_untracked_clusters_have_a_short_box():
    # two that belong together, and one alone: noise
    points = [[3.0, 0.0], [3.0, 0.1], [5.0, 5.0]]
    offset = np.where(np.arange(len(STAMPS) + 1) > 4, 3, 0)
    p_static = np.full(3, 0.1, np.float32)
    recording = flat_recording(points, offset)
    boxes = fit_boxes(recording, standing(), p_static, [])
    assert [box.object_id for box in boxes] == [-1]
    held = boxes[0].contains(np.array([0.4, 0.8]), np.array([[3.0, 0.05]] * 2), 0.1)
    assert held.tolist() == [True, False]
    p_static[:] = 0.31  # P(dynamic) below 0.7
    assert not fit_boxes(recording, standing(), p_static, [])


@pytest.mark.parametrize(
    ("above", "top"),
    [
        ([0.3, 1.2, 1.5, 1.7], 1.7),
        ([0.3, 1.2, 1.5, 2.4], 1.5),  # a lamp
        ([0.3, 0.6], 1.0),
        ([1.9], 1.0),  # nothing connects it
        ([1.3, 1.6, 1.9, 2.2], 1.9),
        ([], 1.0),
    ],
)
def test_object_height(above, top):
    assert object_height(np.array(above), 2.0) == top


def built(points, ms, objects):
    """P(static) of points seen one at a time by a laser at the origin that knows the floor."""
    x, y = np.meshgrid(np.arange(-4.0, 4.0, 0.1), np.arange(-4.0, 4.0, 0.1))
    floor = np.stack([x.ravel(), y.ravel(), np.full(x.size, -1.0)], axis=1)
    stamps = np.concatenate([[0], np.asarray(ms, np.int64) * MS])
    n = len(points)
    offset = np.concatenate([[0], len(floor) + np.arange(n + 1)]).astype(np.int64)
    xyz = np.concatenate([floor, np.asarray(points) - [0, 0, 1.0]]).astype(np.float32)
    at_base = of_one_sensor(stamps, offset, xyz, np.ones(len(xyz), bool))
    mount = np.eye(4)[None] + np.eye(4, k=1)[None] * [[0], [0], [1.0], [0]]
    recording = dataclasses.replace(at_base, T_base_sensor=mount)
    seen = flat_recording([[9.0, 9.0]], np.append(np.zeros(len(STAMPS)), 1))
    flat = PlanarResult(seen, standing(), np.full(1, 0.9, np.float32), objects)
    found = build_tilting(flat, recording, EmOptions(), use_evidence=False)
    return found, found.p_static[-n:]


PERSON = [[2.0, 0.0, 0.1], [2.1, 0.1, 0.6], [2.0, 0.3, 0.9], [2.0, 0.0, 1.3], [2.0, 0.0, 1.7]]
BESIDE = [[2.4, 0.0, 1.0], [2.0, 0.5, 1.0], [2.0, 0.0, 0.0], [2.0, 0.0, 2.6]]


def test_only_beams_in_boxes_are_dynamic():
    found, p_static = built(PERSON + BESIDE, [1000] * 9, [walker([0.5, 1.0, 1.5])])
    assert (p_static[:5] < 0.5).all()
    np.testing.assert_allclose(p_static[5:], 0.9, atol=1e-5)
    (one,) = found.objects
    assert found.boxes_hit == 1
    assert one.beams.tolist() == list(range(found.deskewed.n_beams - 9, found.deskewed.n_beams - 4))
    assert len(one.size) == 3
    assert one.size[2] == pytest.approx(1.7, abs=0.05)
    assert one.z is not None
    np.testing.assert_allclose(one.z, 0.85, atol=0.05)


def test_evidence_and_boxes_multiply_their_odds(monkeypatch):
    monkeypatch.setattr(tilting, "_P_INSIDE", 0.9)
    monkeypatch.setattr(tilting, "_P_AROUND", 0.75)
    share = 0.8
    static = np.array([share, share, 0.999, 0.3, share], np.float32)  # of which two are in no box
    core = BoxBeams(np.array([0, 2]), np.array([True, True]))
    # the first is in the core of the other
    margin = BoxBeams(np.array([0, 1]), np.array([False, False]))
    found = apply_boxes(static, [core, margin], share)
    odds = 999 / 4 / 9
    np.testing.assert_allclose(found, [0.1, 0.25, odds / (1 + odds), 0.3, share], rtol=1e-4)
    assert static[0] == np.float32(share)


def test_static_after_the_object_has_left():
    _, p_static = built(PERSON, [2000] * 5, [walker([0.5, 1.0, 1.5])])
    assert (p_static > 0.5).all()


def test_vehicles_may_be_higher():
    tall = [[2.0, 0.0, z] for z in (0.5, 0.9, 1.3, 1.7, 2.1, 2.5)]
    _, as_person = built(tall, [1000] * 6, [walker([0.5, 1.0, 1.5])])
    assert (as_person < 0.5).tolist() == [True] * 4 + [False] * 2
    _, as_van = built(tall, [1000] * 6, [walker([0.5, 1.0, 1.5], (4.0, 1.8))])
    assert (as_van < 0.5).all()


def test_standing_object_keeps_its_heading():
    one = walker([0.5, 1.0, 1.5])
    one.velocity[1:] = 0.0
    np.testing.assert_allclose(box_of(one).heading, [[0.0, 1.0]] * 3)
