"""Objects of simulated recordings, with true labels and poses."""

import dataclasses
import functools

import numpy as np
import pytest
from rooms import drive

from stillmap.core import arrays
from stillmap.sim.walls import box
from stillmap.tracking import ObjectOptions, joins, track_objects, tracklets
from stillmap.tracking.objects import estimate_center_offset, measure_box

OPTIONS = ObjectOptions()


@functools.cache
def room(people=6, shape="bodies"):
    walls, route = (*box(0, 0, 16, 12), *box(3, 2, 0.6, 0.6)), ((-6, -4), (6, -4), (6, 4))
    crowd = {"people": people, "shape": shape}
    return drive(3, walls, route, crowd=crowd, laser={"beams": 181, "max_range": 20.0})


def labels(simulation):
    return np.where(simulation.truth.static, 0.98, 0.02).astype(np.float32)


def found(simulation, options=OPTIONS):
    return track_objects(
        simulation.recording, simulation.truth.T_world_base, labels(simulation), options
    )


@pytest.mark.parametrize("shape", ["bodies", "legs"])
def test_people_are_found_and_followed(shape):
    simulation = room(shape=shape)
    truth, mover = simulation.truth, simulation.truth.mover
    objects = found(simulation)
    assert [one.id for one in objects] == list(range(len(objects)))
    of_walker = np.array([np.bincount(mover[one.beams]).argmax() for one in objects])
    beams = np.concatenate([one.beams for one in objects])
    assert len(np.unique(beams)) == len(beams)
    assert len(beams) > 0.97 * np.count_nonzero(mover >= 0)
    own = [mover[one.beams] == k for one, k in zip(objects, of_walker, strict=True)]
    assert np.mean(np.concatenate(own)) > 0.97
    seconds = 1e-9 * simulation.recording.stamp_ns
    velocity = np.gradient(truth.movers[:, :, :2], seconds, axis=0)
    off, speed = [], []
    for one, k in zip(objects, of_walker, strict=True):
        off.append(np.linalg.norm(one.xy - truth.movers[one.scan, k, :2], axis=1))
        true = np.linalg.norm(velocity[one.scan, k], axis=1)
        speed.append(np.abs(np.linalg.norm(one.velocity, axis=1) - true))
    assert np.median(np.concatenate(off)) < 0.1
    assert np.median(np.concatenate(speed)) < 0.1


@pytest.mark.parametrize("block", [300, 5000])
def test_pieces_of_any_size_and_files_make_no_difference(monkeypatch, tmp_path, block):
    simulation = room(shape="legs")
    whole = found(simulation)
    monkeypatch.setattr(arrays, "MAX_BYTES_IN_MEMORY", 0)
    monkeypatch.setattr(arrays, "BLOCK", block)
    monkeypatch.setattr(joins, "_MAX_ENDS", 7)
    recording = dataclasses.replace(simulation.recording, scratch=tmp_path)
    pieces = found(dataclasses.replace(simulation, recording=recording))
    assert len(pieces) == len(whole) > 3
    for one, other in zip(pieces, whole, strict=True):
        assert (one.id, one.size, one.p_dynamic) == (other.id, other.size, other.p_dynamic)
        for name in ("scan", "stamp_ns", "xy", "velocity", "beams"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert list(tmp_path.iterdir()) == []


def test_what_an_object_says_of_itself():
    recording = room().recording
    scan = recording.scans_of(np.arange(recording.n_beams))
    for one in found(room()):
        np.testing.assert_array_equal(one.scan, np.unique(scan[one.beams]))
        np.testing.assert_array_equal(one.stamp_ns, recording.stamp_ns[one.scan])
        assert one.xy.shape == one.velocity.shape == (len(one.scan), 2)
        assert (np.diff(one.beams) > 0).all()
        assert one.p_dynamic == pytest.approx(0.98, abs=1e-6)
        assert 0.0 <= one.size[1] < 0.9
        assert len(one.scan) >= tracklets.MIN_TRACK_SCANS


def test_nobody_is_there_or_asked_for():
    assert found(room(people=0)) == []
    assert found(room(), dataclasses.replace(OPTIONS, enabled=False)) == []


def test_an_edge_that_flickers_is_no_object():
    simulation = room(people=0)
    p = labels(simulation)
    recording, poses = simulation.recording, simulation.truth.T_world_base
    # single beams on one corner of the box, again and again
    xy = recording.end_points(np.arange(recording.n_beams), poses)
    near = np.flatnonzero(recording.hit & (np.linalg.norm(xy - [2.7, 1.7], axis=1) < 0.03))
    p[near] = 0.05
    assert len(near) > 10
    assert track_objects(recording, poses, p, OPTIONS) == []
    anything = dataclasses.replace(OPTIONS, min_extent=0.0)
    assert len(track_objects(recording, poses, p, anything)) > 0


def test_a_box_by_hand():
    rng = np.random.default_rng(0)
    offset = rng.uniform([-2.0, -0.5], [2.0, 0.5], (4000, 2))
    walks = np.tile([1.0, 0.0], (4000, 1))
    # a twentieth is left out on either side
    assert measure_box(offset, walks) == pytest.approx((3.6, 0.9), abs=0.05)
    assert measure_box(offset, walks[:, ::-1]) == pytest.approx((0.9, 3.6), abs=0.05)
    c, s = np.cos(0.5), np.sin(0.5)
    turned = offset @ np.array([[c, s], [-s, c]])
    assert measure_box(turned, np.zeros_like(walks)) == pytest.approx((3.6, 0.9), abs=0.06)


def test_the_middle_of_a_disc_lies_behind_what_is_seen_of_it():
    # rays from two places that see half of a disc of 0.3 m at (5, 1)
    sensor, centre, radius = np.array([[0.0, 1.0], [5.0, -6.0]]), np.array([5.0, 1.0]), 0.3
    xy, at = [], []
    for k, origin in enumerate(sensor):
        facing = np.arctan2(*(origin - centre)[::-1])
        angle = facing + np.arcsin(np.linspace(-1.0, 1.0, 401))  # as even beams far off see it
        xy.append(centre + radius * np.column_stack([np.cos(angle), np.sin(angle)]))
        at += [k] * 401
    middle = np.array([points.mean(axis=0) for points in xy])
    found = middle + estimate_center_offset(middle, sensor, np.concatenate(xy), np.array(at))
    np.testing.assert_allclose(found, [centre, centre], atol=2e-3)
    # no thing is deeper than a car
    y = np.linspace(-10.0, 10.0, 50)
    xy = np.column_stack([np.full(50, 8.0), y])
    found = estimate_center_offset(np.array([[8.0, 0.0]]), np.zeros((1, 2)), xy, np.zeros(50, int))
    np.testing.assert_allclose(found, [[0.9, 0.0]])
