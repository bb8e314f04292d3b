"""`stillmap live --replay`: a recording through the live mapper."""

import json

import numpy as np
import pytest

import stillmap
from stillmap.cli.main import main
from stillmap.sim import scene_by_name, simulate, write_simulation


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    folder = tmp_path_factory.mktemp("live") / "hall"
    write_simulation(simulate(scene_by_name("hall", {"robot": {"scans": 120}}), 1), folder)
    return folder


def contents(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in ("run.json", "report.html", "recording.json")
    }


def test_the_same_to_the_bit_every_time(hall, tmp_path, capsys):
    for name in ("one", "two"):
        words = ["live", "--replay", str(hall), "-o", str(tmp_path / name), "--json", "--quiet"]
        assert main(words) == 0
        told = json.loads(capsys.readouterr().out)
        assert told["scans"] == 120
        assert told["dropped"] == 0
        assert 0 < told["latency_ms"]["median"] <= told["latency_ms"]["max"]
        assert told["peak_memory_bytes"] > 1e6
    one = contents(tmp_path / "one")
    assert one == contents(tmp_path / "two")
    assert {"map.pgm", "trajectory.tum", "live/trajectory.tum", "live/beams/p_static.npy"} <= set(
        one
    )
    given = np.load(tmp_path / "one/live/beams/p_static.npy")
    assert given.shape == np.load(tmp_path / "one/beams/p_static.npy").shape


def test_an_output_that_is_taken_is_refused_before_any_work(hall, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mine.txt").write_text("mine")
    assert main(["live", "--replay", str(hall), "-o", str(tmp_path / "out")]) == 2
    assert "out" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine.txt"]


def test_sweeps_are_mapped_but_not_localized_in_a_planar_map(hall, tmp_path, capsys):
    lidar = {"channels": 16, "columns": 300}
    scene = scene_by_name("hall", {"lidar": lidar, "robot": {"scans": 12}})
    write_simulation(simulate(scene, 1), tmp_path / "sim")
    words = ["live", "--replay", str(tmp_path / "sim"), "-o", str(tmp_path / "out"), "--quiet"]
    assert main(words) == 0
    assert (tmp_path / "out/live/trajectory.tum").is_file()
    assert len(stillmap.load(tmp_path / "out").poses) == 12
    assert main(["live", "--replay", str(hall), "-o", str(tmp_path / "flat"), "--quiet"]) == 0
    again = [*words[:3], "-o", str(tmp_path / "again"), "--map", str(tmp_path / "flat")]
    assert main(again) == 2
    assert "static.ply" in capsys.readouterr().err
    assert not (tmp_path / "again").exists()


def test_what_is_kept_is_bounded(hall, tmp_path, capsys):
    words = ["live", "--replay", str(hall), "-o", str(tmp_path / "out"), "--quiet"]
    assert main([*words, "--max-scratch", "0.0002"]) == 0
    lines = (tmp_path / "out/live/trajectory.tum").read_text().splitlines()
    assert 40 < len(lines) < 120
    assert len(stillmap.load(tmp_path / "out").poses) == len(lines)
    assert main([*words, "--max-scratch", "0", "--overwrite"]) == 2
    assert "--max-scratch" in capsys.readouterr().err


@pytest.mark.slow
def test_at_its_own_pace(hall, tmp_path, capsys):
    words = ["live", "--replay", str(hall), "-o", str(tmp_path / "out"), "--json", "--quiet"]
    assert main([*words, "--rate", "4"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["scans"] + told["dropped"] == 120
    assert told["scans"] > 30
    assert main([*words, "--rate", "0", "--overwrite"]) == 2
    assert "--rate" in capsys.readouterr().err


def test_in_a_known_map(hall, tmp_path, capsys):
    words = ["live", "--replay", str(hall), "--quiet"]
    assert main([*words, "-o", str(tmp_path / "map")]) == 0
    assert main([*words, "-o", str(tmp_path / "again"), "--map", str(tmp_path / "map")]) == 0
    one, two = (np.loadtxt(tmp_path / name / "trajectory.tum")[:, 1:3] for name in ("map", "again"))
    assert np.linalg.norm(one - two, axis=1).max() < 0.15
    assert main([*words, "-o", str(tmp_path / "no"), "--map", str(tmp_path / "none")]) == 2
    assert "none" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()
