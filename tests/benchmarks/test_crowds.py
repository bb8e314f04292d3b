from pathlib import Path

import crowds
import numpy as np
import pytest
from cases import few_walls
from common import options_of
from crowds import Job, draw, poses_by, poses_with, rows_of, table

import stillmap
from stillmap import em
from stillmap.pipeline import em_loop
from stillmap.sim import scene_by_name, simulate, write_simulation
from stillmap.sim.simulator import Simulation

_THREE = options_of("stillmap", ["em.max_iterations=3"])


@pytest.fixture(scope="module")
def crowd() -> Simulation:
    return simulate(scene_by_name("corridor", {"robot": {"scans": 60}}), 0)


def last_of(recording: stillmap.Recording) -> np.ndarray:
    *_, last = stillmap.iterate(recording, _THREE)
    return last.poses


def test_m_steps_are_those_of_the_loop_when_the_e_step_finds_nothing(
    crowd: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = crowd.recording
    found = em.e_step

    def same_as_ever(*args: object) -> em.EStepResult:
        once = found(*args)
        prior = em.initial_p_static(recording, "stillmap", _THREE.em)
        return em.EStepResult(prior, once.likelihood, once.occupied, once.learned)

    by_prior = poses_by("prior", recording, _THREE, None)
    weighted = poses_by("e", recording, _THREE, None)
    np.testing.assert_array_equal(weighted, last_of(recording))
    monkeypatch.setattr(em_loop.em, "e_step", same_as_ever)
    np.testing.assert_array_equal(by_prior, last_of(recording))
    assert not np.array_equal(by_prior, weighted)


def test_true_labels_are_told(crowd: Simulation) -> None:
    static = crowd.truth.static.astype(np.float32)
    told = poses_by("true labels", crowd.recording, _THREE, static)
    np.testing.assert_array_equal(told, poses_with(crowd.recording, _THREE, static))
    assert not np.array_equal(told, poses_by("prior", crowd.recording, _THREE, None))


def test_worlds_and_logs_have_rows_and_curves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = {"robot": {"scans": 40}}
    worlds = {"hall-8m": ("hall", lambda people: {**few_walls(people), **short})}
    monkeypatch.setattr(crowds, "WORLDS", worlds)
    what = (("e", "prior"), 2, ("slam.resolution=0.1",))
    rows = [row for people in (0, 30) for row in rows_of(Job("hall-8m", *what, people, 1))]
    assert [row["dynamic"] > 0 for row in rows] == [False, False, True, True]
    assert all(0 < row["translation"] < 0.2 for row in rows)
    changes = worlds["hall-8m"][1](5)
    write_simulation(simulate(scene_by_name("hall", changes), 0), tmp_path / "log")
    of_log = rows_of(Job("log", *what, log=tmp_path / "log"))
    assert 0 < of_log[0]["translation"] < 0.2
    lines = table([*rows, *of_log]).splitlines()[2:]
    assert [line.split("|")[2].strip() for line in lines] == ["0", "0", "30", "30", "-", "-"]
    draw(rows, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 10_000
