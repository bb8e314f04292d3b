"""Sessions: one world on several days, what stands where, and what each beam hit."""

import json
from functools import cache, partial

import numpy as np
import pytest
from place_truth import load_session_truth

from stillmap.core.errors import InputError
from stillmap.io.stillmap_folder import read
from stillmap.results.eval.map import distance_to_walls
from stillmap.sim import Scene, scene_by_name
from stillmap.sim.session_layout import Floor, meets_box
from stillmap.sim.sessions import (
    draw_piece,
    list_changes,
    plan_sessions,
    simulate_sessions,
    write_sessions,
)

QUICK = {"laser": {"beams": 90}, "robot": {"scans": 150}, "crowd": {"people": 3}}


@cache
def quick_plan(count=3, **options):
    return plan_sessions(scene_by_name("office", QUICK), count, 2, **options)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sessions") / "days"
    write_sessions([quick_plan()], folder, seed=2)
    return folder


@pytest.mark.slow
def test_more_sessions_leave_the_first_ones_as_they_are():
    few, more = quick_plan(2), quick_plan(4, has_odd_sensor=False)
    assert few.first_stamp_ns == more.first_stamp_ns[:2]
    assert few.seeds == more.seeds[:2]
    for one, other in zip(few.scenes, more.scenes, strict=False):
        assert one.route == other.route
        assert one.things == other.things


def test_sessions_differ_in_start_mount_sensor_and_day():
    plan = quick_plan(4)
    starts = np.array([scene.route[0] for scene in plan.scenes])
    apart = np.hypot(*(starts[:, None] - starts).transpose(2, 0, 1))[np.triu_indices(4, 1)]
    assert apart.min() > 0.5
    assert len({(s.laser.x, s.laser.y, s.laser.yaw) for s in plan.scenes}) == 4
    assert sorted(s.laser.beams < 90 for s in plan.scenes) == [False, False, False, True]
    days = np.diff(plan.first_stamp_ns) / 86_400e9
    assert (days > 0.6).all()
    assert (days < 1.4).all()


def test_furniture_and_doors_change_and_something_stays():
    plan = quick_plan()
    kinds = {change.kind for change in list_changes(plan.objects, None)}
    assert {"moved", "door"} < kinds
    assert kinds & {"appeared", "gone"}
    assert 0.1 < np.mean([one.is_changed for one in plan.objects]) < 0.9


def test_sessions_of_a_street_begin_where_they_are_told():
    scene = scene_by_name("street", {"robot": {"scans": 100}})
    routes = [partial(draw_piece, begin=begin) for begin in (0.0, 30.0, 1e6)]
    plan = plan_sessions(scene, 3, 2, routes=routes)
    x = [one.route[0][0] for one in plan.scenes]
    assert x[0] == pytest.approx(6.0, abs=0.6)
    assert x[1] == pytest.approx(36.0, abs=0.6)
    assert plan.scenes[2].route[-1][0] == pytest.approx(8.0, abs=0.6)  # the last piece there is


def test_furniture_stands_in_nothing():
    plan = quick_plan(4)
    for session, scene in enumerate(plan.scenes):
        solid = np.array([*scene.walls, *scene.glass], float)
        for one in plan.objects:
            place = one.places[session]
            if place is None or one.kind == "door" or one.places[0] == place:
                continue  # as the world had it, or as in the first session
            half = np.abs(np.array(one.faces)[:, :2]).max(axis=0)
            assert not meets_box(solid, place, half), (session, one)


def test_a_new_cupboard_closes_no_way():
    # two rooms joined by a passage of 1 m: no box of 0.8 m may stand in it
    walls = ((0.0, 0.0, 10.0, 0.0), (10.0, 0.0, 10.0, 4.0), (10.0, 4.0, 0.0, 4.0))
    walls = (*walls, (0.0, 4.0, 0.0, 0.0), (5.0, 0.0, 5.0, 1.5), (5.0, 2.5, 5.0, 4.0))
    scene = Scene(name="two rooms", walls=walls, route=((2.0, 2.0), (8.0, 2.0)))
    floor = Floor(scene, walls, np.empty((0, 3)))
    rng = np.random.default_rng(0)
    places = [floor.find_place((0.8, 0.8), np.empty((0, 4)), rng) for _ in range(60)]
    found = np.array([(p.x, p.y) for p in places if p is not None])
    assert len(found) > 40
    assert not (np.hypot(*(found - (5.0, 2.0)).T) < 0.7).any()


