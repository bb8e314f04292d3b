"""Self filter of 3D recordings."""

from dataclasses import replace

import numpy as np
import pytest
from marks import slow_params

from stillmap.prepare import self_filter
from stillmap.sim import scene_by_name, simulate

pytestmark = pytest.mark.slow

CAR = {"sees_robot": True, "roof_length": 4.0, "roof_width": 1.7}
LOW = {"z": 0.7, "low": -0.6, "high": 0.3}  # the lidar of a small robot
SMALL = {**LOW, "sees_robot": True, "roof_length": 0.6, "roof_width": 0.5, "roof_below": 0.2}


def run(world, scans, seed=0, speed=None, **lidar):
    robot = {"scans": scans} if speed is None else {"scans": scans, "speed": speed}
    options = {"channels": 32, "columns": 200, **lidar}
    return simulate(scene_by_name(world, {"lidar": options, "robot": robot}), seed)


@pytest.fixture(scope="module")
def drive():
    """A car that sees its own roof."""
    return run("street", 90, **CAR)


def gone(recording):
    """Hits that are left out."""
    out = self_filter.remove_self_returns(recording)
    lost = recording.hit & ~out.hit
    assert np.isnan(out.points[lost]).all()
    np.testing.assert_array_equal(out.points[~lost], recording.points[~lost])
    return lost


@pytest.mark.slow
def test_a_car_that_sees_its_roof(drive):
    own = (drive.truth.mover == -2) & drive.recording.hit
    assert own.mean() > 0.2
    np.testing.assert_array_equal(gone(drive.recording), own)


def test_the_order_of_beams_means_nothing(drive):
    """Clouds need not have the same beams, nor any order."""
    rng = np.random.default_rng(5)
    r = drive.recording
    scans = [rng.permutation(np.r_[r.beams_of(t)]) for t in range(r.n_scans)]
    kept = [scan[: rng.integers(4000, 6000)] for scan in scans]
    order = np.concatenate(kept)
    offset = np.concatenate([[0], np.cumsum([len(k) for k in kept])]).astype(np.int64)
    mixed = replace(r, points=r.points[order], hit=r.hit[order], offset=offset, beam_time=None)
    own = ((drive.truth.mover == -2) & r.hit)[order]
    found = gone(mixed)
    assert not (found & ~own).any()
    assert found[own].mean() > 0.99


@pytest.mark.parametrize("world", ["hall", *slow_params("corridor")])
def test_a_small_robot_indoors(world):
    sim = run(world, 300, **SMALL)
    own, lost = sim.truth.mover == -2, gone(sim.recording)
    assert lost[own & sim.recording.hit].mean() > 0.99
    assert np.count_nonzero(lost & ~own) < 1e-3 * own.sum()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "scans", "lidar"),
    [
        ("street", 90, {}),
        ("hall", 300, LOW),
        *slow_params(*((name, 300, {"channels": 16}) for name in ("corridor", "office"))),
        *slow_params(("street-jam", 90, {"channels": 16})),
    ],
)
def test_where_nothing_of_the_robot_shows_nothing_is_lost(world, scans, lidar):
    """Level ground, ceilings and the walls of a corridor come back from one place, too."""
    recording = run(world, scans, **lidar).recording
    assert self_filter.remove_self_returns(recording) is recording


@pytest.mark.slow
@pytest.mark.parametrize("world", ["street-jam", "hall"])
def test_a_robot_that_stands_loses_nothing(world):
    """What stands near it could be a part of it."""
    recording = run(world, 60, speed=1e-3, **CAR).recording
    assert self_filter.remove_self_returns(recording) is recording


def test_a_fan_of_beams_is_no_sweep(drive):
    """A laser that tilts looks elsewhere in every scan."""
    r = drive.recording
    points = np.array(r.points)
    points[:, 2] = 0.02 * points[:, 0]
    flat = replace(r, points=points)
    assert self_filter.remove_self_returns(flat) is flat
