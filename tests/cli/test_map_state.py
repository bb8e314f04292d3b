"""`stillmap map --map-state`: the state of changed places."""

import json
import subprocess

import numpy as np
import pytest

from stillmap.cli.main import main
from stillmap.sim import (
    CrowdOptions,
    LaserOptions,
    RobotOptions,
    Scene,
    Stay,
    Thing,
    simulate,
    write_simulation,
)
from stillmap.sim.walls import box

CRATE = tuple(box(0, 0, 1.0, 0.8))


@pytest.fixture(scope="module")
def moved(tmp_path_factory):
    """A recording of 200 s in which a crate is brought at 120 s."""
    path = tmp_path_factory.mktemp("recording") / "moved"
    scene = Scene(
        "yard",
        walls=tuple(box(0, 0, 8, 6)),
        route=((-0.5, -1.5), (0.5, -1.5)),
        things=(Thing(CRATE, (Stay(1.0, 1.0, since=120.0),)),),
        crowd=CrowdOptions(people=1),
        laser=LaserOptions(beams=120, range_noise=0.01, fov=2 * np.pi),
        robot=RobotOptions(scans=200, scan_rate=1.0, speed=0.05),
    )
    write_simulation(simulate(scene, np.random.default_rng(1)), path)
    return path


@pytest.fixture
def mapped(moved, tmp_path, capsys):
    """Maps it at true poses; gives map, layer, and run.json."""

    def run(*words):
        out = tmp_path / "out"
        arguments = ["map", moved, "-o", out, "--overwrite", "--quiet", *words]
        arguments += ["--poses", moved / "truth/trajectory.tum"]
        assert main([str(word) for word in arguments]) == 0, capsys.readouterr().err
        told = json.loads((out / "run.json").read_text())
        with np.load(out / "map.npz") as arrays:
            return arrays["p_occupied"], arrays["changed"], told

    return run


def test_states_differ_at_the_crate(mapped):
    last, changed, told = mapped()
    assert told["options"]["output"]["map_state"] == "last"
    most, layer, told_of_most = mapped("--map-state", "majority")
    assert told_of_most["options"]["output"]["map_state"] == "majority"
    np.testing.assert_array_equal(changed, layer)
    assert told["changes"] == told_of_most["changes"]
    assert [one["kind"] for one in told["changes"]] == ["came"]
    came = changed == 1
    assert came.sum() > 10
    assert (last[came] > 0.65).mean() > 0.5
    assert (most[came] < 0.196).mean() > 0.8
    np.testing.assert_array_equal(np.isnan(last), np.isnan(most))


def test_flag_overrides_set(mapped):
    words = ("--map-state", "majority", "--set", "output.map_state=last", "--map-mode", "scale")
    chosen = mapped(*words)[2]["options"]["output"]
    assert (chosen["map_mode"], chosen["map_state"]) == ("scale", "majority")


@pytest.mark.parametrize("estimator", ["paper", "hit-ratio"])
def test_other_estimators_have_no_changes(mapped, estimator):
    words = ("--estimator", estimator, "--set", "em.max_iterations=1")
    p, changed, told = mapped(*words, "--map-state", "majority")
    same, *_ = mapped(*words)
    np.testing.assert_array_equal(p, same)
    assert told["changes"] == []
    assert not changed.any()


def test_change_detection_off(mapped):
    p, changed, told = mapped("--set", "em.change_detection=false")
    assert told["changes"] == []
    assert not changed.any()
    assert "changing" not in told["learned"]
    assert "changing" in mapped()[2]["learned"]
    assert np.isfinite(p).any()


def test_unknown_state_is_refused(stillmap, moved, tmp_path):
    done: subprocess.CompletedProcess[str]
    done = stillmap("map", moved, "-o", tmp_path / "out", "--map-state", "first")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "'last'" in done.stderr or "last" in done.stderr
    assert "--map-state" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("state", "shown"),
    [("last", "in its last state"), ("majority", "in the state that it was in for longest")],
)
def test_number_of_changed_places_is_printed(moved, tmp_path, capsys, state, shown):
    words = ["map", moved, "-o", tmp_path / "out", "--map-state", state]
    words += ["--poses", moved / "truth/trajectory.tum"]
    assert main([str(word) for word in words]) == 0
    n = len(json.loads((tmp_path / "out/run.json").read_text())["changes"])
    assert n >= 1
    places = "1 place changed, the map shows it" if n == 1 else f"{n} places changed"
    said = capsys.readouterr().err
    assert places in said
    assert shown in said