def test_beams_know_the_object_they_hit(written):
    truth = load_session_truth(written)
    for session, name in enumerate(truth.names):
        recording, beams = read(written / name), truth.beams(session)
        ends = recording.end_points(np.arange(recording.n_beams), beams.T_world_base)
        numbers = np.unique(beams.thing)
        assert len(numbers) > 5
        for number in numbers[numbers >= 0].tolist():
            own = beams.thing == number
            assert beams.static[own].all()
            faces = truth.objects[number].faces_in(session)
            assert distance_to_walls(ends[own], faces).max() < 0.1
        others = beams.static & (beams.thing < 0)
        faces = truth.faces(session)
        assert np.mean(distance_to_walls(ends[others], faces) < 0.02) < 0.02
        changed = truth.changed_beams(session)
        is_changed = np.array([one.is_changed for one in truth.objects])
        assert is_changed[changed[changed >= 0]].all()
        assert 0 < np.count_nonzero(changed >= 0) < np.count_nonzero(beams.thing >= 0)


def test_truth_is_read_as_it_was_planned(written):
    truth, plan = load_session_truth(written), quick_plan()
    assert truth.objects == plan.objects
    assert list(truth.changes) == list_changes(plan.objects, None)
    for k, name in enumerate(truth.names):
        beams = truth.beams(k)
        np.testing.assert_allclose(beams.T_world_base[0], truth.T_world_session[k])
        assert read(written / name).stamp_ns[0] == 10**18 + plan.first_stamp_ns[k]
    assert np.all(np.diag(truth.overlap) > 0.95)


def test_the_same_seed_gives_the_same_files(written, tmp_path):
    write_sessions([quick_plan()], tmp_path / "again", seed=2)
    files = [path.relative_to(written) for path in written.rglob("*") if path.is_file()]
    assert len(files) > 30
    for file in files:
        assert (written / file).read_bytes() == (tmp_path / "again" / file).read_bytes(), file


def test_damaged_truth_is_refused(tmp_path):
    with pytest.raises(InputError, match="holds no truth about sessions"):
        load_session_truth(tmp_path)
    for text in ("{", "[]", json.dumps({"sessions": [{"name": "../x"}], "objects": []})):
        (tmp_path / "sessions.json").write_text(text)
        with pytest.raises(InputError, match=r"is damaged|is not JSON"):
            load_session_truth(tmp_path)


@pytest.mark.parametrize("name", ["office-moved", "street-moved"])
def test_worlds_that_change_meanwhile_are_refused(name):
    with pytest.raises(InputError, match="move within a recording"):
        plan_sessions(scene_by_name(name), 2)


def test_parked_cars_change_in_a_street_in_3d():
    lidar = {"channels": 16, "columns": 300}
    robot = {"scans": 6, "speed": 0.2, "turn_rate": 0.01}  # or a sweep would be bent
    scene = scene_by_name("street-empty", {"lidar": lidar, "robot": robot})
    plan = plan_sessions(scene, 2, 1)
    kinds = {change.kind for change in list_changes(plan.objects, scene.heights)}
    assert kinds <= {"moved", "gone", "appeared"}
    assert kinds
    for session, one in enumerate(simulate_sessions(plan)):
        thing = one.truth.thing
        assert one.truth.static[thing >= 0].all()
        ends = one.recording.end_points(np.arange(one.recording.n_beams), one.truth.T_world_base)
        for number in np.unique(thing[thing >= 0]).tolist():
            corners = plan.objects[number].faces_in(session).reshape(-1, 2)
            (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
            own = ends[thing == number]
            assert (own.min(axis=0)[:2] > (x0 - 0.3, y0 - 0.3)).all()
            assert (own.max(axis=0) < (x1 + 0.3, y1 + 0.3, 2.5)).all()
