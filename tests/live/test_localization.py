"""Localization in a known map: from anywhere, in a crowd, after being carried, in doubt."""

from dataclasses import replace

import numpy as np
import pytest

import stillmap
from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.live.known_map import KnownMap
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.sim import scene_by_name, simulate


class Place:
    """A map of a world without people, and runs through it."""

    def __init__(self, world, seed, folder):
        changes = {"crowd": {"people": 0}, "robot": {"scan_rate": 2.5}}
        simulation = simulate(scene_by_name(world, changes), seed)
        self.folder, self._world = folder, world
        self._T_map_world = se2.inverse(simulation.truth.T_world_base[0])
        poses = self._T_map_world @ simulation.truth.T_world_base
        stillmap.build(simulation.recording, {"threads": 1}, poses=poses).save(folder)

    def simulate(self, seed, **changes):
        return simulate(scene_by_name(self._world, changes), seed)

    def error(self, update, simulation, scan):
        """m and rad of a pose."""
        true = self._T_map_world @ simulation.truth.T_world_base[scan]
        x, y, theta = se2.parameters(se2.inverse(true) @ update.pose)
        return np.hypot(x, y), abs(theta)


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    return Place("hall", 1, tmp_path_factory.mktemp("place") / "hall")


def run(place, simulation, scans, **settings):
    """Scan, update and mapper of some scans."""
    odometry = simulation.recording.T_odom_base
    with LiveMapper({"threads": 1}, place=place.folder, **settings) as mapper:
        for k, beams in enumerate(iter_beams(simulation.recording)):
            if k in scans:
                yield k, mapper.push(beams, odometry[k]), mapper


@pytest.mark.parametrize(
    "first", [900, *(pytest.param(k, marks=pytest.mark.slow) for k in (100, 1700))]
)
def test_the_robot_is_found_anywhere(hall, first):
    simulation = hall.simulate(201, crowd={"people": 10}, robot={"scans": first + 40})
    answers = run(hall, simulation, range(first, first + 40))
    k, update, _ = next(answers)
    while "lost" in update.doubts:
        k, update, _ = next(answers)
    metres, radians = hall.error(update, simulation, k)
    assert metres < 0.1
    assert radians < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("first", [291, 384])
def test_a_robot_that_is_elsewhere_is_not_found(hall, first):
    """Half of an office fits into a hall somewhere, but not what comes into view after that."""
    simulation = simulate(scene_by_name("office"), 3)
    for _, update, _ in run(hall, simulation, range(first, first + 14)):
        assert "lost" in update.doubts


def test_a_robot_that_is_carried_is_found_again(hall):
    robot = {"scans": 220, "carried_at": 0.4, "carried_time": 5.0}
    simulation = hall.simulate(203, crowd={"people": 5}, robot=robot)
    answers = []
    for k, update, mapper in run(hall, simulation, range(220)):
        answers.append((k, update, mapper))
        poses = mapper.poses if k == 219 else None
    off = [
        hall.error(replace(one, pose=T), simulation, k)[0]
        for (k, one, _), T in zip(answers, poses, strict=True)
    ]
    assert np.mean(np.array(off) > 0.5) < 0.05  # in hindsight those until it was noticed, too
    doubts = [update.doubts for _, update, _ in answers]
    assert not any("carried" in doubt for doubt in doubts[:80])
    assert any("carried" in doubt for doubt in doubts[80:140])
    assert "lost" not in doubts[-1]
    k, update, _ = answers[-1]
    assert hall.error(update, simulation, k)[0] < 0.1
    wrong = [k for k, one, _ in answers if "lost" not in one.doubts]
    off = [hall.error(answers[k][1], simulation, k)[0] > 0.5 for k in wrong]
    assert np.mean(off) < 0.15  # until the scans contradict the map for sure


@pytest.mark.slow
def test_where_places_look_alike_it_says_so(tmp_path):
    place = Place("corridor", 1, tmp_path / "corridor")
    simulation = place.simulate(205, crowd={"people": 0})
    doubts, wrong = set(), 0
    for k, update, _ in run(place, simulation, range(600, 625)):
        doubts |= set(update.doubts)
        wrong += "lost" not in update.doubts and place.error(update, simulation, k)[0] > 0.5
    assert "ambiguous" in doubts
    assert not wrong


def test_folders_without_a_map_are_refused(tmp_path):
    with pytest.raises(InputError, match="nothing"):
        LiveMapper(place=tmp_path / "nothing")


@pytest.mark.parametrize(
    ("alpha", "y"), [({9: 8.0}, 0.475), ({9: 4.0, 10: 4.0}, 0.5), ({9: 6.0, 10: 2.0}, 0.4875)]
)
def test_a_surface_runs_where_most_hits_are(tmp_path, alpha, y):
    """Of a wall along x in two rows of cells, hit so often each."""
    p_occupied = np.zeros((20, 60), np.float32)
    hits = np.zeros_like(p_occupied)
    for row, count in alpha.items():
        p_occupied[row, 10:50], hits[row, 10:50] = 0.9, count
    cells = {"origin": np.zeros(3), "resolution": 0.05}
    np.savez(tmp_path / "map.npz", p_occupied=p_occupied, alpha=hits, **cells)
    known = KnownMap(tmp_path)
    inner = (known.surfaces[:, 0] > 0.6) & (known.surfaces[:, 0] < 2.4)
    np.testing.assert_allclose(known.surfaces[inner, 1], y, atol=1e-6)
