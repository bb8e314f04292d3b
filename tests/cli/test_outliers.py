"""Poses, odometry and ranges that are far off: the rest is mapped, in little memory."""

import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from maps import QUICK, TWO_ITERATIONS

from stillmap.cli.main import main

MOST = 700 << 20  # bytes of the process
LIMIT = 5 << 30  # of address space, so that a failure does not take all of the machine
# the peak that the system tells of a process holds that of the one which started it
MEASURED = """
import sys
from pathlib import Path
from stillmap.cli.main import main
status = main(sys.argv[2:])
Path(sys.argv[1]).write_text(Path("/proc/self/status").read_text())
sys.exit(status)
"""


@pytest.fixture
def map_it(tmp_path, tmp_path_factory):
    """Maps: status, lines on stderr, peak memory in bytes, and the result folder."""

    def run(recording, *words):
        out = tmp_path / "out"
        known = tmp_path_factory.mktemp("measured") / "status"
        call = [sys.executable, "-c", MEASURED, str(known), "map", str(recording), "-o", str(out)]
        call += ["--quiet", "--threads", "1"]
        process = subprocess.Popen(
            [*call, *QUICK, *map(str, words)],
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (LIMIT, LIMIT)),
        )
        said = process.stderr.read()
        process.stderr.close()
        process.wait()
        peak = 1024 * int(known.read_text().partition("VmHWM:")[2].split()[0])
        return process.returncode, said.splitlines(), peak, out

    return run


@pytest.fixture
def poses(room, tmp_path):
    """Writes the true poses of the room, changed by a function of x and y (T, 2), as a file."""

    def write(change):
        rows = np.loadtxt(room / "truth" / "trajectory.tum", dtype=str)
        rows[:, 1:3] = np.array(
            [f"{v:.9g}" for v in change(rows[:, 1:3].astype(float)).flat]
        ).reshape(-1, 2)
        path = tmp_path / "poses.tum"
        np.savetxt(path, rows, fmt="%s")
        return path

    return write


@pytest.fixture
def changed(room, tmp_path):
    """The room with an array that a function changes in place."""

    def write(name, change):
        folder = tmp_path / "changed"
        shutil.copytree(room, folder)
        array = np.load(folder / f"{name}.npy")
        change(array)
        np.save(folder / f"{name}.npy", array)
        return folder

    return write


def size_of_map(out: Path) -> tuple[int, ...]:
    with np.load(out / "map.npz") as npz:
        return npz["p_occupied"].shape


@pytest.mark.parametrize("far", [1e4, 1e7])
def test_one_far_pose(map_it, room, poses, far):
    def change(xy):
        xy[20] = far, -far
        return xy

    status, said, peak, out = map_it(room, "--poses", poses(change))
    assert (status, said) == (0, [])
    assert peak < MOST
    height, width = size_of_map(out)
    assert max(height, width) * 0.05 < 15  # m, the room
    assert np.loadtxt(out / "trajectory.tum")[20, 1:3].tolist() == [far, -far]
    (warning,) = [
        w for w in json.loads((out / "run.json").read_text())["warnings"] if "scan 20" in w
    ]
    assert "outside the map" in warning or "farther than 100 km" in warning
    assert (out / "report.html").stat().st_size > 10_000


@pytest.mark.parametrize("leap", [1e4, pytest.param(1e6, marks=pytest.mark.slow)])
def test_odometry_that_leaps(map_it, changed, leap):
    def change(T):
        T[20:, :2, 2] += leap

    status, said, peak, out = map_it(changed("T_odom_base", change))
    assert (status, said) == (0, [])
    assert peak < MOST
    assert np.ptp(np.loadtxt(out / "trajectory.tum")[:, 1:3], axis=0).max() < 10.0
    assert any(
        "odometry leaps" in w for w in json.loads((out / "run.json").read_text())["warnings"]
    )


def test_what_was_computed_is_resumed(room, tmp_path, monkeypatch, capsys):
    def fail(*_):
        raise MemoryError("std::bad_alloc")

    words = ["map", str(room), "-o", str(tmp_path / "out"), *TWO_ITERATIONS]
    with monkeypatch.context() as patched:
        patched.setattr("stillmap.results.writer.write_labels", fail)
        assert main([*words, "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "not enough memory" in line
    assert "continue after iteration 2: stillmap map" in line
    assert os.listdir(tmp_path) == [".out.resume"]
    assert main([*words, "--resume"]) == 0
    assert "continues after iteration 2" in capsys.readouterr().err
    assert os.listdir(tmp_path) == ["out"]
