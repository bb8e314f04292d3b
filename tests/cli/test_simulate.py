"""`stillmap simulate`: flags, refusals, readable output."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from place_truth import load_session_truth

from stillmap import io
from stillmap.cli.parser import parser
from stillmap.core.errors import InputError
from stillmap.sim import load_truth

QUICK = ("--scans", "20", "--beams", "90", "--people", "3")


def call(*words: str) -> int:
    args = parser(["simulate"]).parse_args(["simulate", *words])
    return args.run(args)


def test_recording_reads_back_with_truth(tmp_path: Path) -> None:
    out = tmp_path / "sim"
    assert call("hall", "-o", str(out), *QUICK, "--seed", "7") == 0
    read = io.read(out)
    truth = load_truth(out)
    assert read.n_scans == 20
    assert read.n_beams == 20 * 90 == len(truth.static) == len(truth.mover)
    assert truth.movers.shape == (20, 3, 3)
    assert truth.scene["seed"] == 7
    assert json.loads((out / "truth/scene.json").read_text())["name"] == "hall"


def test_sessions_are_recordings_with_truth_in_common(tmp_path: Path, capsys) -> None:
    out = tmp_path / "days"
    assert call("lookalike-1", "-o", str(out), *QUICK, "--sessions", "2", "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in summary["sessions"]] == ["session-1", "session-2"]
    assert summary["scans"] == 40
    truth = load_session_truth(out)
    assert truth.names == ("session-1", "session-2")
    assert io.read(out / "session-2").n_scans == 20
    with pytest.raises(InputError, match="already holds something"):
        call("lookalike-1", "-o", str(out), *QUICK, "--sessions", "2")


@pytest.mark.parametrize(
    ("flags", "error"),
    [
        (("--sessions", "0"), "must be 1 or more"),
        (("--sessions", "2", "--lidar", "tilting"), "one laser or lidar"),
    ],
)
def test_refused_sessions(tmp_path: Path, flags: tuple[str, ...], error: str) -> None:
    with pytest.raises(InputError, match=error):
        call("hall", "-o", str(tmp_path / "days"), *flags)
    assert not (tmp_path / "days").exists()


def test_flags_reach_the_scene(tmp_path: Path) -> None:
    flags = "--fov 120 --max-range 12 --range-noise 0.05 --rate 10 --shape legs --stopping 1"
    flags += " --min-stop 15 --max-stop 60 --odometry-noise 0 --slip-rate 0.2"
    flags += " --stall-rate 2 --resets 1 --carried-at 0.5 --stamp-rounding 0.1"
    call("hall", "-o", str(tmp_path / "sim"), *QUICK, *flags.split())
    scene = load_truth(tmp_path / "sim").scene
    assert scene["laser"]["fov"] == pytest.approx(math.radians(120))
    assert (scene["laser"]["max_range"], scene["laser"]["range_noise"]) == (12.0, 0.05)
    assert (scene["robot"]["scan_rate"], scene["robot"]["scans"]) == (10.0, 20)
    crowd = scene["crowd"]
    assert (crowd["shape"], crowd["stopping_share"]) == ("legs", 1.0)
    assert (crowd["min_stop"], crowd["max_stop"]) == (15.0, 60.0)
    assert scene["odometry"]["drift_noise"] == 0.0
    assert scene["odometry"]["slip_rate"] == 0.2
    assert (scene["odometry"]["stall_rate"], scene["odometry"]["resets"]) == (2.0, 1)
    assert (scene["robot"]["carried_at"], scene["robot"]["stamp_rounding"]) == (0.5, 0.1)
    assert scene["carried_at_scan"] == 10


def test_any_option_can_be_set_and_flags_win(tmp_path: Path) -> None:
    words = "--set laser.yaw=0.5 --set laser.beams=7 --set odometry.slip_length=2"
    words += " --set laser.upside_down=unknown --second-laser --sweep-time 0.1 --people 0"
    call("hall", "-o", str(tmp_path / "sim"), *QUICK, *words.split())
    scene, read = load_truth(tmp_path / "sim").scene, io.read(tmp_path / "sim")
    assert (scene["laser"]["yaw"], scene["laser"]["beams"]) == (0.5, 90)
    assert scene["odometry"]["slip_length"] == 2.0
    assert scene["laser"]["upside_down"] == "unknown"
    assert scene["crowd"]["people"] == 0
    assert 0.09 < np.ptp(read.beam_time) < 0.1
    assert read.sensor.tolist() == [0, 1] * 10
    assert len(read.T_base_sensor) == 2


def test_tilting_laser_makes_two_recordings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call("hall", "-o", str(tmp_path / "sim"), "--lidar", "tilting", *QUICK, "--json", "--quiet")
    flat, tilting = (io.read(tmp_path / "sim" / name) for name in ("horizontal", "tilting"))
    assert (flat.dimension, tilting.dimension) == (2, 3)
    assert flat.n_beams == tilting.n_beams == 20 * 90
    assert json.loads(capsys.readouterr().out)["beams"] == 2 * 20 * 90
    call("hall", "-o", str(tmp_path / "sim"), "--lidar", "tilting", *QUICK, "--overwrite")


@pytest.mark.parametrize(
    ("flags", "what"),
    [
        ("--lidar 0", "channels"),
        ("--lidar many", "channels"),
        ("--lidar tilting --second-laser", "rig"),
        ("--lidar 16 --beams 90", "laser.beams"),
        ("--lidar 16 --second-laser", "laser.second_laser"),
    ],
)
def test_laser_options_are_refused_for_lidar(tmp_path: Path, flags: str, what: str) -> None:
    with pytest.raises(InputError, match=what):
        call("hall", "-o", str(tmp_path / "sim"), *flags.split())
    assert not (tmp_path / "sim").exists()


def test_unknown_scene(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'hull'.*'hall'.*corridor.*hall.*hall-empty"):
        call("hull", "-o", str(tmp_path / "sim"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--people", "-1"], "people' must be at least 0"),
        (["--people", "100000"], "no room for 100000 people"),
        (["--beams", "1"], "beams' must be at least 2"),
        (["--fov", "400"], "fov' must be"),
        (["--seed", "-1"], "--seed must not be negative"),
        (["--max-range", "nan"], "max_range.* must be a finite number"),
        (["--max-range", "0"], "max_range' must be more than 0"),
        (["--slip-rate", "-1"], "slip_rate' must be at least 0"),
        (["--odometry-noise", "-1"], "error' must be at least 0"),
        (["--sweep-time", "1"], "sweep_time must not exceed"),
        (["--set", "laser.beam=3"], "unknown option 'laser.beam'.*laser.beams"),
        (["--set", "walls=3"], "unknown option 'walls'"),
    ],
)
def test_values_out_of_range_are_refused(tmp_path: Path, flags: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        call("hall", "-o", str(tmp_path / "sim"), *flags)
    assert not list(tmp_path.iterdir())


def test_summary_unless_quiet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call("hall", "-o", str(tmp_path / "a"), *QUICK)
    said = capsys.readouterr()
    assert said.out == ""
    assert "20 scans, 1800 beams" in said.err
    truth = load_truth(tmp_path / "a")
    share = 100 * np.mean(truth.mover[truth.static | (truth.mover >= 0)] >= 0)
    assert share > 0
    assert f" {share:.1f} % of the hits on movers" in said.err
    call("hall", "-o", str(tmp_path / "b"), *QUICK, "--quiet")
    assert capsys.readouterr() == ("", "")
