"""Which beams met a thing that moves."""

import numpy as np
import pytest
from made_up_street import Car, Part, by_several, street

from stillmap.mesh.inputs import LidarReturns
from stillmap.mesh.objects.segmentation import (
    DynamicReturns,
    beams_in_frame,
    cluster_cells,
    grow_segment,
    in_viewing_cone,
    segment_object,
    unique_cells,
)
from stillmap.mesh.point_colors import TrackedReturns
from stillmap.mesh.tracked_boxes import ObjectFrame

TWO = [Car((8.0, -2.0), (6.0, 0.0)), Car((20.0, 4.0), (-4.0, 0.0))]


def test_all_that_moves_is_known_once() -> None:
    sources = street(TWO, [Part(0), Part(1)])
    moves = DynamicReturns.collect(sources)
    np.testing.assert_array_equal(moves.beam, np.flatnonzero(sources.p_static < 0.5))
    np.testing.assert_array_equal(
        moves.ends, sources.deskewed.end_points(moves.beam, sources.poses)
    )
    for one in sources.objects:
        np.testing.assert_array_equal(moves.beam[moves.owner == one.id], one.beams)
    assert not moves.is_planar
    assert moves.is_dynamic.all()
    some = moves.in_beam_range(5000, 9000)
    np.testing.assert_array_equal(moves.beam[some], [b for b in moves.beam if 5000 <= b < 9000])


def test_beams_have_times_of_their_own() -> None:
    sources = street(TWO, [Part(0)])
    beams = np.array([3, 6000, 6001])
    later = np.linspace(0.0, 0.05, sources.recording.n_beams).astype(np.float32)
    object.__setattr__(sources.recording, "beam_time", later)
    scan = sources.recording.scans_of(beams)
    expected = 1e-9 * sources.recording.stamp_ns[scan] + later[beams]
    np.testing.assert_allclose(sources.seconds_of(beams), expected, atol=2e-9)
    about = sources.scans_within(0.3, 0.4)
    assert about.start <= 2
    assert about.stop >= 5


@pytest.mark.parametrize("lidars", [1, 2, 6])
def test_beams_of_lidars_that_begin_at_once_are_found(lidars: int) -> None:
    sources = by_several(street(TWO, [Part(0)]), lidars)
    seconds = sources.seconds_of(np.arange(sources.recording.n_beams))
    for now in (0.28, 0.3, 0.389):
        scans = sources.scans_within(now, now)
        about = sources.recording.offset[[scans.start, scans.stop]]
        then = np.flatnonzero(np.abs(seconds - now) < 1e-3)
        assert about[0] <= then[0]
        assert then[-1] < about[1]
    # of a picture, too
    ends, _ = LidarReturns(sources).near_time(280_000_000)
    assert len(ends) == np.count_nonzero(np.abs(seconds - 0.28) <= 0.06)
    moving = TrackedReturns.collect(DynamicReturns.collect(sources))
    beams = sources.objects[0].beams
    found = moving.near_time(0.28, 0.07).beam
    np.testing.assert_array_equal(np.sort(found), beams[np.abs(seconds[beams] - 0.28) <= 0.07])
    assert len(found) > 0


def test_a_thing_has_what_ended_in_its_box_and_nothing_of_others() -> None:
    sources = street(TWO, [Part(0), Part(1)])
    moves = DynamicReturns.collect(sources)
    for one, thing in zip(sources.objects, sources.boxes, strict=True):
        own = segment_object(one, thing, moves)
        np.testing.assert_array_equal(moves.beam[own], one.beams)


def test_what_is_followed_by_nobody_is_its_own_in_its_box() -> None:
    sources = street(TWO, [Part(0), Part(1)])
    one, thing = sources.objects[0], sources.boxes[0]
    moves = DynamicReturns.collect(sources)
    free = moves._replace(owner=np.where(moves.owner == 0, -1, moves.owner).astype(np.int32))
    own = segment_object(one, thing, free)
    # but for the lowest row, which may be the ground's
    assert set(moves.beam[own]) <= set(one.beams)
    assert len(own) > 0.9 * len(one.beams)


def test_a_part_grows_to_the_whole_and_not_to_the_next_car() -> None:
    cars = [Car((12.0, -4.0), (3.0, 0.0)), Car((19.0, -4.0), (3.0, 0.0))]
    sources = street(cars, [Part(0, 0.0, 0.2), Part(1)])
    moves = DynamicReturns.collect(sources)
    one, thing = sources.objects[0], sources.boxes[0]
    own = segment_object(one, thing, moves)
    within = moves.in_beam_range(0, int(sources.deskewed.offset[1]))
    every = np.arange(within.start, within.stop)
    own = own[own < within.stop]
    whole = grow_segment(
        own, every, ObjectFrame.from_track(thing), np.array([-12.0, 4.0, 1.0]), moves
    )
    other = set(sources.objects[1].beams)
    assert len(whole) > 1.2 * len(own)
    assert not other & set(moves.beam[whole].tolist())
    assert set(own) <= set(whole)


def test_cells_are_those_of_numpy() -> None:
    points = np.random.default_rng(2).normal(0.0, 3.0, (500, 3))
    cells, of = unique_cells(points, 0.5)
    expected, inverse = np.unique(np.floor(points / 0.5), axis=0, return_inverse=True)
    np.testing.assert_array_equal(cells, expected)
    np.testing.assert_array_equal(of, inverse.ravel())
    with pytest.raises(ValueError, match="too far apart"):
        unique_cells(np.array([[0.0, 0.0, 0.0], [1e9, 1e9, 1e9]]), 0.01)


def test_pieces_are_as_far_apart_as_the_link_is_long() -> None:
    x = np.array([0.0, 0.3, 0.6, 2.0, 2.3])
    points = np.stack([x, np.zeros(5), np.zeros(5)], axis=1)
    piece = cluster_cells(points, 0.1, 0.5)
    assert len(set(piece[:3])) == 1
    assert len(set(piece[3:])) == 1
    assert piece[0] != piece[4]
    assert len(set(cluster_cells(points, 0.1, 1.6))) == 1


def test_beams_that_pass_beside_a_thing_are_found_among_all() -> None:
    sources = street(TWO, [Part(0), Part(1)])
    mine = sources.objects[0].beams
    mine = mine[mine < sources.deskewed.offset[1]]
    beams = np.setdiff1d(np.arange(sources.deskewed.offset[1]), mine)
    near = in_viewing_cone(mine, beams, sources)
    assert 0 < near.sum() < len(beams) / 2
    # no beam within the outline is lost
    turn = np.arctan2(sources.deskewed.points[:, 1], sources.deskewed.points[:, 0])
    rise = sources.deskewed.points[:, 2] / np.linalg.norm(sources.deskewed.points, axis=1)
    within = (turn[beams] >= turn[mine].min()) & (turn[beams] <= turn[mine].max())
    within &= (rise[beams] >= rise[mine].min()) & (rise[beams] <= rise[mine].max())
    assert near[within].all()
    assert within.any()


def test_beams_from_nowhere_go_on() -> None:
    sources = street(TWO, [Part(0)])
    lost = np.array([10])
    sources.deskewed.hit[lost] = False
    look = beams_in_frame(lost, np.zeros(1), ObjectFrame.from_track(sources.boxes[0]), sources)
    assert np.linalg.norm(look.points - look.origin, axis=1) == pytest.approx(1000.0)
