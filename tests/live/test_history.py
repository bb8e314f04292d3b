"""What is kept of a live run: its recording while it lasts, a full disk, labels given later."""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

import stillmap
from stillmap.cli.main import main
from stillmap.core.errors import InputError
from stillmap.io.stillmap_folder import read
from stillmap.live.history import FOLDER
from stillmap.live.loop_process import LoopProcess
from stillmap.live.mapper import LiveMapper
from stillmap.live.saving import Snapshot
from stillmap.sim import scene_by_name, simulate, write_simulation

SCANS = 60
ARRAYS = ("stamp_ns", "offset", "points", "hit", "sensor", "T_base_sensor", "T_odom_base")


def drive(mapper, run, scans=range(SCANS)):
    for t in scans:
        update = mapper.push(run.beams[t], run.recording.T_odom_base[t])
        np.testing.assert_array_equal(update.pose, run.updates[t].pose)
        np.testing.assert_array_equal(update.p_static, run.updates[t].p_static)
    mapper.update_map()


def check_recording(folder, run, scans=SCANS):
    """The first scans of a run, and nothing else."""
    recording = read(folder)
    assert recording.n_scans == scans
    M = run.recording.offset[scans]
    for name in ARRAYS:
        expected = getattr(run.recording, name)
        n = {"offset": scans + 1, "points": M, "hit": M, "T_base_sensor": 1}.get(name, scans)
        np.testing.assert_array_equal(getattr(recording, name), expected[:n])


def test_the_drive_is_a_recording_while_it_lasts(corridor, tmp_path):
    with LiveMapper({"threads": 1}, folder=tmp_path / "drive") as mapper:
        for until in (1, 20, SCANS):
            drive(mapper, corridor, range(len(mapper.poses), until))
            check_recording(tmp_path / "drive", corridor, until)
        shutil.copytree(tmp_path / "drive", tmp_path / "killed")
    assert json.loads((tmp_path / "killed/recording.json").read_text())["open"]
    assert not json.loads((tmp_path / "drive/recording.json").read_text())["open"]
    check_recording(tmp_path / "drive", corridor)
    assert len(np.load(tmp_path / "drive/stamp_ns.npy")) == SCANS
    assert main(["map", str(tmp_path / "killed"), "-o", str(tmp_path / "out"), "--quiet"]) == 0
    assert len(stillmap.load(tmp_path / "out").poses) == SCANS


@pytest.mark.parametrize(
    ("name", "lost", "scans"), [("offset", 3, -1), ("stamp_ns", 8, -1), ("points", 1, -1)]
)
def test_half_a_scan_is_left_out(corridor, tmp_path, name, lost, scans):
    with LiveMapper({"threads": 1}, folder=tmp_path / "drive") as mapper:
        drive(mapper, corridor)
        shutil.copytree(tmp_path / "drive", tmp_path / "killed")
    path = tmp_path / f"killed/{name}.npy"
    os.truncate(path, path.stat().st_size - lost)
    check_recording(tmp_path / "killed", corridor, SCANS + scans)


def test_damage_of_an_open_drive_is_named(corridor, tmp_path):
    with LiveMapper({"threads": 1}, folder=tmp_path / "drive") as mapper:
        drive(mapper, corridor, range(2))
        shutil.copytree(tmp_path / "drive", tmp_path / "killed")
    points, stamps = (tmp_path / f"killed/{name}.npy" for name in ("points", "stamp_ns"))
    for harm, said in (
        (lambda: os.truncate(points, 200), "no whole scan"),
        (lambda: points.write_bytes(b"x" * 500), r"points\.npy: is damaged"),
        (stamps.unlink, r"stamp_ns\.npy"),
    ):
        harm()
        with pytest.raises(InputError, match=said):
            read(tmp_path / "killed")


def test_odometry_and_beam_times_of_some_scans(corridor, tmp_path):
    times = np.linspace(0.0, 0.1, len(corridor.beams[0].points), dtype=np.float32)
    with LiveMapper({"threads": 1}, folder=tmp_path / "drive") as mapper:
        mapper.push(corridor.beams[0], corridor.recording.T_odom_base[0])
        mapper.push(replace(corridor.beams[1], beam_time=times, sensor="rear"))
        mapper.update_map()
        recording = read(tmp_path / "drive")
    assert recording.T_odom_base is None
    np.testing.assert_array_equal(recording.beam_time, [*np.zeros(len(times)), *times])
    assert recording.sensor.tolist() == [0, 1]


def test_a_drive_goes_on_when_the_disk_is_full(corridor, tmp_path, limit_files, caplog):
    with LiveMapper({"threads": 1}, folder=tmp_path / "out" / FOLDER) as mapper:
        drive(mapper, corridor, range(50))
        limit_files(150_000)
        drive(mapper, corridor, range(50, 300))
        limit_files(None)
        drive(mapper, corridor, range(300, 400))
        poses = mapper.poses
        mapper.save(tmp_path / "out")
        with pytest.raises(InputError, match="not kept"):
            mapper.label(corridor.beams[399], 399)
    assert 50 < len(poses) < 300
    np.testing.assert_allclose(poses, corridor.mapper.poses[: len(poses)], atol=0.05)
    assert sum("poses go on, but from here" in one.getMessage() for one in caplog.records) == 1
    check_recording(tmp_path / "out" / FOLDER, corridor, len(poses))
    saved = stillmap.load(tmp_path / "out")
    np.testing.assert_allclose(saved.poses, poses, atol=1e-6)
    (warning,) = [what for what in saved.run["warnings"] if "full" in what]
    assert f"400 scans {len(poses)} were kept" in warning
    given = np.load(tmp_path / "out/live/beams/p_static.npy")
    np.testing.assert_array_equal(given, corridor.p_static[: len(given)])


