"""Where lasers sit: a log of the same world must give poses as good, however they are mounted."""

import functools
import math

import numpy as np
import pytest
from marks import slow_params

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
            for kind, one in lasers.items():
                lines.append(reading_line(kind, one, scan, kind in flipped))
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


def test_it_matters_where_it_sits(mapped, good):
    wrong = dict.fromkeys(FRONT_OPTIONS, 0.0)
    assert mapped({"FLASER": seen(**FRONT)}, **wrong) > 2 * good


@pytest.mark.slow
def test_upside_down_said_wrongly(mapped, good):
    wrong = {"flipped": ["FLASER"], "laser_upside_down": False}
    assert mapped({"FLASER": seen()}, **wrong) > 10 * good


REAR_OPTIONS = {"laser2_x": -0.2, "laser2_theta": math.pi}
BOTH_PARAMS = [*FRONT_PARAMS, REAR_PARAM, "robot_rearlaser_flipped 1"]
WIDE = {"fov": math.radians(270), "beams": 271}


@pytest.mark.parametrize(
    ("lasers", "params", "flipped", "options"),
    [
        ({"FLASER": FRONT}, (), (), FRONT_OPTIONS),
        ({"FLASER": FRONT}, (), (), {}),  # found
        ({"FLASER": {}}, (), ["FLASER"], {"laser_upside_down": True}),
        ({"FLASER": WIDE}, (), (), {"laser_fov": WIDE["fov"]}),  # lines do not state it
        ({"FLASER": FRONT, "RLASER": REAR}, BOTH_PARAMS, ["RLASER"], {}),
        *slow_params(
            ({"FLASER": FRONT}, FRONT_PARAMS, (), {}),
            ({"RLASER": REAR}, [REAR_PARAM], (), {}),
            ({"FLASER": FRONT}, [*FRONT_PARAMS, "robot_frontlaser_flipped 1"], ["FLASER"], {}),
            ({"FLASER": {}}, (), ["FLASER"], {}),  # nobody says so
            ({"RAWLASER1": FRONT, "RAWLASER3": REAR}, (), (), {**FRONT_OPTIONS, **REAR_OPTIONS}),
            *(
                ({"RAWLASER1": {"fov": math.radians(degrees), "beams": degrees + 1}}, (), (), {})
                for degrees in (90, 270, 360)
            ),
        ),
    ],
)
def test_wherever_a_laser_sits_poses_are_as_good(mapped, good, lasers, params, flipped, options):
    placed = {kind: seen(**mount) for kind, mount in lasers.items()}
    assert mapped(placed, params, flipped, **options) < good


def test_first_scan_of_a_second_laser_is_no_misfit():
    """It looks where the first laser has not been: what it shows is not in the map yet."""
    options = {"laser": {"second_laser": True}, "robot": {"scans": 60}}
    recording = simulate(scene_by_name("office", options), 3).recording
    result = stillmap.build(recording, options={"em.max_iterations": 1})
    assert not [warning for warning in result.warnings if "badly" in warning]
