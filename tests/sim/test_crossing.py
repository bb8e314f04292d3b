"""The streets with lights: who stops where, crowns above the road, nothing behind the park."""

import numpy as np
import pytest

from stillmap.sim import scene_by_name
from stillmap.sim.geometry import BOX, CYLINDER, ELLIPSOID, Ground
from stillmap.sim.world_3d import make_static_world, trace_loops

INNER, OUTER = 1.75, 5.25  # m, from the middle of the road to the middles of the lanes


def test_crowns_reach_above_the_road_and_over_who_passes() -> None:
    scene = scene_by_name("crossing")
    ground = Ground(np.zeros(2), np.reshape(scene.pavements, (-1, 4)), scene.ground.kerb)
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
