"""Whatever a recording holds, a run maps it or refuses it in one line, within bounds of memory and
time; what it writes is whole, and of numbers."""

import dataclasses
import os
import resource
import signal
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest
from finite_files import require_finite
from hypothesis import HealthCheck, given, settings
from odd_recordings import odd_recordings, to_recording, write, write_poses

import stillmap
from stillmap.cli.main import main

_MEMORY = 1 << 30  # bytes more than before a run
_SECONDS, _SECONDS_PER_BEAM = 20.0, 2e-4  # of processor time; a beam may cross 1600 cells
# the system's own peak of a process holds that of the process which started it
_PROCESS = """
import sys
from pathlib import Path
from stillmap.cli.main import main
status = main(sys.argv[2:])
Path(sys.argv[1]).write_text(Path("/proc/self/status").read_text())
sys.exit(status)
"""
_OPTIONS = ["--threads", "1", "--quiet"]
# what is done with a result, and endings of what is written
_BOTH = (
    ("filter {out} --to stillmap", ""),
    ("convert {path} --to stillmap", ""),
    *(("convert {out}", end) for end in (".mcap", ".bag")),
    ("convert {out} --to nav2", ""),
    ("merge {out} {path} --threads 1", ""),
    ("live --replay {path} --threads 1", ""),
)
_FURTHER = {
    2: (*_BOTH, ("convert {out}", ".parquet"), ("filter {out}", ".log")),
    3: (*_BOTH, *(("convert {out}", end) for end in (".ply", ".las", ".e57", ".xyz"))),
}


def runs(count):
    """So many examples, the same every time."""
    return settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


def read_status(text, name):
    """Bytes, of a line of the status of a process."""
    return 1024 * int(text.partition(f"{name}:")[2].split()[0])


class TooSlow(BaseException):
    """A run takes longer than it may."""


@contextmanager
def bounds(n_beams):
    """Limits what a run takes of memory and time."""
    now = read_status(Path("/proc/self/status").read_text(), "VmData")
    before = resource.getrlimit(resource.RLIMIT_DATA)

    def stop(*_):
        raise TooSlow

    handler = signal.signal(signal.SIGPROF, stop)
    # unlike RLIMIT_AS it leaves room for the stack, without which the process would be killed
    resource.setrlimit(resource.RLIMIT_DATA, (now + _MEMORY, before[1]))
    signal.setitimer(signal.ITIMER_PROF, _SECONDS + _SECONDS_PER_BEAM * n_beams)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, handler)
        resource.setrlimit(resource.RLIMIT_DATA, before)


def run_in_python(one, folder):
    try:
        recording = to_recording(one)
    except ValueError:
        return
    try:
        options = {"threads": 1, "estimator": estimator_of(one.words)}
        result = stillmap.build(recording, options, poses=one.poses, scratch=folder)
    except ValueError as error:
        if not str(error).startswith("poses: expected"):
            raise
        return
    except stillmap.InputError:
        return
    result.save(folder / "map")
    require_finite(folder / "map")
    saved = stillmap.load(folder / "map", recording=recording)
    assert saved.stamp_ns.tolist() == recording.stamp_ns.tolist()
    repr(result), result._repr_html_(), repr(saved)


def estimator_of(words):
    if "--paper" in words:
        return "paper"
    return words[-1] if "--estimator" in words else "stillmap"


def run_commands(one, folder, said):
    path, out = write(one, folder), folder / "map"
    words = ["map", str(path), "-o", str(out), *_OPTIONS, *one.words]
    if one.poses is not None:
        write_poses(one, folder / "odd.tum")
        words += ["--poses", str(folder / "odd.tum")]
    if succeeds(words, said):
        require_finite(out)
        known = _FURTHER[one.dimension]
        for number in one.then:
            more, end = known[number % len(known)]
            further = [word.format(path=path, out=out) for word in more.split()]
            succeeds(
                [*further, "-o", str(folder / f"{number}{end}"), "--overwrite", "--quiet"], said
            )


def succeeds(words, said):
    """Runs a command: it ends well, or refuses in one line and leaves nothing."""
    output = Path(words[words.index("-o") + 1])
    said.readouterr()
    status = main(words)
    text = said.readouterr().err
    assert status in (0, 2), text
    if status == 0:
        assert output.exists()
        return True
    assert not output.exists()
    assert "memory" not in text, text
    assert "is not the recording that was mapped" not in text, text
    assert [line for line in text.splitlines() if not line.startswith("warning")][1:] == [], text
    return False


def require_run(one, said):
    with tempfile.TemporaryDirectory() as name, bounds(len(one.ranges)):
        if one.form == "arrays":
            run_in_python(one, Path(name))
        else:
            run_commands(one, Path(name), said)
        assert [e.name for e in Path(name).glob(".*") if not e.name.endswith(".resume")] == []


@runs(25)
@given(one=odd_recordings())
def test_odd_recordings(one, capsys):
    require_run(one, capsys)


@pytest.mark.slow
@runs(600)
@given(one=odd_recordings())
def test_many_odd_recordings(one, capsys):
    require_run(one, capsys)


@runs(4)
@given(one=odd_recordings())
def test_as_a_process(one):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if one.form == "arrays":
            one = dataclasses.replace(one, form="folder")
        words = ["map", str(write(one, folder)), "-o", str(folder / "map"), *_OPTIONS]
        process = subprocess.Popen(
            [sys.executable, "-c", _PROCESS, str(folder / "status"), *words],
            stderr=subprocess.PIPE,
            text=True,
        )
        with process.stderr as stream:
            text = stream.read()
        _, state, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(state)
        assert process.returncode in (0, 2), text
        assert (folder / "map").exists() == (process.returncode == 0)
        assert len(text.splitlines()) == (process.returncode == 2), text
        assert read_status((folder / "status").read_text(), "VmHWM") < _MEMORY
        assert used.ru_utime + used.ru_stime < _SECONDS + _SECONDS_PER_BEAM * len(one.ranges)
