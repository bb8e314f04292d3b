"""The same tasks on a real Dask cluster of two worker processes."""

import json
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from fleets import NAMES, children_of, is_alive, unfinished, wait_until
from result_contents import contents

from stillmap.core.errors import InputError
from stillmap.fleet.dask_executor import DaskExecutor
from stillmap.fleet.settings import Settings
from stillmap.fleet.tasks import Map, identify

pytest.importorskip("distributed")


def busy_with_maps(workers):
    """The workers that run `stillmap map`."""
    return [
        one for one in workers if any(b"\0map\0" in command_of(child) for child in children_of(one))
    ]


def command_of(pid):
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


@pytest.mark.slow
def test_worker_killed_and_client_interrupted(dask_cluster, recordings, by_hand, start, tmp_path):
    address, workers = dask_cluster
    out = tmp_path / "out"
    words = ("fleet", recordings, "-o", out, "--scheduler", address)
    # the client is interrupted while its first recordings are mapped
    first = start(*words)
    wait_until(lambda: list(out.glob(".fleet/work/*/.result.resume")))
    first.send_signal(signal.SIGINT)
    _, err = first.communicate(timeout=30)
    assert first.returncode == 130, err
    assert "continue with the same command" in err
    assert "Traceback" not in err
    # the same command goes on; one worker is killed in the midst
    again = start(*words, "--json")
    wait_until(lambda: busy_with_maps(workers) or again.poll() is not None)
    (worker, *_) = busy_with_maps(workers)
    children = children_of(worker)
    os.kill(worker, signal.SIGKILL)
    wait_until(lambda: not any(map(is_alive, children)), 5)
    printed, err = again.communicate(timeout=120)
    assert again.returncode == 0, err
    assert "Traceback" not in err
    assert {one["status"] for one in json.loads(printed)} == {"done"}
    for name in NAMES:
        assert contents(out / "results" / name) == by_hand[name], name
    assert unfinished(out) == set()


def test_no_scheduler_answers(monkeypatch):
    monkeypatch.setattr("stillmap.fleet.dask_executor._TIMEOUT", 1)
    with pytest.raises(InputError, match=r"tcp://127.0.0.1:9: no Dask scheduler answers"):
        DaskExecutor("tcp://127.0.0.1:9")


def test_missing_library(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"tcp://a:1: needs distributed.*\[fleet\]"):
        DaskExecutor("tcp://a:1")


def test_equal_tasks_alone_have_one_key():
    task = Map("a", "/in/a.bag", "f", Settings(), "key", "/out")
    others = [replace(task, root="/elsewhere"), replace(task, key="k"), replace(task, source="/b")]
    others += [replace(task, settings=Settings((("em.prior", "0.7"),)))]
    assert identify(task) == identify(replace(task))
    assert len({identify(one) for one in (task, *others)}) == 5
