"""`stillmap map --map-state`: the state of changed places."""

import json

import numpy as np
import pytest

from stillmap.cli.main import main
from stillmap.sim import Scene, simulate, write_simulation
from stillmap.sim.options import CrowdOptions, LaserOptions, RobotOptions
from stillmap.sim.scene import Stay, Thing
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
