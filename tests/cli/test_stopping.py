"""Interrupted and killed runs of `stillmap map`."""

import shutil
import signal
import subprocess
import time

import pytest
from flat import list_files
from maps import ENDLESS, QUICK
from result_contents import FILES


def test_closed_stderr_during_progress(start, room, tmp_path):
    # `stillmap map ... 2>&1 | head -1` still makes the map
    process = start(
        *("map", room, "-o", tmp_path / "out", "--set", "em.max_iterations=3"),
        stderr=subprocess.PIPE,
    )
    assert "iteration 1" in process.stderr.readline()
    process.stderr.close()
    assert process.wait(60) == 0
    assert list_files(tmp_path / "out") >= FILES
    process.stdout.close()


def stopped_after_a_line(process, number) -> tuple[int, str]:
    assert "iteration 1/" in process.stderr.readline()
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    return process.returncode, err


def only_a_checkpoint_left(folder) -> None:
    """None, too, where the signal came before the first iteration had ended."""
    for path in folder.iterdir():
        assert path.name == ".out.resume"
        assert {one.name.partition("-")[0] for one in path.iterdir()} == {"lock", "iteration"}


@pytest.mark.parametrize(
    ("number", "expected"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 143)]
)
def test_interrupted_while_mapping(start, hall, tmp_path, number, expected):
    process = start("map", hall, "-o", tmp_path / "out", *ENDLESS)
    status, err = stopped_after_a_line(process, number)
    assert status == expected
    last = (err.splitlines() or [""])[-1]
    assert last.startswith("stillmap: interrupted") == (number == signal.SIGINT)
    assert "Traceback" not in err
    only_a_checkpoint_left(tmp_path)


def stopped_while_writing(process, folder, number, delay=0.0) -> int:
    """Waits until the first file is being written, then sends the signal.

    Writing takes a few hundredths of a second: on a busy machine all may be over by then.
    """
    deadline = time.monotonic() + 60
    while process.poll() is None and not list(folder.glob(".out.*.part/*")):
        assert time.monotonic() < deadline
        time.sleep(0.001)
    time.sleep(delay)
    process.send_signal(number)
    process.communicate(timeout=60)
    return process.returncode


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted_while_writing(start, room, tmp_path, nothing_left, number, status):
    for _ in range(20):
        process = start("map", room, "-o", tmp_path / "out", "--quiet", *QUICK)
        got = stopped_while_writing(process, tmp_path, number)
        if not (tmp_path / "out").exists():
            break
        # the signal came when everything had been written: all of it stands there
        assert got in (0, status)
        assert list_files(tmp_path / "out") >= FILES
        nothing_left("out")
        shutil.rmtree(tmp_path / "out")
    else:
        pytest.skip("this machine is too busy to send a signal in time")
    assert got == status
    nothing_left(".out.resume")
    assert list_files(tmp_path / ".out.resume") >= {"lock", "iteration-1/checkpoint.json"}
    assert list(tmp_path.glob(".out.*.part")) == []


@pytest.mark.parametrize("delay", [0.0, 0.1, 0.4])
def test_killed_while_writing(start, room, tmp_path, delay):
    out = tmp_path / "out"
    process = start("map", room, "-o", out, "--quiet", *QUICK)
    status = stopped_while_writing(process, tmp_path, signal.SIGKILL, delay)
    assert status in (-signal.SIGKILL, 0)
    assert not out.exists() or list_files(out) >= FILES


GREEDY = """
import signal, time
try:
    signal.raise_signal({number})
    time.sleep(0.1)
except BaseException:
    print("taken for a missing module")
"""
PROGRAM = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # it may be ignored where tests run
from stillmap.cli.console import handle_signals
def command():
    handle_signals(command.__code__)
    exec("import greedy")
    sys.stdout.write("imported\\n")  # in one piece: the signal may come during a print
    while True:
        time.sleep(0.01)
try:
    command()
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signal_is_deferred_during_import(tmp_path, command, number, status):
    (tmp_path / "greedy.py").write_text(GREEDY.format(number=int(number)))
    words = [command[0], "-c", PROGRAM]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=50)
    assert (done.returncode, done.stdout, done.stderr) == (status, "imported\n", "")


PACKING = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # it may be ignored where tests run
from pathlib import Path
import numpy as np
from stillmap.cli.console import handle_signals
from stillmap.results import point_cloud
from stillmap.results.export import point_cloud_files
def command():
    handle_signals(command.__code__)
    points = np.random.default_rng(1).normal(size=(50_000, 3))
    block = point_cloud.Block(points, np.ones(50_000, "f4"), None)
    def endless():
        while True:
            yield block
            print("packed", flush=True)
    path = Path("a.laz")
    all_points = point_cloud.Cloud(10**9, np.zeros(3), None, endless)
    point_cloud_files.write(all_points, path, point_cloud_files.format_for(path))
try:
    command()
except KeyboardInterrupt:
    sys.exit(130)
"""


def test_signal_is_deferred_while_packing(tmp_path, command):
    pytest.importorskip("lazrs")
    words = [command[0], "-c", PACKING]
    for blocks in (1, 3, 5):
        process = subprocess.Popen(
            words, cwd=tmp_path, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        for _ in range(blocks):
            assert process.stdout.readline() == "packed\n"
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
        assert (process.returncode, err) == (130, "")
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["SIGINT", "SIGHUP"])
def test_ignored_signals_stay_ignored(command, name):
    program = (
        f"import signal; signal.signal(signal.{name}, signal.SIG_IGN)\n"
        "from stillmap.cli.console import handle_signals\n"
        f"handle_signals(handle_signals.__code__); signal.raise_signal(signal.{name})\n"
    )
    assert subprocess.run([command[0], "-c", program], timeout=50).returncode == 0
