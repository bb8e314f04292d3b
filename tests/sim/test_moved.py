"""The worlds in which things are moved: the robot looks before and after."""

import functools

import numpy as np
import pytest
from marks import slow_params

from stillmap.sim import SCENES, Simulation, Stay, scene_by_name, simulate
from stillmap.sim.objects import place_faces
from stillmap.sim.planner import compute_segment_distance

pytestmark = pytest.mark.slow

MOVED = ("office-moved", "street-moved", "warehouse-moved")


@functools.cache
def run_of(name: str) -> Simulation:
    return simulate(scene_by_name(name), 3)


@pytest.fixture(params=["office-moved", "street-moved", *slow_params("warehouse-moved")])
def moved(request: pytest.FixtureRequest) -> Simulation:
    return run_of(request.param)


def end(stay: Stay) -> float:
    return np.inf if stay.until is None else stay.until


@pytest.mark.slow
def test_every_thing_is_seen_wherever_it_stays(moved: Simulation) -> None:
    recording, truth = moved.recording, moved.truth
    seconds = 1e-9 * (recording.stamp_ns - recording.stamp_ns[0])
    when = np.repeat(seconds, np.diff(recording.offset))
    first = truth.scene["mover_kinds"].index("thing")
    for number, thing in enumerate(moved.scene.things, start=first):
        hits = when[truth.mover == number]
        for stay in thing.stays:
            assert np.count_nonzero((hits >= stay.since) & (hits < end(stay))) > 50


def test_all_of_them_change_and_they_are_no_walls(moved: Simulation) -> None:
    kinds = moved.truth.scene["mover_kinds"]
    assert kinds.count("thing") == len(moved.scene.things) >= 7
    assert {"person", "thing"} < set(kinds)
    middles = (moved.truth.walls[:, :2] + moved.truth.walls[:, 2:]) / 2
    for thing in moved.scene.things:
        faces = place_faces(thing, thing.stays[0])
        for x, y in (faces[:, :2] + faces[:, 2:]) / 2:
            assert np.hypot(*(middles - (x, y)).T).min() > 1e-6


def test_nothing_stands_in_a_wall_or_in_another_thing(moved: Simulation) -> None:
    stays = [(thing, stay) for thing in moved.scene.things for stay in thing.stays]
    for thing, stay in stays:
        corners = place_faces(thing, stay)[:, :2]
        others = [
            place_faces(other, its)
            for other, its in stays
            if other is not thing and its.since < end(stay) and stay.since < end(its)
        ]
        for face in np.concatenate([moved.truth.walls, *others]):
            assert compute_segment_distance(corners, face).min() > 0.02


def test_they_take_minutes(moved: Simulation) -> None:
    recording, pause = moved.recording, moved.truth.scene["robot"]["pause"]
    seconds = 1e-9 * (recording.stamp_ns[-1] - recording.stamp_ns[0])
    if moved.scene.name == "warehouse-moved":
        assert seconds > pause
        seconds -= pause
    assert 120 < seconds < 600


def test_things_are_moved_though_nobody_is_there() -> None:
    for name in MOVED:
        scene = SCENES[f"{name}-empty"]()
        assert scene.things == SCENES[name]().things
        assert scene.crowd.people == 0


def test_the_other_walls_are_those_of_the_world_it_was_made_of(moved: Simulation) -> None:
    before = set(SCENES[moved.scene.name.removesuffix("-moved")]().walls)
    left = set(moved.scene.walls)
    assert left < before
    lifted = sum(len(thing.faces) for thing in moved.scene.things if thing.stays[0].since == 0.0)
    drawn = 4 if moved.scene.name == "office-moved" else 0  # the trolley
    assert len(before) - len(left) == lifted - drawn
