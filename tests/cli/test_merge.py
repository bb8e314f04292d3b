"""`stillmap merge` as a command."""

import json
import os
import shutil
import signal
import time

import numpy as np
import pytest
from flat import files_of
from maps import ENDLESS
from refusals import refused

from stillmap.results.eval.readers import read_trajectory
from stillmap.results.eval.trajectory import align

QUICK = ("--threads", "1", "--quiet")


def measure_errors(place, flat_days, day):
    """(T,) m between true positions of one day and those in a place, as its first day lies."""
    poses = {
        k: (
            read_trajectory(place / "sessions" / f"map{k}" / "trajectory.tum").poses,
            read_trajectory(flat_days / f"day{k}" / "truth" / "trajectory.tum").poses,
        )
        for k in ("1", day)
    }
    T_world_place = align(*poses["1"])
    estimated, true = poses[day]
    return np.linalg.norm((T_world_place @ estimated - true)[:, :-1, -1], axis=1)


def test_results_and_what_is_said(call, flat_days, tmp_path):
    done = call(
        *("merge", flat_days / "map1", flat_days / "map2", "-o", tmp_path / "place"),
        *("--threads", "1", "--json"),
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert [one["name"] for one in said["sessions"]] == ["map1", "map2"]
    assert said["sessions"][0]["input"] == str(flat_days / "map1")
    assert said["changes"] == 1
    assert {"map.pgm", "sessions.json", "changes.json", "run.json"} <= set(said["files"])
    assert "2 sessions in one map" in done.stderr
    assert "1 changes between sessions: 1 appeared" in done.stderr


def test_recordings_give_the_same_as_their_results(call, flat_days, flat_place, tmp_path):
    """The same options: what is mapped on the way is what was mapped before."""
    done = call(
        *("merge", flat_days / "day1", flat_days / "day2", "-o", tmp_path / "place"),
        *("--set", "em.max_iterations=2", *QUICK),
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == done.stdout == ""
    for name in ("map.npz", "trajectory.tum", "beams/p_static.npy", "changes.json"):
        got, wanted = ((one / name).read_bytes() for one in (tmp_path / "place", flat_place))
        assert got.replace(b"day", b"map") == wanted, name


def test_a_place_grows_and_keeps_its_frame(call, flat_days, flat_place, tmp_path):
    before = files_of(flat_place)
    words = ("merge", flat_place, flat_days / "map3", "-o", tmp_path / "grown")
    assert call(*words, *QUICK).returncode == 0
    assert files_of(flat_place) == before
    old, new = (
        json.loads((one / "sessions.json").read_text()) for one in (flat_place, tmp_path / "grown")
    )
    assert [one["name"] for one in new] == ["map1", "map2", "map3"]
    assert [one["first_scan"] for one in new] == [0, 100, 200]
    for one, other in zip(old, new, strict=False):
        assert one["input"] == other["input"]
        for row, other_row in zip(one["T_place_session"], other["T_place_session"], strict=True):
            assert row == pytest.approx(other_row, abs=0.05)
    assert old[0]["T_place_session"] == new[0]["T_place_session"]
    # what the third day says about the second one hardly brings it farther from the truth
    before, after = (
        measure_errors(one, flat_days, "2") for one in (flat_place, tmp_path / "grown")
    )
    # two cells; over thirty seeds at most 0.072 m, and the mean grows by at most 0.0017 m
    assert max(*before, *after) < 0.1
    assert np.mean(after) < np.mean(before) + 0.005
    assert max(measure_errors(tmp_path / "grown", flat_days, "3")) < 0.1
    refused(call(*words), "already holds something", "--overwrite")
    refused(call(*words, "--overwrite", "--resolution", "0.1", "--quiet"), "cells of 0.05 m")


def test_another_frame_and_then_growth(call, flat_days, tmp_path):
    """The constraints stay those of their sessions, whichever comes first."""
    turned, grown = tmp_path / "turned", tmp_path / "grown"
    done = call(
        *("merge", flat_days / "map1", flat_days / "map2", "-o", turned, "--frame", "map2"), *QUICK
    )
    assert done.returncode == 0, done.stderr
    assert call("merge", turned, flat_days / "map3", "-o", grown, *QUICK).returncode == 0
    lists = [json.loads((one / "sessions.json").read_text()) for one in (turned, grown)]
    for sessions in lists:
        assert [one["name"] for one in sessions][:2] == ["map1", "map2"]
        T = sessions[1]["T_place_session"]
        assert [*T[0], *T[1]] == pytest.approx([1, 0, 0, 0, 1, 0], abs=1e-9)
    first, second = (one[0]["T_place_session"] for one in lists)
    for row, other_row in zip(first, second, strict=True):
        assert row == pytest.approx(other_row, abs=0.05)
    refused(
        call("merge", turned, flat_days / "map3", "-o", tmp_path / "x", "--frame", "day9"),
        "frame of day9",
        "--frame NAME",
    )


def test_what_is_refused(call, flat_days, flat_place, tmp_path, nothing_left):
    out = tmp_path / "out"
    day1 = flat_days / "map1"
    refused(call("merge", day1, tmp_path / "no.bag", "-o", out), "no.bag: does not exist")
    refused(call("merge", day1, flat_place, "-o", out), "is a place, among sessions")
    refused(call("merge", flat_place, "-o", out), "no session is named")
    refused(call("merge", day1, "-o", out), "one session alone is no place")
    refused(
        call("merge", day1, flat_days / "map2", "-o", out, "--map-state", "new"),
        "is no state of a map: new",
        "--map-state last",
    )
    refused(
        call("merge", day1, flat_days / "map2", "-o", day1, "--overwrite"), "one of the sessions"
    )
    nothing_left()
    copy = tmp_path / "copy"
    shutil.copytree(flat_place, copy)
    (copy / "sessions" / "map1" / "state" / "nodes.npy").write_bytes(b"")
    refused(call("merge", copy, flat_days / "map3", "-o", out), "nodes.npy: is damaged")
    (copy / "sessions.json").unlink()
    refused(call("merge", copy, flat_days / "map3", "-o", out), "sessions.json: cannot be read")
    nothing_left("copy")


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted(start, flat_days, hall, tmp_path, number, status):
    process = start(
        *("merge", flat_days / "map1", hall, "-o", tmp_path / "out"),
        *ENDLESS,
    )
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob(".out.*.part/sessions/map1/state/p_static.npy")):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == status
    assert "Traceback" not in err
    assert os.listdir(tmp_path) == []
