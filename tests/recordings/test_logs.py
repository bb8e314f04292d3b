"""Real logs with references: does the method work where nobody has made the world for it?"""

import numpy as np
import pytest

import stillmap
from stillmap import se2
from stillmap.evaluation.files import read_odometry, read_relations, seconds
from stillmap.evaluation.relations import relation_errors
from stillmap.options import replaced
from stillmap.pipeline import Options

slow = pytest.mark.slow
# Mean errors in metres and degrees. Generous: the references of all but intel come from another
# program's run.
LOGS = {
    "intel": (0.075, 2.0),
    "aces": (0.3, None),
    "belgioioso": (0.1, None),
    "edmonton": (0.1, None),
    "fr101": (0.1, None),
    "seattle": (0.15, None),
}
QUICK = {"belgioioso", "seattle"}  # the others only in `make check`


def mapped(folder, name, iterations=1):
    recording = stillmap.read(folder / f"{name}.clf.gz")
    options = replaced(Options(), {"em": {"max_iterations": iterations}})
    return stillmap.build(recording, options)


def errors(folder, name, result):
    (relations,) = [
        path
        for path in (folder / f"{name}.relations", folder / f"{name}.pseudo.relations")
        if path.exists()
    ]
    times = seconds(result.recording.stamp_ns)
    trajectory = np.column_stack([times, se2.parameters(result.poses)])
    odometry = read_odometry(folder / f"{name}.clf.gz")
    return relation_errors(trajectory, read_relations(relations), odometry)


@pytest.fixture(scope="module")
def laser2d(shared_data):
    folder = shared_data / "laser2d"
    if not folder.is_dir():
        pytest.skip("no logs in ../shared/data/laser2d")
    return folder


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else slow) for name in LOGS]
)
def test_a_log_is_mapped(laser2d, name):
    metres, degrees = LOGS[name]
    result = mapped(laser2d, name)
    recording = result.recording
    assert np.isfinite(result.poses).all()
    usable = np.isfinite(recording.points).all(axis=1)
    assert np.isfinite(result.p_static[usable]).all()
    assert 0.5 < result.p_static[recording.hit].mean() < 0.999
    found = errors(laser2d, name, result)
    assert found.used == found.relations > 100
    assert found.translation.mean < metres
    if degrees is not None:
        assert found.rotation.mean < degrees


def test_a_second_iteration_finds_movers_and_keeps_the_place(laser2d):
    # edmonton: a convention centre full of people
    result = mapped(laser2d, "edmonton", iterations=2)
    assert errors(laser2d, "edmonton", result).translation.mean < 0.1
    hit = result.recording.hit
    dynamic = (result.p_static[hit] < 0.5).mean()
    assert 0.003 < dynamic < 0.3
    assert (result.map.p_occupied > 0.3).sum() < 0.99 * (result.raw_map.p_occupied > 0.3).sum()
