"""A map that is extended: what was moved between two runs is shown where it stands now."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from live_runs import push_all

import stillmap
from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.results.reader import Grid
from stillmap.sim import scene_by_name, simulate

SCANS, RADIUS = 160, 0.45
SEEN_WELL = 112  # scan, of the table where it stands now
BEFORE, NOW = (15.5, 4.8), (11.5, 1.2)  # m, of a round table beside the way of the robot


def add_table(simulation, at):
    """The recording with a round table at a place of the world."""
    recording = simulation.recording
    points = recording.points.copy()
    for t, beams in enumerate(iter_beams(recording)):
        T = simulation.truth.T_world_base[t] @ beams.T_base_sensor
        centre = (se2.inverse(T) @ np.array([*at, 1.0]))[:2]
        length = np.linalg.norm(beams.points, axis=1)
        along = (beams.points / length[:, None]) @ centre
        off2 = centre @ centre - along**2
        reach = along - np.sqrt(np.maximum(RADIUS**2 - off2, 0.0))
        nearer = (along > 0.0) & (off2 < RADIUS**2) & (reach < length)
        points[recording.beams_of(t)][nearer] *= (reach / length)[nearer, None].astype(np.float32)
    return replace(recording, points=points)


def share_occupied(grid, T, at):
    """Share of the rim of a table at a place of the world that the map shows as occupied."""
    grid = Grid(grid.p_occupied, grid.origin, grid.resolution)
    angles = np.arange(64) * (2.0 * np.pi / 64)
    rim = np.array(at) + RADIUS * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    around = (rim @ T[:2, :2].T + T[:2, 2])[:, None] + 0.03 * np.array([[0, 0], [1, 0], [-1, 0]])
    row, column = grid.cells(around.reshape(-1, 2)).T
    return float((grid.p_occupied[row, column] > 0.65).reshape(64, 3).any(axis=1).mean())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Maps by mode, after a run on which the table had been moved: of the mapper, and as saved."""
    folder = tmp_path_factory.mktemp("extension")
    changes = {"crowd": {"people": 0}, "robot": {"scans": SCANS}}
    simulations = [simulate(scene_by_name("hall", changes), seed) for seed in (1, 2)]
    options = {"threads": 1, "em.max_iterations": 1}
    stillmap.build(add_table(simulations[0], BEFORE), options).save(folder / "known")
    recording, maps = add_table(simulations[1], NOW), {}
    for mode in ("localise", "extend"):
        with LiveMapper({"threads": 1}, place=folder / "known", mode=mode) as mapper:
            assert "lost" not in push_all(mapper, recording)[-1].doubts
            mapper.save(folder / mode)
            maps[mode] = mapper.map, stillmap.load(folder / mode).map
    maps["known"] = stillmap.load(folder / "known").map
    return maps, se2.inverse(simulations[0].truth.T_world_base[0]), folder, recording


def test_the_extended_map_shows_what_is_there_now_and_what_was_not_seen_again(run):
    maps, T, *_ = run
    assert share_occupied(maps["known"], T, BEFORE) > 0.3
    assert share_occupied(maps["known"], T, NOW) == 0.0
    live, saved = maps["extend"]
    assert share_occupied(live, T, BEFORE) < 0.05
    assert share_occupied(saved, T, BEFORE) < 0.05
    assert share_occupied(saved, T, NOW) > 0.3
    known, own, extended = (
        np.count_nonzero(grid.p_occupied > 0.65)
        for grid in (maps["known"], maps["localise"][1], saved)
    )
    assert own < extended
    assert extended > 0.95 * known


def test_the_map_shows_it_while_mapping_once_it_has_stood_for_minutes(run):
    """The robot drives up to it and waits."""
    _, T, folder, recording = run
    with LiveMapper({"threads": 1}, place=folder / "known", mode="extend") as mapper:
        for t, beams in enumerate(islice(iter_beams(recording), SEEN_WELL)):
            mapper.push(beams, recording.T_odom_base[t])
        at_once = mapper.map
        for k in range(360):
            stamp_ns = beams.stamp_ns + 500_000_000 * (k + 1)
            mapper.push(replace(beams, stamp_ns=stamp_ns), recording.T_odom_base[t])
        later = mapper.map
    assert share_occupied(at_once, T, NOW) < 0.1
    assert share_occupied(later, T, NOW) > 0.3


def test_the_cells_are_those_of_the_map_that_is_extended(tmp_path):
    simulation = simulate(scene_by_name("hall", {"robot": {"scans": 20}}), 1)
    options = {"threads": 1, "em.max_iterations": 1, "slam.resolution": 0.1}
    stillmap.build(simulation.recording, options).save(tmp_path / "known")
    with LiveMapper({"threads": 1}, place=tmp_path / "known", mode="extend") as mapper:
        assert mapper.resolution == 0.1
    with pytest.raises(InputError, match=r"0\.1 m"):
        LiveMapper({"slam.resolution": 0.2}, place=tmp_path / "known", mode="extend")
