"""`stillmap map --resume`: the result equals that of an uninterrupted run to the bit."""

import errno
import fcntl
import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from result_contents import contents

from stillmap.cli.main import main
from stillmap.core import array_folder
from stillmap.pipeline import checkpoint, result
from stillmap.pipeline.em_loop import iterate
from stillmap.results import writer

WORDS = ("--set", "em.max_iterations=4", "--set", "em.patience=9", "--set", "em.tolerance=0")
WORDS += ("--set", "em.label_tolerance=0", "--threads", "1")
ALL = 4  # iterations


@pytest.fixture(scope="module")
def whole(room, tmp_path_factory) -> Path:
    """What a run writes that nobody interrupts."""
    out = tmp_path_factory.mktemp("whole") / "out"
    assert main(["map", str(room), "-o", str(out), "--quiet", *WORDS]) == 0
    assert os.listdir(out.parent) == ["out"]
    assert len(json.loads((out / "run.json").read_text())["iterations"]) == ALL
    return out


@pytest.fixture
def stop_after(monkeypatch):
    """Ctrl-C after so many iterations of this process."""

    def stop(number: int) -> None:
        def stopped(*args, **how):
            for n, iteration in enumerate(iterate(*args, **how)):
                if n == number:
                    raise KeyboardInterrupt
                yield iteration

        monkeypatch.setattr(result, "iterate", stopped if number < ALL else iterate)

    return stop


def test_the_command_that_is_told_continues(call, room, tmp_path, stop_after, whole):
    """The result equals that of an uninterrupted run."""
    stop_after(2)
    out = tmp_path / "the map"
    stopped = call("map", room, "-o", out, "--overwrite", *WORDS)
    told = stopped.stderr.partition("continue after iteration 2: stillmap ")[2].partition("\n")[0]
    assert "--overwrite" not in told
    stop_after(ALL)
    done = call(*shlex.split(told))
    assert done.returncode == 0, done.stderr
    assert "continues after iteration 2" in done.stderr
    assert contents(out) == contents(whole)
    assert os.listdir(tmp_path) == ["the map"]


@pytest.fixture
def interrupted(call, room, tmp_path, stop_after):
    """The checkpoint folder of a run that was stopped after two iterations."""
    stop_after(2)
    done = call("map", room, "-o", tmp_path / "out", *WORDS)
    assert done.returncode == 130
    assert "--resume" in done.stderr
    assert os.listdir(tmp_path) == [".out.resume"]
    stop_after(ALL)
    return tmp_path / ".out.resume"


def test_repeated_interruptions(call, room, tmp_path, stop_after, whole):
    stop_after(1)
    for _ in range(ALL - 1):
        done = call("map", room, "-o", tmp_path / "out", "--resume", *WORDS)
        assert done.returncode == 130
    stop_after(ALL)
    assert call("map", room, "-o", tmp_path / "out", "--resume", *WORDS).returncode == 0
    assert contents(tmp_path / "out") == contents(whole)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["paper", "tracker", "hit-ratio"])
def test_other_estimators(call, room, tmp_path, stop_after, estimator):
    words = ("--estimator", estimator, *WORDS)
    assert call("map", room, "-o", tmp_path / "whole", *words).returncode == 0
    stop_after(1)
    call("map", room, "-o", tmp_path / "out", *words)
    stop_after(ALL)
    assert call("map", room, "-o", tmp_path / "out", "--resume", *words).returncode == 0
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_given_poses(call, room, tmp_path, stop_after):
    words = ("--poses", room / "truth/trajectory.tum", *WORDS)
    stop_after(1)
    assert call("map", room, "-o", tmp_path / "out", *words).returncode == 130
    stop_after(ALL)
    done = call("map", room, "-o", tmp_path / "out", "--resume", *WORDS)
    refused(done, "another recording, odometry or poses")
    assert call("map", room, "-o", tmp_path / "out", "--resume", *words).returncode == 0


def test_nothing_to_resume(call, room, tmp_path, whole):
    assert call("map", room, "-o", tmp_path / "out", "--resume", *WORDS).returncode == 0
    assert contents(tmp_path / "out") == contents(whole)
    # and once more over its own result
    assert call("map", room, "-o", tmp_path / "out", "--resume", *WORDS).returncode == 0
    assert contents(tmp_path / "out") == contents(whole)


def test_without_resume_starts_anew(call, room, tmp_path, interrupted, whole):
    done = call("map", room, "-o", tmp_path / "out", *WORDS)
    assert done.returncode == 0
    assert "starts anew" in done.stderr
    assert not interrupted.exists()
    assert contents(tmp_path / "out") == contents(whole)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--set", "em.prior=0.8"), "em.prior was 0.9, is 0.8"),
        (("--resolution", "0.1"), "slam.resolution was 0.05, is 0.1"),
        (("--no-odometry",), "another recording, odometry or poses"),
    ],
)
def test_other_options_are_refused_by_name(call, room, tmp_path, interrupted, words, named):
    done = call("map", room, "-o", tmp_path / "out", "--resume", *WORDS, *words)
    refused(done, named)
    assert (interrupted / "iteration-2/checkpoint.json").exists()


def test_another_recording_is_refused(call, room, tmp_path, interrupted):
    other = tmp_path / "other"
    shutil.copytree(room, other)
    points = np.load(other / "points.npy")
    points[77] += 0.01
    np.save(other / "points.npy", points)
    done = call("map", other, "-o", tmp_path / "out", "--resume", *WORDS)
    refused(done, "another recording")
    assert interrupted.exists()


