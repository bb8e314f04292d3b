"""Real logs with references: does the method work where nobody has made the world for it?"""

import subprocess
import sys

import numpy as np
import pytest

import stillmap
from stillmap.core import se2
from stillmap.core.config import override
from stillmap.pipeline.options import Options
from stillmap.results.eval.readers import read_odometry, read_relations, to_seconds
from stillmap.results.eval.trajectory import compute_relation_errors

pytestmark = pytest.mark.slow

slow = pytest.mark.slow
# Mean errors in metres and degrees. Generous: the references of all but intel come from another
# program's run.
LOGS = {
    "intel": (0.075, 2.0),
    "aces": (0.3, None),
    "belgioioso": (0.1, None),
    "edmonton": (0.1, None),
    "fhw": (0.1, None),  # pauses of 34 to 230 s without scans
    "fr101": (0.1, None),
    "seattle": (0.15, None),
}
QUICK = {"belgioioso", "seattle"}  # the others only in `make check`


def mapped(folder, name, iterations=1, estimator="stillmap"):
    recording = stillmap.read(folder / f"{name}.clf.gz")
    chosen = {"estimator": estimator, "em": {"max_iterations": iterations}}
    return stillmap.build(recording, override(Options(), chosen))


def errors(folder, name, result):
    (relations,) = [
        path
        for path in (folder / f"{name}.relations", folder / f"{name}.pseudo.relations")
        if path.exists()
    ]
    times = to_seconds(result.recording.stamp_ns)
    trajectory = np.column_stack([times, se2.parameters(result.poses)])
    odometry = read_odometry(folder / f"{name}.clf.gz")
    return compute_relation_errors(trajectory, read_relations(relations), odometry)


@pytest.fixture(scope="module")
def laser2d(shared_data):
    folder = shared_data / "laser2d"
    if not folder.is_dir():
        pytest.skip("no logs in ../shared/data/laser2d")
    return folder


# runs a command and prints its peak memory in kilobytes
_PRINT_PEAK = """
import resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""


@slow
@pytest.mark.skipif(sys.platform != "linux", reason="glibc and kilobytes are assumed")
@pytest.mark.parametrize("threads", [1, 16])
def test_a_small_job_takes_little_memory(laser2d, tmp_path, threads):
    """61 200 beams; a map of 135 m, mostly empty, with as many threads as a large machine has."""
    words = ["map", laser2d / "edmonton.clf.gz", "-o", tmp_path / "out", "--quiet"]
    command = [sys.executable, "-m", "stillmap", *map(str, words), "--threads", str(threads)]
    # a process starts with the peak of the one that started it: that of the tests is large
    done = subprocess.run(
        [sys.executable, "-c", _PRINT_PEAK, *command], stdout=subprocess.PIPE, text=True, check=True
    )
    assert 100_000 < int(done.stdout) < 300_000  # kilobytes


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


# edmonton: a convention centre full of people
@pytest.fixture
def crowded(laser2d):
    def two_iterations(estimator):
        result = mapped(laser2d, "edmonton", iterations=2, estimator=estimator)
        assert errors(laser2d, "edmonton", result).translation.mean < 0.08
        return result, result.p_static[result.recording.hit]

    return two_iterations


def test_the_printed_method_finds_movers_and_keeps_the_place(crowded):
    result, e = crowded("paper")
    assert 0.003 < (e < 0.5).mean() < 0.3
    ours, raw = ((m.p_occupied > 0.3).sum() for m in (result.map, result.raw_map))
    assert ours < 0.99 * raw


@slow
def test_it_finds_movers_where_poses_are_loose_and_keeps_walls(crowded):
    # end points scatter by most of a cell: what stands beside anything is believed to stand too
    result, e = crowded("stillmap")
    assert 0.03 < result.learned["scatter"] < 0.06
    assert 0.001 < (e < 0.5).mean() < 0.03
    assert (e < 0.1).sum() > 10
    assert 0.9 < result.learned["p_static"] < 0.997
    # cells in which only movers were seen are free, and walls are there
    ours, raw = result.map, result.raw_map
    offset = np.subtract(ours.origin[:2], raw.origin[:2]) / ours.resolution
    column, row = np.round(offset).astype(int)  # of the map within the raw one
    height, width = ours.alpha.shape
    alpha = raw.alpha[row : row + height, column : column + width]
    gone = (alpha >= 1) & (ours.alpha < 0.2 * alpha)
    walls = (alpha >= 5) & (ours.alpha > 0.9 * alpha)
    assert gone.sum() > 20
    assert (ours.p_occupied[gone] < 0.3).mean() > 0.95
    assert walls.sum() > 1000
    assert (ours.p_occupied[walls] > 0.5).mean() > 0.85
