"""`stillmap map` as a process: outputs and refusals."""

import filecmp
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from flat import list_files
from maps import QUICK
from refusals import refused
from result_contents import FILES

from stillmap.core.recording import Recording
from stillmap.core.source import SensorNotes, Source
from stillmap.io import read, write
from stillmap.io.trajectory import read_tum

PCD = """VERSION 0.7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH 3
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 3
DATA ascii
4 0 0
4 1 0
4 0 1
"""


@pytest.fixture(scope="module")
def mapped(stillmap, room, tmp_path_factory):
    """A finished run: its folder and what it said."""
    out = tmp_path_factory.mktemp("mapped") / "out"
    done = stillmap("map", room, "-o", out, "--set", "em.max_iterations=2", "--json")
    assert done.returncode == 0, done.stderr
    return out, done


def test_writes_the_files_of_the_contract(mapped):
    out, _ = mapped
    assert list_files(out) >= FILES
    T = len(np.load(out / "beams/stamp_ns.npy"))
    p_static = np.load(out / "beams/p_static.npy", mmap_mode="r")
    hit = np.load(out / "beams/hit.npy", mmap_mode="r")
    assert T == 40
    assert p_static.shape == hit.shape == (40 * 120,)
    assert p_static.dtype == np.float32
    assert hit.dtype == bool
    stamp_ns, poses = read_tum(out / "trajectory.tum")
    assert np.array_equal(stamp_ns, np.load(out / "beams/stamp_ns.npy"))
    assert np.array_equal(poses[0], np.eye(4))
    described = yaml.safe_load((out / "map.yaml").read_text())
    arrays = np.load(out / "map.npz")
    assert described["origin"] == arrays["origin"].tolist()
    assert described["resolution"] == arrays["resolution"] == 0.05


def test_run_json(mapped):
    run = json.loads((mapped[0] / "run.json").read_text())
    assert [it["number"] for it in run["iterations"]] == list(range(1, len(run["iterations"]) + 1))
    assert run["best_iteration"] in range(1, len(run["iterations"]) + 1)
    counts = run["counts"]
    assert (counts["scans"], counts["beams"]) == (40, 4800)
    assert counts["hits"] + counts["max_range"] + counts["unusable"] == counts["beams"]
    assert counts["hits"] == int(np.load(mapped[0] / "beams/hit.npy").sum())
    assert {"read", "m_step", "e_step", "maps"} <= set(run["seconds"])
    assert set(run["seconds"]) == set(run["cpu_seconds"]) == set(run["peak_memory_bytes"])


def test_summary_as_json(mapped):
    out, done = mapped
    found, record = json.loads(done.stdout), json.loads((out / "run.json").read_text())
    assert found["output"] == str(out)
    assert set(found["files"]) == list_files(out)
    assert found["iterations"] == len(record["iterations"])
    for key in ("counts", "converged", "best_iteration", "warnings", "seconds", "area"):
        assert found[key] == record[key], key


def test_progress_lines_without_terminal(mapped):
    _, done = mapped
    lines = done.stderr.splitlines()
    assert all(line.startswith("stillmap: ") for line in lines)
    assert sum("iteration 1/2" in line for line in lines) == 1
    assert re.search(r"40 of 40 scans, \d+/s", done.stderr)
    assert "\x1b" not in done.stderr
    assert "\r" not in done.stderr
    assert re.search(r": kept iteration [12] of [12]\b", done.stderr)
    assert re.search(r": quality \d+ of 100: labels \d+, geometry \d+\n", done.stderr)
    assert str(mapped[0] / "report.html") in lines[-2]
    assert lines[-1] == f"stillmap: see it over time: stillmap view {mapped[0]}"


def test_quiet(call, room, tmp_path, nothing_left):
    done = call("map", room, "-o", tmp_path / "out", "--quiet", *QUICK)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    nothing_left("out")


def same_result(a, b) -> None:
    """Everything but times is the same to the byte."""
    same = sorted(FILES - {"run.json", "report.html"})
    assert filecmp.cmpfiles(a, b, same, shallow=False)[1:] == ([], [])


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_same_bytes_for_any_number_of_threads(call, room, mapped, tmp_path, threads):
    words = ("--set", "em.max_iterations=2", "--threads", threads)
    assert call("map", room, "-o", tmp_path / "out", *words).returncode == 0
    same_result(mapped[0], tmp_path / "out")


