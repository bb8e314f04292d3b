"""Which beams met a thing that moves."""

import numpy as np
from made_up_street import Car, Part, street

from stillmap.mesh.inputs import ObjectFrame
from stillmap.mesh.returns import DynamicReturns, cluster_points, grow_segment, segment_object

TWO = [Car((8.0, -2.0), (6.0, 0.0)), Car((20.0, 4.0), (-4.0, 0.0))]


def test_a_thing_has_what_ended_in_its_box_and_nothing_of_others() -> None:
    sources = street(TWO, [Part(0), Part(1)])
    moves = DynamicReturns.collect(sources)
    for one, thing in zip(sources.objects, sources.boxes, strict=True):
        own = segment_object(one, thing, moves)
        np.testing.assert_array_equal(moves.beam[own], one.beams)


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


def test_links_are_longer_where_beams_lie_farther_apart() -> None:
    y = np.array([0.0, 0.3, 0.6, 2.0, 2.3])
    for away, pieces in ((2.0, 2), (60.0, 1)):
        points = np.stack([np.full(5, away), y, np.zeros(5)], axis=1)
        piece = cluster_points(points, np.zeros(3))
        assert len(set(piece[:3])) == len(set(piece[3:])) == 1
        assert len(set(piece)) == pieces
