"""The streets with lights: who stops where, crowns above the road, nothing behind the park."""

import functools

import numpy as np
import pytest
from marks import slow_params

from stillmap.sim import Simulation, scene_by_name, simulate
from stillmap.sim.geometry import BOX, CYLINDER, ELLIPSOID, Ground
from stillmap.sim.world_3d import make_static_world, trace_loops

INNER, OUTER = 1.75, 5.25  # m, from the middle of the road to the middles of the lanes


@functools.cache
def run(name: str) -> Simulation:
    laser = {"beams": 45, "range_noise": 0.0}
    return simulate(scene_by_name(name, {"laser": laser}), 3)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*slow_params("street-jam"), "crossing"])
def test_the_robot_waits_at_a_light(name: str) -> None:
    x = run(name).truth.T_world_base[:, 0, 2]
    stands = np.abs(np.diff(x)) < 1e-3
    lights = [light.at[0] for light in run(name).scene.lights]
    assert 5.0 < stands.sum() / 10 < 60.0
    assert min(abs(x[np.flatnonzero(stands)[0]] - at) for at in lights) < 1.0


@pytest.mark.slow
def test_everybody_on_the_road_stops_and_the_queue_drives_on() -> None:
    truth = run("street-jam").truth
    cars = [k for k, kind in enumerate(truth.scene["mover_kinds"]) if kind == "car"]
    x, y = truth.movers[:, cars, 0].T, truth.movers[0, cars, 1]
    step = np.abs(np.diff(x, axis=1))
    stands = step < 1e-6
    east = y < 0
    assert np.isclose(y, np.where(east, -INNER, INNER)).all()
    assert (stands[east].sum(axis=1) > 20).all()
    assert stands[~east, :100].all()
    assert not stands[~east].all(axis=1).any()


def test_cars_that_cross_do_not_meet() -> None:
    truth = run("crossing").truth
    cars = [k for k, kind in enumerate(truth.scene["mover_kinds"]) if kind == "car"]
    at = truth.movers[:, cars]
    middle = np.hypot(at[..., 0], at[..., 1]) < 8.0
    along = np.abs(np.cos(at[..., 2])) > 0.5
    assert (middle & along).any(axis=1).sum() > 20 < (middle & ~along).any(axis=1).sum()
    both = (middle & along).any(axis=1) & (middle & ~along).any(axis=1)
    assert not both.any()


def test_crowns_reach_above_the_road_and_over_who_passes() -> None:
    scene = scene_by_name("crossing")
    ground = Ground.of(scene.ground, np.reshape(scene.pavements, (-1, 4)))
    solids = make_static_world(scene, ground).solids
    crowns = solids.form == ELLIPSOID
    x, y, _, foot = solids.pose[0, crowns].T
    assert crowns.sum() >= 15
    assert (np.abs(y) - solids.half[crowns, 1] < OUTER).sum() >= 8
    assert (np.abs(x) - solids.half[crowns, 0] < OUTER - 0.9).sum() >= 4  # above the cars
    assert (solids.z[crowns, 0] + foot > 2.2).all()
    trunks = solids.form == CYLINDER
    np.testing.assert_allclose(solids.pose[0, trunks, :2], np.stack([x, y], axis=-1))
    assert (solids.form == BOX).sum() > 10 * 6  # parked cars


def test_people_walk_along_the_wall_of_the_narrow_pavement() -> None:
    truth = run("crossing").truth
    people = [k for k, kind in enumerate(truth.scene["mover_kinds"]) if kind == "person"]
    x, y = truth.movers[:, people, 0], truth.movers[:, people, 1]
    there = (np.abs(x) > 14) & (x * y > 0)
    assert there.any(axis=0).sum() >= 2
    assert np.ptp(x[:, there.any(axis=0)], axis=0).max() > 10.0
    # houses have niches and yards
    away = 11.0 - np.abs(y[there])
    assert away.max() < 1.6
    assert np.median(away) < 1.2


def test_an_outline_is_a_thing_if_it_closes_and_is_no_room() -> None:
    def shifted(segments: list[tuple[float, float, float, float]]) -> list[tuple[float, ...]]:
        return [tuple(v + 3.0 for v in s) for s in segments]

    square = [
        (0.0, 0.0, 1.0, 0.0),
        (1.0, 0.0, 1.0, 2.0),
        (1.0, 2.0, 0.0, 2.0),
        (0.0, 2.0, 0.0, 0.0),
    ]
    room = [tuple(9.0 * v for v in s) for s in square]
    loops, lines = trace_loops([*square, *room, *shifted(square)[:3]])  # type: ignore[list-item]
    assert len(loops) == 1
    assert loops[0][:2] == (0.5, 1.0)
    assert loops[0].heading == pytest.approx(np.pi / 2)
    assert (loops[0].length, loops[0].width, loops[0].sides) == (2.0, 1.0, 4)
    assert len(lines) == 7
