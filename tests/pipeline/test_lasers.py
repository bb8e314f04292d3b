"""Where lasers sit: a log of the same world must give poses as good, however they are mounted."""

import functools
import math

import numpy as np
import pytest

import stillmap
from stillmap.core import se2
from stillmap.io import read
from stillmap.prepare.options import ReadOptions
from stillmap.sim import scene_by_name, simulate

TURNED = math.radians(20.0)
FRONT = {"x": 0.25, "y": -0.15, "yaw": TURNED}
REAR = {"x": -0.2, "yaw": math.pi}
FRONT_PARAMS = (
    "robot_frontlaser_offset 0.25",
    "robot_frontlaser_side_offset -0.15",
    f"robot_frontlaser_angular_offset {TURNED}",
)
FRONT_OPTIONS = {"laser_x": 0.25, "laser_y": -0.15, "laser_theta": TURNED}
REAR_PARAM = "robot_rearlaser_offset -0.2"
NO_RETURN = 81.83


@functools.cache
def hall(mounted):
    """The first 12 m of a populated hall; the same way and people wherever the laser sits."""
    # an odd number of beams: mirrored they point the same ways
    laser = {"beams": 181, "x": 0.0, "y": 0.0, "yaw": 0.0, **dict(mounted)}
    return simulate(scene_by_name("hall", {"laser": laser, "robot": {"scans": 120}}), 0)


def seen(**mounted):
    return hall(tuple(mounted.items()))


def reading_line(kind, simulation, scan, flipped):
    """One laser line; a flipped laser lists its beams the other way round."""
    r = simulation.recording
    beams = r.beams_of(scan)
    ranges = np.where(r.hit[beams], np.hypot(*r.points[beams].astype(float).T), NO_RETURN)
    readings = " ".join(f"{z:.2f}" for z in (ranges[::-1] if flipped else ranges))
    stamp = r.stamp_ns[scan] / 1e9
    pose = " ".join(f"{v:.6f}" for v in se2.parameters(r.T_odom_base[scan]))
    odom = f"ODOM {pose} 0 0 0 {stamp:.6f} h 0"
    if kind in ("FLASER", "RLASER"):  # old logs: the robot's pose in both places
        return f"{kind} {len(ranges)} {readings} {pose} {pose} {stamp:.6f} h 0"
    fov = simulation.scene.laser.fov
    header = f"0 {-fov / 2} {fov} {fov / (len(ranges) - 1)} {NO_RETURN} 0.01 0"
    return f"{odom}\n{kind} {header} {len(ranges)} {readings} 0 {stamp:.6f} h 0"


@pytest.fixture
def mapped(tmp_path):
    """Absolute trajectory error of what `build` makes of a log, lasers apart, in metres."""

    def run(lasers, params=(), flipped=(), **options):
        simulations = list(lasers.values())
        lines = [f"PARAM {param}" for param in params]
        for scan in range(simulations[0].recording.n_scans):
            lines += [
                reading_line(kind, one, scan, kind in flipped) for kind, one in lasers.items()
            ]
        path = tmp_path / "some.log"
        path.write_text("".join(f"{line}\n" for line in lines))
        recording = read(path, ReadOptions(**options))
        assert len(recording.T_base_sensor) == len(lasers)
        poses = stillmap.build(recording, stillmap.Options(threads=1)).poses
        truth = simulations[0].truth.T_world_base
        return max(ate(poses[recording.sensor == k], truth) for k in range(len(lasers)))

    return run


def ate(poses, truth):
    """RMS of the distances after the best rigid alignment (complex numbers: a turn is a factor)."""
    a, b = (np.array(T[:, 0, 2] + 1j * T[:, 1, 2]) for T in (poses, truth))
    a, b = a - a.mean(), b - b.mean()
    turn = np.vdot(a, b)
    return float(np.sqrt(np.mean(np.abs(a * turn / abs(turn) - b) ** 2)))


@pytest.fixture(scope="module")
def good():
    """What poses are good: those of a laser in the robot's centre, or a fifth of a cell."""
    centred = seen()
    found = stillmap.build(centred.recording, stillmap.Options(threads=1))
    return max(1.5 * ate(found.poses, centred.truth.T_world_base), 0.01)


@pytest.mark.slow
def test_off_centre_by_params(mapped, good):
    assert mapped({"FLASER": seen(**FRONT)}, FRONT_PARAMS) < good


def test_off_centre_by_options(mapped, good):
    assert mapped({"FLASER": seen(**FRONT)}, **FRONT_OPTIONS) < good


def test_it_matters_where_it_sits(mapped, good):
    wrong = dict.fromkeys(FRONT_OPTIONS, 0.0)
    assert mapped({"FLASER": seen(**FRONT)}, **wrong) > 2 * good


def test_untold_it_is_found(mapped, good):
    assert mapped({"FLASER": seen(**FRONT)}) < good


@pytest.mark.slow
def test_backwards(mapped, good):
    assert mapped({"RLASER": seen(**REAR)}, [REAR_PARAM]) < good


def test_upside_down_by_option(mapped, good):
    assert mapped({"FLASER": seen()}, flipped=["FLASER"], laser_upside_down=True) < good


@pytest.mark.slow
def test_upside_down_and_off_centre_by_params(mapped, good):
    params = [*FRONT_PARAMS, "robot_frontlaser_flipped 1"]
    assert mapped({"FLASER": seen(**FRONT)}, params, ["FLASER"]) < good


@pytest.mark.slow
def test_upside_down_said_wrongly(mapped, good):
    wrong = {"flipped": ["FLASER"], "laser_upside_down": False}
    assert mapped({"FLASER": seen()}, **wrong) > 10 * good


@pytest.mark.slow
def test_upside_down_and_nobody_says_so(mapped, good):
    assert mapped({"FLASER": seen()}, flipped=["FLASER"]) < good


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "beams"), [(90, 91), (270, 271), (360, 361)])
def test_fields_of_view(mapped, good, degrees, beams):
    laser = seen(fov=math.radians(degrees), beams=beams)
    assert mapped({"RAWLASER1": laser}) < good


def test_a_field_of_view_that_lines_do_not_state(mapped, good):
    fov = math.radians(270)
    assert mapped({"FLASER": seen(fov=fov, beams=271)}, laser_fov=fov) < good


def test_front_and_rear_the_rear_one_upside_down(mapped, good):
    lasers = {"FLASER": seen(**FRONT), "RLASER": seen(**REAR)}
    params = [*FRONT_PARAMS, REAR_PARAM, "robot_rearlaser_flipped 1"]
    assert mapped(lasers, params, ["RLASER"]) < good


@pytest.mark.slow
def test_two_raw_lasers_told_by_options(mapped, good):
    lasers = {"RAWLASER1": seen(**FRONT), "RAWLASER3": seen(**REAR)}
    rear = {"laser2_x": -0.2, "laser2_theta": math.pi}
    assert mapped(lasers, **FRONT_OPTIONS, **rear) < good