def test_loops_are_no_longer_closed_when_the_disk_is_full(corridor, tmp_path, limit_files, caplog):
    with LiveMapper({"threads": 1}, scratch=tmp_path) as mapper:
        limit_files(100_000)
        drive(mapper, corridor, range(200))
        limit_files(None)
    assert sum("loops are no longer closed" in one.getMessage() for one in caplog.records) == 1


def test_loops_closed_beside_end_quietly_when_the_disk_is_full(
    corridor, tmp_path, limit_files, caplog, capfd
):
    limit_files(100_000)
    with LiveMapper({"threads": 1}, scratch=tmp_path, background=True) as mapper:
        for t, beams in enumerate(itertools.islice(corridor.beams, 300)):
            mapper.push(beams, corridor.recording.T_odom_base[t])
        closer = mapper._slam.frame._closer
        assert isinstance(closer, LoopProcess)
        deadline = time.monotonic() + 20.0
        while closer._process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        mapper.push(corridor.beams[300], corridor.recording.T_odom_base[300])
        closer.poll()
        limit_files(None)
    assert caplog.text.count("loops are no longer closed") == 1
    assert "Traceback" not in capfd.readouterr().err


def test_a_bounded_drive(corridor, tmp_path, caplog):
    with LiveMapper({"threads": 1}, max_scratch=400_000) as mapper:
        drive(mapper, corridor, range(200))
        mapper.save(tmp_path / "out")
        assert len(mapper.finish().poses) == len(mapper.poses)
    beams = len(np.load(tmp_path / "out/beams/p_static.npy"))
    assert 400_000 / 17 <= beams < 400_000 / 17 + len(corridor.beams[0].points)
    assert "0.0004 GB" in caplog.text


def test_a_result_saved_amid_the_drive_holds_all_of_it(corridor, tmp_path):
    out = tmp_path / "out"
    with LiveMapper({"threads": 1}, folder=out / FOLDER) as mapper:
        drive(mapper, corridor, range(30))
        mapper.save(out)
        check_recording(out / FOLDER, corridor, 30)
        drive(mapper, corridor, range(30, SCANS))
        check_recording(out / FOLDER, corridor)
        mapper.save(out, overwrite=True)
    check_recording(out / FOLDER, corridor)
    assert len(stillmap.load(out).poses) == SCANS
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert stillmap.load(out).recording.n_scans == SCANS


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError, OSError(28, "full")])
def test_a_drive_whose_result_cannot_be_made_is_kept(
    corridor, tmp_path, monkeypatch, caplog, error
):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(Snapshot, "_map", fail)
    expected = InputError if isinstance(error, OSError) else error
    with LiveMapper({"threads": 1}, folder=tmp_path / "out" / FOLDER) as mapper:
        drive(mapper, corridor)
        with pytest.raises(expected) as failed:
            mapper.save(tmp_path / "out")
    assert f"stillmap map {tmp_path / 'out' / FOLDER}" in caplog.text + str(failed.value)
    check_recording(tmp_path / "out" / FOLDER, corridor)


def test_a_command_that_is_killed_leaves_its_drive(tmp_path):
    write_simulation(
        simulate(scene_by_name("hall", {"robot": {"scans": 100}}), 1), tmp_path / "sim"
    )
    words = ["live", "--replay", tmp_path / "sim", "-o", tmp_path / "out", "--rate", "1", "--quiet"]
    process = subprocess.Popen([sys.executable, "-m", "stillmap", *map(str, words)])
    stamps, deadline = tmp_path / "out" / FOLDER / "stamp_ns.npy", time.monotonic() + 60.0
    while not stamps.exists() or stamps.stat().st_size < 128 + 8 * 10:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    sent, left = read(tmp_path / "sim"), read(tmp_path / "out" / FOLDER)
    assert 10 <= left.n_scans < 100
    assert np.isin(left.stamp_ns, sent.stamp_ns).all()  # some are late
    np.testing.assert_array_equal(left.points[left.beams_of(0)], sent.points[sent.beams_of(0)])
    again = [*map(str, words[:5]), "--quiet"]
    assert main(again) == 2
    assert main([*again, "--overwrite"]) == 0
    assert read(tmp_path / "out" / FOLDER).n_scans == 100


def test_scans_are_labelled_once_more_after_the_lag(corridor):
    with LiveMapper({"threads": 1}, lag=2.0) as mapper:
        later = {}
        for t, beams in enumerate(corridor.beams[:120]):
            update = mapper.push(beams, corridor.recording.T_odom_base[t])
            for one in update.hindsight:
                later[one.number] = (t, one.p_static)
    assert sorted(later) == list(range(len(later)))
    stamps = corridor.recording.stamp_ns
    lags = [1e-9 * (stamps[now] - stamps[t]) for t, (now, _) in later.items()]
    assert 2.0 <= min(lags) <= max(lags) < 2.0 + 1e-9 * np.diff(stamps).max()
    wrong = {"at once": 0, "later": 0}
    for t, (_, p_static) in itertools.islice(later.items(), 20, None):
        moves, hit = ~corridor.truth.static[corridor.recording.beams_of(t)], corridor.beams[t].hit
        wrong["at once"] += np.sum(((corridor.updates[t].p_static < 0.5) != moves)[hit])
        wrong["later"] += np.sum(((p_static < 0.5) != moves)[hit])
    assert 0 < wrong["later"] < 0.9 * wrong["at once"]


@pytest.mark.parametrize("settings", [{"max_scratch": 0}, {"max_scratch": 1000}, {"lag": 0.0}])
def test_wrong_bounds_are_named(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        LiveMapper(**settings)