def test_reader_warnings_are_printed_and_kept(call, room, tmp_path):
    assert call("convert", room, "-o", tmp_path / "a.bag", "--quiet").returncode == 0
    content = (tmp_path / "a.bag").read_bytes()
    (tmp_path / "a.bag").write_bytes(content[: int(0.8 * len(content))])
    done = call("map", tmp_path / "a.bag", "-o", tmp_path / "out", *QUICK)
    assert done.returncode == 0, done.stderr
    assert "warning: the bag is cut or damaged" in done.stderr
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert run["warnings"][0].startswith("the bag is cut or damaged")
    assert "the bag is cut or damaged" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize("content", ["", "no recording\n"])
def test_non_recording_is_refused(call, tmp_path, nothing_left, content):
    (tmp_path / "input.log").write_text(content)
    refused(call("map", tmp_path / "input.log", "-o", tmp_path / "out"), "input.log")
    nothing_left("input.log")


def test_no_odometry(call, room, tmp_path):
    done = call("map", room, "-o", tmp_path / "out", "--no-odometry", *QUICK)
    assert done.returncode == 0
    run = json.loads((tmp_path / "out/run.json").read_text())
    assert any("no odometry" in warning for warning in run["warnings"])
    assert "note: no odometry" in done.stderr
    _, T = read_tum(tmp_path / "out/trajectory.tum")
    truth = np.load(room / "truth/T_world_base.npy")
    way = np.linalg.norm(truth[-1, :2, 2] - truth[0, :2, 2])
    assert np.linalg.norm(T[-1, :2, 3]) == pytest.approx(way, abs=0.1)


def test_given_poses(call, room, tmp_path):
    poses = room / "truth/trajectory.tum"
    done = call("map", room, "-o", tmp_path / "out", "--poses", poses, *QUICK)
    assert done.returncode == 0, done.stderr
    given, kept = read_tum(poses), read_tum(tmp_path / "out/trajectory.tum")
    np.testing.assert_array_equal(kept[0], given[0])
    np.testing.assert_allclose(kept[1], given[1], atol=1e-8)


def test_recorded_poses(call, room, tmp_path):
    truth = np.load(room / "truth/T_world_base.npy")
    write(replace(read(room), T_recorded_base=truth), tmp_path / "rec")
    words = ("map", tmp_path / "rec", "-o", tmp_path / "out", "--poses", "recording", *QUICK)
    done = call(*words)
    assert done.returncode == 0, done.stderr
    _, kept = read_tum(tmp_path / "out/trajectory.tum")
    np.testing.assert_allclose(kept[:, [0, 1]][:, :, [0, 1, 3]], truth[:, :2], atol=1e-8)


def test_recorded_poses_are_missing(call, room, tmp_path):
    done = call("map", room, "-o", tmp_path / "out", "--poses", "recording")
    refused(done, room, "states no poses", "--poses FILE.tum")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("stated", [True, False])
def test_depth_images_need_poses(call, tmp_path, nothing_left, stated):
    recording = Recording(
        stamp_ns=np.arange(2, dtype=np.int64),
        offset=np.array([0, 4, 8]),
        points=np.ones((8, 3), np.float32),
        hit=np.ones(8, np.bool_),
        T_base_sensor=np.eye(4)[None],
        sensor=np.zeros(2, np.int32),
        T_odom_base=None,
        source=Source(sensors=[SensorNotes("depth", grid=(2, 2))]),
        T_recorded_base=np.tile(np.eye(4), (2, 1, 1)) if stated else None,
    )
    write(recording, tmp_path / "depth")
    done = call("map", tmp_path / "depth", "-o", nothing_left)
    refused(done, "depth images", "--poses recording" if stated else "--poses FILE.tum")


def test_poses_that_do_not_match_are_refused(call, room, tmp_path, nothing_left):
    lines = (room / "truth/trajectory.tum").read_text().splitlines(keepends=True)
    file = tmp_path / "poses.tum"
    for text, said in (
        ("".join(lines[:20] + lines[22:]), ("2 of 40 scans", "scan 20")),
        ("".join(line.split(maxsplit=1)[1] for line in lines), (f"{file}:1", "is no pose")),
        ("1 0 0 0 0 0 0 1\n", ("40 of 40 scans",)),
        ("", ("no poses",)),
    ):
        file.write_text(text)
        refused(call("map", room, "-o", tmp_path / "out", "--poses", file), file, *said)
    refused(call("map", room, "-o", tmp_path / "out", "--poses", tmp_path / "absent"), "absent")
    nothing_left("poses.tum")