def test_result_of_another_recording_is_not_replaced(call, room, tmp_path, whole):
    out, other = tmp_path / "out", tmp_path / "other"
    shutil.copytree(whole, out)
    shutil.copytree(room, other)
    hit = np.load(other / "hit.npy")
    hit[77] = not hit[77]
    np.save(other / "hit.npy", hit)
    done = call("map", other, "-o", out, "--resume", *WORDS)
    refused(done, f"{out}: holds the result of another recording", "--overwrite")
    assert contents(out) == contents(whole)
    shutil.copytree(room, tmp_path / "room")  # the same one elsewhere
    assert call("map", tmp_path / "room", "-o", out, "--resume", *WORDS).returncode == 0


def test_moved_recording_resumes_with_other_threads(call, room, tmp_path, interrupted, whole):
    shutil.copytree(room, tmp_path / "room")
    words = (*WORDS[:-1], "2")
    done = call("map", tmp_path / "room", "-o", tmp_path / "out", "--resume", *words)
    assert "continues after iteration 2" in done.stderr
    assert not interrupted.exists()
    mine, theirs = contents(tmp_path / "out"), contents(whole)
    differ = {name for name in theirs if mine[name] != theirs[name]}
    assert differ <= {"run.json", "report.html"}  # they name the recording and the threads


@pytest.mark.parametrize("name", ["checkpoint.json", "0.npy", "1.npy"])
def test_damaged_checkpoint_is_named(call, room, tmp_path, interrupted, name):
    path = interrupted / "iteration-2" / name
    path.write_bytes(path.read_bytes()[:-7])
    done = call("map", room, "-o", tmp_path / "out", "--resume", *WORDS)
    refused(done, f"iteration-2/{name}")
    assert call("map", room, "-o", tmp_path / "out", *WORDS).returncode == 0


def test_objects_in_a_checkpoint_are_refused(call, room, tmp_path, interrupted):
    """Their bytes would be taken for addresses in memory."""
    folder = interrupted / "iteration-2"
    record = json.loads((folder / "checkpoint.json").read_text())
    packed, *arrays = (np.load(folder / f"{number}.npy") for number in range(record["arrays"]))
    assert b"<f8" in packed.tobytes()
    packed = np.frombuffer(packed.tobytes().replace(b"<f8", b"|O8"), np.uint8)
    np.save(folder / "0.npy", packed)
    record["digest"] = checkpoint._digest(packed, *arrays)
    (folder / "checkpoint.json").write_text(json.dumps(record))
    done = call("map", room, "-o", tmp_path / "out", "--resume", *WORDS)
    refused(done, "checkpoint.json: is damaged", "OBJECT array")


def test_concurrent_runs_into_one_folder(call, room, tmp_path, interrupted):
    with (interrupted / "lock").open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        done = call("map", room, "-o", tmp_path / "out", "--resume", *WORDS)
    refused(done, "another run")
    assert (interrupted / "iteration-2").exists()


class _Full:
    """Writes until the disk is full."""

    def __init__(self, write, after: int) -> None:
        self._write, self._left = write, after

    def __call__(self, path, *more) -> None:
        self._left -= 1
        if self._left < 0:
            path.write_bytes(b"half of it")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        self._write(path, *more)


@pytest.mark.parametrize("after", [0, 1])
def test_full_disk_keeps_previous_checkpoint(
    call, room, tmp_path, interrupted, whole, monkeypatch, after
):
    with monkeypatch.context() as here:
        here.setattr(array_folder, "write_npy", _Full(array_folder.write_npy, after))
        done = call("map", room, "-o", tmp_path / "out", "--resume", "--quiet", *WORDS)
    refused(done, "No space left")
    assert sorted(os.listdir(interrupted)) == ["iteration-2", "lock"]
    assert call("map", room, "-o", tmp_path / "out", "--resume", *WORDS).returncode == 0
    assert contents(tmp_path / "out") == contents(whole)


def test_full_disk_keeps_earlier_result(call, room, tmp_path, whole, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()
    (out / "run.json").write_text("old")
    with monkeypatch.context() as here:
        here.setattr(writer, "write_labels", _Full(writer.write_labels, 0))
        done = call("map", room, "-o", out, "--overwrite", "--quiet", *WORDS)
    refused(done, "No space left")
    assert os.listdir(out) == ["run.json"]
    assert sorted(os.listdir(tmp_path / ".out.resume")) == [f"iteration-{ALL}", "lock"]
    assert call("map", room, "-o", out, "--resume", *WORDS).returncode == 0
    assert contents(out) == contents(whole)


@pytest.mark.slow
def test_resume_after_kill(start, room, tmp_path, whole):
    rng = random.Random(3)
    for _ in range(6):
        process = start("map", room, "-o", tmp_path / "out", "--resume", "--quiet", *WORDS)
        try:
            process.wait(rng.uniform(0.3, 4.0))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
        process.communicate()
    for work in tmp_path.glob(".out.*.part"):  # of one killed while it saved: as if long ago
        for entry in (work, *work.rglob("*")):
            os.utime(entry, (0, 0))
    process = start("map", room, "-o", tmp_path / "out", "--resume", *WORDS)
    begun = time.monotonic()
    _, err = process.communicate()
    assert process.returncode == 0, (err, time.monotonic() - begun)
    assert contents(tmp_path / "out") == contents(whole)
    assert os.listdir(tmp_path) == ["out"]
