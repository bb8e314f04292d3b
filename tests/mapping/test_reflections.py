"""Beams that a mirror reflected are found; rooms that merely look alike are not mirrors."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from marks import slow_params
from numpy.typing import NDArray

import stillmap
from stillmap.core.config import override
from stillmap.mapping.mirrors import Mirror
from stillmap.mapping.reflections import find_mirrors, remove_reflections
from stillmap.sim import Scene, Simulation, scene_by_name, simulate
from stillmap.sim.planar import MIRRORED
from stillmap.sim.walls import box

CELL = 0.05


def drive(name: str, seed: int, **changes: dict[str, object]) -> Simulation:
    usual: dict[str, dict[str, object]] = {"robot": {"scans": 600, "speed": 0.8}}
    sections = {**usual, **{k: {**usual.get(k, {}), **v} for k, v in changes.items()}}
    return simulate(scene_by_name(name, sections), seed)


def labels(run: Simulation) -> NDArray[np.float32]:
    """As of an E-step: what mirrors show stands still, people do not."""
    mover = run.truth.mover
    return np.where((mover == -1) | (mover == MIRRORED), 0.97, 0.02).astype(np.float32)


def reflected(run: Simulation) -> NDArray[np.bool_]:
    _, found = remove_reflections(run.recording, run.truth.T_world_base, labels(run), CELL)
    return np.zeros(run.recording.n_beams, np.bool_) if found is None else found


@cache
def gallery() -> Simulation:
    return drive("gallery", 0, laser={"beams": 361})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "changes"),
    [
        (0, {"laser": {"beams": 361}}),
        (1, {"laser": {"fov": 6.28, "beams": 540, "max_range": 15.0}}),
        (2, {"laser": {"beams": 361, "mirror_return_share": 0.0}, "crowd": {"people": 0}}),
        *slow_params(*((seed, {"laser": {"beams": 361}}) for seed in range(3, 7))),
    ],
)
def test_most_reflections_are_found_and_nothing_else(
    seed: int, changes: dict[str, dict[str, object]]
) -> None:
    run = gallery() if seed == 0 else drive("gallery", seed, **changes)
    found, mirrored = reflected(run), run.truth.mover == MIRRORED
    assert mirrored.mean() > 0.03
    assert found[mirrored].mean() > 0.8
    assert mirrored[found & run.recording.hit].mean() > 0.96


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["hall", "office", "corridor", "warehouse", "ten-corridors", "street", "rounds"]
)
@pytest.mark.parametrize("fov", [3.1416, *slow_params(6.283)])
def test_places_without_mirrors_have_none(name: str, fov: float) -> None:
    assert not reflected(drive(name, 1, laser={"beams": 270, "fov": fov})).any()


def twin_rooms(**changes: dict[str, object]) -> Simulation:
    """Two rooms, one the other's mirror image about x = 0, and a wide doorway between them."""
    half = [
        *box(4.0, 3.0, 1.2, 0.8, 0.4),
        *box(2.5, -2.6, 0.6, 1.4, -0.2),
        *box(5.5, -1.0, 0.5, 0.5),
    ]
    other = [(-x0, y0, -x1, y1) for x0, y0, x1, y1 in half]
    wall = [(0.0, -5.0, 0.0, -1.5), (0.0, 1.5, 0.0, 5.0)]
    walls = (*box(0, 0, 14, 10), *half, *other, *wall)
    route = ((1.0, 3.5), (1.2, 0.0), (4.0, 0.5), (1.5, -4.0), (6.0, -3.5), (6.0, 3.8))
    scene = Scene(name="twins", walls=walls, route=route)
    usual = {"crowd": {"people": 0}, "robot": {"scans": 400, "speed": 0.8}, "laser": {"beams": 361}}
    return simulate(override(scene, {**usual, **changes}), 2)


def test_a_doorway_that_the_robot_drives_through_is_no_mirror() -> None:
    run = twin_rooms()
    through = dataclasses.replace(run.scene, route=(*run.scene.route, (-4.0, 0.5), (-1.0, 3.5)))
    assert not reflected(simulate(through, 2)).any()
    # whoever sees a doorway from one side only cannot know
    assert reflected(run).any()


def test_mirrors_are_where_they_are() -> None:
    run = gallery()
    mirrors = find_mirrors(run.recording, run.truth.T_world_base, labels(run), CELL)
    true = np.array(run.scene.mirrors)
    assert len(mirrors) >= 3
    for mirror in mirrors:
        ends = true.reshape(-1, 2, 2) @ mirror.normal - mirror.distance
        assert np.abs(ends).max(axis=1).min() < 0.06


def test_a_crossing_beam_comes_from_the_front_and_ends_behind() -> None:
    mirror = Mirror(np.array([0.0, 1.0]), 2.0, -3.0, -1.0)  # y = 2, x from 1 to 3
    origins = np.array([[2.0, 5.0], [2.0, 5.0], [2.0, 5.0], [2.0, -1.0], [0.0, 5.0]])
    ends = np.array([[2.0, -1.0], [2.0, 1.95], [8.0, -1.0], [2.0, 5.0], [0.0, -1.0]])
    crossing = mirror.find_crossing(origins, ends)
    np.testing.assert_array_equal(crossing, [True, False, False, False, False])


def test_removed_beams_are_unusable() -> None:
    run = gallery()
    left, found = remove_reflections(run.recording, run.truth.T_world_base, labels(run), CELL)
    assert found is not None
    assert np.isnan(left.points[found]).all()
    assert not left.hit[found].any()
    np.testing.assert_array_equal(left.points[~found], run.recording.points[~found])
    assert np.isfinite(run.recording.points).all()


def test_few_or_no_beams_have_no_mirrors() -> None:
    run = drive("hall", 0, robot={"scans": 3}, laser={"beams": 5})
    assert not reflected(run).any()
    recording = dataclasses.replace(
        run.recording, hit=np.zeros(15, np.bool_), points=np.full((15, 2), np.nan, np.float32)
    )
    T = run.truth.T_world_base
    assert remove_reflections(recording, T, labels(run), CELL) == (recording, None)


@pytest.mark.slow
def test_a_map_of_a_gallery_has_few_rooms_behind_its_mirrors() -> None:
    run = gallery()
    result = stillmap.build(run.recording, poses=run.truth.T_world_base)
    mirrored = (run.truth.mover == MIRRORED) & run.recording.hit
    assert (result.p_static[mirrored] < 0.5).mean() > 0.7  # without recognition .1
    static = run.truth.static
    assert (result.p_static[static] > 0.5).mean() > 0.97
    assert np.isfinite(result.p_static[run.recording.hit]).all()
