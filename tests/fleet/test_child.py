"""Child processes: measured, ended with their parent, stopped on order."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from fleets import is_alive, wait_until

from stillmap.fleet import child
from stillmap.fleet.child import Stopped, run_stillmap

BUSY = "import time; end = time.process_time() + 0.3\nwhile time.process_time() < end: pass"


@pytest.fixture
def python(monkeypatch):
    """The child runs a Python program instead of stillmap."""
    monkeypatch.setattr(child, "_STILLMAP", (sys.executable, "-S", "-c"))


@pytest.mark.usefixtures("python")
def test_cpu_time_and_peak_memory_are_its_own():
    ballast = bytearray(os.urandom(1 << 20) * 300)  # of this process, 300 MB
    ended = run_stillmap([f"x = b'1' * (50 << 20); x = x + x\n{BUSY}"])
    assert len(ballast) == 300 << 20
    assert ended.status == 0
    assert 0.3 <= ended.cpu_seconds < 1.5
    assert 100 << 20 < ended.peak_memory_bytes < 200 << 20


@pytest.mark.usefixtures("python")
def test_output_and_status():
    program = "import sys; print('out'); print('err', file=sys.stderr); sys.exit(2)"
    ended = run_stillmap([program])
    assert (ended.status, ended.stdout, ended.stderr) == (2, "out\n", "err\n")


@pytest.mark.usefixtures("python")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGSEGV])
def test_signal_that_ended_it(number):
    ended = run_stillmap([f"import os; os.kill(os.getpid(), {int(number)})"])
    assert ended.status == -number


@pytest.mark.usefixtures("python")
def test_much_output_does_not_block():
    ended = run_stillmap(["print('x' * (1 << 20))"])
    assert len(ended.stdout) == (1 << 20) + 1


SLEEP = "import os, time; open({path!r}, 'w').write(str(os.getpid())); time.sleep(60)"


def pid_in(path) -> int:
    wait_until(lambda: path.exists() and path.read_text())
    return int(path.read_text())


@pytest.mark.usefixtures("python")
def test_stopped_on_order(tmp_path):
    stop, path = threading.Event(), tmp_path / "pid"
    threading.Thread(target=lambda: (pid_in(path), stop.set())).start()
    started = time.monotonic()
    with pytest.raises(Stopped):
        run_stillmap([SLEEP.format(path=str(path))], stop)
    assert time.monotonic() - started < 10
    assert not is_alive(pid_in(path))


PARENT = """
import sys
from stillmap.fleet import child
child._STILLMAP = (sys.executable, "-S", "-c")
child.run_stillmap([sys.argv[1]])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere it takes a second")
def test_ends_with_its_parent(tmp_path):
    path = tmp_path / "pid"
    words = [sys.executable, "-c", PARENT, SLEEP.format(path=str(path))]
    with subprocess.Popen(words) as parent:
        pid = pid_in(path)
        assert is_alive(pid)
        parent.kill()
    wait_until(lambda: not is_alive(pid), 5)


@pytest.mark.usefixtures("python")
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere it takes a second")
def test_ends_with_its_supervisor(tmp_path):
    path, ended = tmp_path / "pid", []
    words = [SLEEP.format(path=str(path))]
    thread = threading.Thread(target=lambda: ended.append(run_stillmap(words)))
    thread.start()
    pid = pid_in(path)
    supervisor = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    os.kill(supervisor, signal.SIGKILL)
    thread.join(10)
    assert ended[0].status == -signal.SIGKILL
    wait_until(lambda: not is_alive(pid), 5)


def test_file_of_the_working_directory_is_no_module(tmp_path, monkeypatch):
    (tmp_path / "json.py").write_text("raise SystemExit('taken for a module')")
    (tmp_path / "stillmap.py").write_text("raise SystemExit('taken for a module')")
    monkeypatch.setenv("PYTHONPATH", str(Path(child.__file__).parents[2]))
    monkeypatch.chdir(tmp_path)
    ended = run_stillmap(["--version"])
    assert ended.status == 0
    assert ended.stdout.startswith("stillmap ")
