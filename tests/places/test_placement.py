"""Placement of sessions of made-up rooms: found, ambiguous, undetermined, foreign."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap import places
from stillmap.core import se2
from stillmap.places.evidence import measure_evidence
from stillmap.places.grow import add_session, start_place
from stillmap.places.keyframes import Session, chain_poses, select_keyframes
from stillmap.places.surface_map import compare_maps, is_determined, make_surface_map

# corners of rooms, in order; metres
RECTANGLE = [(0, 0), (12, 0), (12, 7), (0, 7)]
L_SHAPE = [(0, 0), (14, 0), (14, 5), (6, 5), (6, 11), (0, 11)]
OTHER = [(0, 0), (9, 0), (9, 3), (16, 3), (16, 8), (0, 8)]


def scan(corners, poses, n_beams=180, max_range=25.0):
    """A recording of a room seen all round from poses (T, 3, 3), without noise."""
    ends = np.array([*corners, corners[0]], float)
    a, b = ends[:-1], ends[1:]
    angles = np.linspace(-np.pi, np.pi, n_beams, endpoint=False)
    points = []
    for x, y, theta in se2.parameters(poses):
        d = np.stack([np.cos(angles + theta), np.sin(angles + theta)], axis=1)[:, None]
        e, to_a = (b - a)[None], (a - (x, y))[None]
        cross = d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (to_a[..., 0] * e[..., 1] - to_a[..., 1] * e[..., 0]) / cross
            u = (to_a[..., 0] * d[..., 1] - to_a[..., 1] * d[..., 0]) / cross
        t = np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf).min(axis=1)
        points.append(np.stack([np.cos(angles), np.sin(angles)], axis=1) * t[:, None])
    T = len(poses)
    points = np.concatenate(points).astype(np.float32)
    hit = np.linalg.norm(points, axis=1) < max_range
    points[~hit] = np.nan
    return of_one_sensor(np.arange(T) * 1_000_000_000, np.arange(T + 1) * n_beams, points, hit)


def make_session(name, recording, poses, p_static):
    graph = chain_poses(poses)
    keyframes = select_keyframes(recording, poses, p_static, graph.keyframes)
    known = (name, None, recording.stamp_ns, poses, graph, keyframes)
    return Session(*known, (0.2, 1.8), np.zeros(3))


def session(name, corners, way, n=40):
    """A session that drove along a way through a room, in the frame of its own first pose."""
    way = np.array(way, float)
    at = np.linspace(0, len(way) - 1, n)
    x, y = (np.interp(at, np.arange(len(way)), column) for column in way.T)
    heading = np.arctan2(np.gradient(y), np.gradient(x))
    world = se2.matrix(x, y, heading)
    recording = scan(corners, world)
    poses = se2.inverse(world[0]) @ world
    p_static = np.where(recording.hit, np.float32(1.0), np.float32(np.nan))
    return make_session(name, recording, poses, p_static), world[0]


def grow(first, second):
    return add_session(start_place(first, 0.05, 0.15, 1), second, 1)


def test_a_session_from_another_start_is_found():
    first, T_first = session("a", L_SHAPE, [(1, 1), (12, 2), (3, 3), (2, 9)])
    second, T_second = session("b", L_SHAPE, [(4, 9), (2, 4), (10, 3), (12, 1)])
    place, why = grow(first, second)
    assert not why
    error = se2.parameters(se2.inverse(se2.inverse(T_first) @ T_second) @ place.sessions[1].T)
    assert np.hypot(*error[:2]) < 0.03
    assert abs(error[2]) < 0.005
    assert place.sessions[1].overlap > 0.9


def test_a_room_that_fits_both_ways_round_is_refused():
    first, _ = session("a", RECTANGLE, [(2, 2), (10, 2), (10, 5), (2, 5)])
    second, _ = session("b", RECTANGLE, [(9, 5), (3, 5), (3, 2), (8, 2)])
    place, why = grow(first, second)
    assert "another" in why
    assert len(place.sessions) == 1


def test_another_room_is_refused():
    first, _ = session("a", L_SHAPE, [(1, 1), (12, 2), (3, 3), (2, 9)])
    second, _ = session("b", OTHER, [(2, 1), (7, 2), (8, 6), (14, 5), (2, 6)])
    assert grow(first, second)[1]


@pytest.mark.parametrize("empty_first", [False, True])
def test_a_session_without_a_return_is_refused(empty_first):
    full, _ = session("full", L_SHAPE, [(1, 1), (12, 2), (3, 3), (2, 9)])
    poses = se2.matrix(np.arange(4.0), np.zeros(4), np.zeros(4))
    seen = scan(L_SHAPE, se2.matrix(1.0, 1.0, 0.0) @ poses)
    nothing = np.full_like(seen.points, np.nan)
    blind = replace(seen, points=nothing, hit=np.zeros_like(seen.hit))
    unknown = np.full(len(nothing), np.nan, np.float32)
    empty = make_session("empty", blind, poses, unknown)
    _, why = grow(*((empty, full) if empty_first else (full, empty)))
    assert why == "no part of it looks like the place"


def test_a_session_that_the_graph_puts_beside_the_place_is_refused(monkeypatch):
    first, _ = session("a", L_SHAPE, [(1, 1), (12, 2), (3, 3), (2, 9)])
    second, _ = session("b", L_SHAPE, [(4, 9), (2, 4), (10, 3), (12, 1)])
    optimize = places.grow._optimize

    def displace(place, placed, ties):
        grown, agreeing = optimize(place, placed, ties)
        *nodes, last = [one.nodes for one in grown.sessions]
        return grown.with_nodes([*nodes, se2.matrix(0.6, 0.3, 0.0) @ last]), agreeing

    monkeypatch.setattr("stillmap.places.grow._optimize", displace)
    assert "after optimization" in grow(first, second)[1]


def test_maps_agree_where_they_belong_and_contradict_elsewhere():
    first, _ = session("a", L_SHAPE, [(1, 1), (12, 2), (3, 3), (2, 9)])
    own = make_surface_map([measure_evidence(first.planar, first.planar.poses, 0.05, 1)])
    same, moved = (
        compare_maps(own, own, np.eye(3)),
        compare_maps(own, own, se2.matrix(1.0, 0.5, 0.1)),
    )
    assert same.conflict == 0
    assert same.agree > 500
    assert moved.conflict > moved.agree
    assert moved.score < 0 < same.score


@pytest.mark.parametrize(
    ("corners", "way", "determined"),
    [
        (L_SHAPE, [(1, 1), (12, 2), (3, 3), (2, 9)], True),
        ([(0, 0), (400, 0), (400, 2.5), (0, 2.5)], [(196, 1.2), (204, 1.3)], False),
    ],
    ids=["room", "corridor without ends"],
)
def test_whether_the_maps_alone_say_where_a_session_is(corners, way, determined):
    one, _ = session("a", corners, way)
    own = make_surface_map([measure_evidence(one.planar, one.planar.poses, 0.05, 1)])
    assert is_determined(own, own, np.eye(3)) == determined


def test_what_another_session_passed_is_no_surface():
    """Else all that ever stood somewhere would speak against a further session."""
    longer = [(0, 0), (16, 0), (16, 7), (0, 7)]
    way = [(2, 2), (10, 2), (10, 5)]
    evidence = []
    for corners in (RECTANGLE, longer):
        one, T = session("one", corners, way)
        evidence.append(measure_evidence(one.planar, T @ one.planar.poses, 0.05, 1))

    def wall_at(x, sessions):
        surface = make_surface_map(sessions).surface
        near = np.abs(surface[:, 0] - x) < 0.15
        return np.count_nonzero(near & (np.abs(surface[:, 1] - 3.5) < 2.0))

    first = evidence[0]
    assert wall_at(12.0, [first]) > 20
    assert wall_at(12.0, evidence) < 5  # it is gone, or not there yet
    assert wall_at(16.0, evidence) > 20
    assert wall_at(0.0, evidence) == wall_at(0.0, [first])
