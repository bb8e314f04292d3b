"""Fleets of real recordings in processes: equal to maps by hand, whatever happens."""

import json
import os
import re
import signal
import sys

import pytest
import stand_in
from distributed import LocalCluster
from fleet_processes import NAMES, children_of, wait_until
from result_contents import contents

from stillmap.fleet import Request, run_fleet
from stillmap.fleet.inputs import Entry


def contents_of(folder):
    """The files of a result, without what a fleet adds."""
    files = contents(folder)
    files.pop("made.json", None)
    return files


@pytest.fixture(scope="module")
def fleet(recordings, start, tmp_path_factory):
    """The folder of a fleet of the recordings and of a damaged one, and what was printed."""
    out = tmp_path_factory.mktemp("fleet") / "out"
    damaged = out.parent / "damaged.bag"
    damaged.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    process = start("fleet", recordings, damaged, "-o", out, "--jobs", 2)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 3, err
    return out, err


def test_results_equal_those_by_hand(fleet, by_hand):
    out, _ = fleet
    assert sorted(os.listdir(out / "results")) == sorted(NAMES)
    for name in NAMES:
        assert contents_of(out / "results" / name) == by_hand[name], name


def test_only_what_is_promised_is_left(fleet):
    out, err = fleet
    assert sorted(os.listdir(out)) == ["fleet.html", "fleet.json", "results"]
    assert sorted(os.listdir(out.parent)) == ["damaged.bag", "out"]
    assert all(line.startswith("stillmap: ") for line in err.splitlines()), err


def test_damaged_one_is_named(fleet):
    out, err = fleet
    (entry,) = [one for one in json.loads((out / "fleet.json").read_text()) if one["why"]]
    assert (entry["name"], entry["status"], entry["result"]) == ("damaged", "failed", None)
    assert f"stillmap: damaged: {entry['why']}" in err.splitlines()


def test_page_is_self_contained(fleet):
    out, _ = fleet
    text = (out / "fleet.html").read_text()
    sources = re.findall(r'\ssrc="([^"]*)"', text)
    links = re.findall(r'href="([^"]*)"', text)
    assert len(sources) == len(NAMES)
    assert all(one.startswith("data:image/png;base64,") for one in sources)
    assert sorted(links) == [f"results/{name}/report.html" for name in sorted(NAMES)]
    assert all((out / link).is_file() for link in links)
    assert "3 of 4 recordings mapped" in text
    assert not re.search(r"url\(|@import|<script", text)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_stopped_and_continued(start, recordings, by_hand, tmp_path, number):
    out, names = tmp_path / "out", NAMES[:2]
    words = ("fleet", *(recordings / name for name in names), "-o", out, "--jobs", 1)
    process = start(*words, start_new_session=True)
    wait_until(lambda: list(out.glob("results/*/run.json")))
    children = children_of(process.pid)
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # as Ctrl-C at a terminal
    else:
        process.send_signal(number)
    _, err = process.communicate(timeout=30)
    status = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}[number]
    assert process.returncode == status
    assert "Traceback" not in err
    if number != signal.SIGKILL:
        assert "continue with the same command: stillmap fleet" in err
        assert not list(out.glob("*/.*"))
    wait_until(lambda: not any(os.path.exists(f"/proc/{pid}/exe") for pid in children), 20)
    done = {path.parent: path.stat().st_ino for path in out.glob("results/*/run.json")}
    again = start(*words, "--quiet")
    assert again.communicate(timeout=60) == ("", "")
    assert again.returncode == 0
    for name in names:
        assert contents_of(out / "results" / name) == by_hand[name]
    for folder, inode in done.items():
        assert (folder / "run.json").stat().st_ino == inode  # not mapped again


@pytest.mark.slow
def test_workers_of_a_scheduler(recordings, by_hand, start, tmp_path):
    """One of two workers is killed in the midst: the work is done all the same."""
    out, settings = tmp_path / "out", {"n_workers": 2, "threads_per_worker": 1}
    with LocalCluster(dashboard_address="127.0.0.1:0", memory_limit=None, **settings) as cluster:
        workers = [worker.process.pid for worker in cluster.workers.values()]
        address = cluster.scheduler_address
        process = start("fleet", recordings, "-o", out, "--scheduler", address, "--json")
        wait_until(lambda: list(out.glob("results/.part-*")) or process.poll() is not None)
        os.kill(workers[0], signal.SIGKILL)
        printed, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert {one["status"] for one in json.loads(printed)} == {"done"}
    for name in NAMES:
        assert contents_of(out / "results" / name) == by_hand[name], name
    assert not list(out.glob("*/.*"))


@pytest.mark.slow
def test_recording_whose_workers_die(tmp_path, monkeypatch):
    """It fails, the others go on."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    names = ("deadly", "mild")
    for name in names:
        (tmp_path / f"{name}.clf").write_text(name)
    failures = []
    entries = [Entry(str(tmp_path / f"{name}.clf"), None) for name in names]
    request = Request(
        entries, str(tmp_path / "out"), stand_in.die, failures.append, lambda *_: None
    )
    fleet = run_fleet(request)
    whys = {job.source.name: job.outcome.why for job in fleet.jobs}
    assert whys["mild"] == "it lives"
    assert whys["deadly"] == "its worker died 4 times: is there enough memory?"
    assert len(failures) == fleet.failed == 2


def test_no_scheduler_answers(call, recordings, tmp_path, monkeypatch):
    monkeypatch.setattr("stillmap.fleet.run._TIMEOUT", 1)
    done = call("fleet", recordings, "-o", tmp_path / "out", "--scheduler", "tcp://127.0.0.1:9")
    assert done.returncode == 2
    assert "tcp://127.0.0.1:9: no Dask scheduler answers" in done.stderr


def test_missing_library(call, recordings, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    done = call("fleet", recordings, "-o", tmp_path / "out")
    assert done.returncode == 2
    assert "needs distributed" in done.stderr
