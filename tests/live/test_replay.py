"""`stillmap live --replay`: a recording through the live mapper."""

import json

import numpy as np
import pytest

from stillmap.cli.main import main
from stillmap.sim import scene_by_name, simulate, write_simulation


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    folder = tmp_path_factory.mktemp("live") / "hall"
    write_simulation(simulate(scene_by_name("hall", {"robot": {"scans": 60}}), 1), folder)
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
        assert told["scans"] == 60
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


@pytest.mark.parametrize("flags", [[], ["--rate", "0"], ["--max-scratch", "0"]])
def test_wrong_calls_are_refused_before_any_work(hall, tmp_path, capsys, flags):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mine.txt").write_text("mine")
    assert main(["live", "--replay", str(hall), "-o", str(tmp_path / "out"), *flags]) == 2
    assert (flags or ["out"])[0] in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine.txt"]


@pytest.mark.slow
def test_at_its_own_pace(hall, tmp_path, capsys):
    words = ["live", "--replay", str(hall), "-o", str(tmp_path / "out"), "--json", "--quiet"]
    assert main([*words, "--rate", "4"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["scans"] + told["dropped"] == 60
    assert told["scans"] > 15


def test_in_a_known_map(hall, tmp_path, capsys):
    words = ["live", "--replay", str(hall), "--quiet"]
    assert main([*words, "-o", str(tmp_path / "map")]) == 0
    assert main([*words, "-o", str(tmp_path / "again"), "--map", str(tmp_path / "map")]) == 0
    one, two = (np.loadtxt(tmp_path / name / "trajectory.tum")[:, 1:3] for name in ("map", "again"))
    assert np.linalg.norm(one - two, axis=1).max() < 0.15
    assert main([*words, "-o", str(tmp_path / "no"), "--map", str(tmp_path / "none")]) == 2
    assert "none" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()
