"""Which beams met a thing that moves, and which tracks are of one thing."""

import dataclasses

import numpy as np
from made_up_street import Car, Part, reconstruct_one, street

from stillmap.mesh.inputs import MeshInputs, TrackedBox
from stillmap.mesh.returns import (
    DynamicReturns,
    cluster_points,
    collect_tracks,
    merge_tracks,
    segment_object,
)
from stillmap.tracking.boxes import fit_box

TWO = [Car((8.0, -2.0), (6.0, 0.0)), Car((20.0, 4.0), (-4.0, 0.0))]


def test_a_thing_has_what_ended_in_its_box_and_nothing_of_others() -> None:
    sources = street(TWO, [Part(0), Part(1)])
    moves = DynamicReturns.collect(sources)
    for one, thing in zip(sources.objects, sources.boxes, strict=True):
        own = segment_object(one, thing, moves)
        np.testing.assert_array_equal(moves.beam[own], one.beams)


def test_links_are_longer_where_beams_lie_farther_apart() -> None:
    y = np.array([0.0, 0.3, 0.6, 2.0, 2.3])
    for away, pieces in ((2.0, 2), (60.0, 1)):
        points = np.stack([np.full(5, away), y, np.zeros(5)], axis=1)
        piece = cluster_points(points, np.zeros(3))
        assert len(set(piece[:3])) == len(set(piece[3:])) == 1
        assert len(set(piece)) == pieces


CAR = Car((6.0, -2.5), (6.0, 0.0))


def _wholes(sources: MeshInputs) -> list[list[int]]:
    moves = DynamicReturns.collect(sources)
    followed = collect_tracks(moves)
    found = merge_tracks(followed, moves)
    return [[one.object.id for one in whole] for whole in found]


def test_front_and_rear_of_a_car_are_one() -> None:
    parts = [Part(0, 0.0, 0.3), Part(0, 0.5, 1.0), Part(0, 0.3, 0.5, (2, 6))]
    assert _wholes(street([CAR], parts)) == [[0, 1, 2]]


def test_cars_one_behind_the_other_and_beside_are_two() -> None:
    behind = [CAR, Car((13.0, -2.5), (6.0, 0.0))]
    assert _wholes(street(behind, [Part(0), Part(1)])) == [[0], [1]]
    beside = [CAR, Car((6.0, 2.5), (6.0, 0.0))]
    assert _wholes(street(beside, [Part(0), Part(1)])) == [[0], [1]]


def test_a_track_of_two_cars_does_not_make_them_one() -> None:
    row = [Car((7.0, -4.0), (6.0, 0.0)), Car((15.0, -4.0), (6.0, 0.0))]
    one_and_the_next = Part(0, 0.0, 0.2, (0, 3)), Part(1, 0.0, 0.2, (3, 8))
    sources = street(row, [Part(0, 0.2, 1.0), Part(1, 0.2, 1.0), *one_and_the_next])
    first, last = sources.objects[2:]
    names = ("scan", "stamp_ns", "xy", "velocity", "beams", "z")
    ways = {name: np.concatenate([getattr(one, name) for one in (first, last)]) for name in names}
    both = dataclasses.replace(first, **ways)
    thing = TrackedBox(fit_box(both, 0), np.zeros(len(both.scan)), both.size[2])
    objects, things = [*sources.objects[:2], both], [*sources.boxes[:2], thing]
    sources = dataclasses.replace(sources, objects=objects, boxes=things)
    assert sorted(_wholes(sources)) in ([[0, 2], [1]], [[0], [1, 2]])


def test_cars_in_a_row_that_are_one_from_afar_are_two() -> None:
    for scans, y in ((24, -4.0), (20, -4.0), (16, -3.0)):
        row = [Car((20.0, y), (-8.0, 0.0)), Car((26.0, y), (-8.0, 0.0))]
        assert _wholes(street(row, [Part(0), Part(1)], scans=scans)) == [[0], [1]]


def test_cars_that_pass_each_other_are_two() -> None:
    passing = [Car((8.0, -1.5), (6.0, 0.0)), Car((14.0, 1.5), (-6.0, 0.0))]
    assert _wholes(street(passing, [Part(0), Part(1)])) == [[0], [1]]


def test_what_is_left_over_of_a_car_is_no_thing() -> None:
    stands = Part(0, 0.6, 0.8, (2, 6), drift=(-6.0, 0.0))
    assert _wholes(street([CAR], [Part(0, 0.0, 0.6), stands])) == [[0]]


def test_one_model_shows_all_of_a_car_that_was_followed_in_parts() -> None:
    shape = reconstruct_one(street([CAR], [Part(0, 0.0, 0.3), Part(0, 0.3, 1.0)]))
    assert shape.id in (0, 1)
    T = shape.frame.T_map_object(shape.seconds)
    there = shape.mesh.vertices @ T[:3, :3].T + T[:3, 3]
    rear = CAR.start[0] - 2.0 + 6.0 * shape.seconds
    assert there[:, 0].min() < rear + 0.1
    assert there[:, 0].max() > rear + 3.6
