"""What memory there is, the limit on it, and what is said when it is exceeded."""

import errno
import os
import resource
import subprocess
import sys

import pytest

from stillmap.core import memory
from stillmap.core.errors import InputError

needs_proc = pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="needs /proc")


def run(program, **options):
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, **options
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@needs_proc
def test_allocations_beyond_the_limit_fail_and_those_after_it_do_not():
    program = """
import numpy as np
from stillmap.core.memory import limit_memory
from stillmap._core import OccupancyGrid2D
def fits(n):
    try: np.ones(n); return True
    except MemoryError: return False
with limit_memory(400_000_000):
    print(fits(20_000_000), fits(100_000_000))
    try: OccupancyGrid2D(1.0).dense((0, 0), (10_000, 10_000)); print("made")
    except MemoryError: print("bad_alloc")
print(fits(60_000_000))
"""
    assert run(program) == ["True", "False", "bad_alloc", "True"]


@needs_proc
def test_mapped_files_do_not_count(tmp_path):
    program = f"""
import pathlib
from stillmap.core import arrays
from stillmap.core.memory import limit_memory
with limit_memory(150_000_000):
    found = arrays.empty((300_000_000,), "u1", pathlib.Path({str(tmp_path)!r}))
    print(len(found), found[::4096].sum())
"""
    assert run(program) == ["300000000", "0"]


def test_kernels_do_without_threads_that_cannot_start():
    program = """
import numpy as np
from stillmap import _core
grid = _core.OccupancyGrid2D(0.5)
n = 200_000
points = np.random.default_rng(0).uniform(-9, 9, (n, 2)).astype("f4")
offset, poses = np.arange(0, n + 1, 1000), np.tile(np.eye(3), (200, 1, 1))
_core.add_beams(grid, points, np.ones(n, bool), np.ones(n, "f4"), offset, poses, threads=4)
print(int(grid.dense()[1].sum()))
"""

    def no_room_for_stacks():
        resource.setrlimit(resource.RLIMIT_STACK, (8 << 30, resource.RLIM_INFINITY))
        resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30))

    if resource.getrlimit(resource.RLIMIT_STACK)[1] != resource.RLIM_INFINITY:
        pytest.skip("the size of stacks is limited")
    one = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
    assert run(program, preexec_fn=no_room_for_stacks, env={**os.environ, **one}) == ["200000"]


def test_what_runs_out_of_memory():
    for error in (
        MemoryError("bad_alloc"),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        RuntimeError("can't start new thread"),
    ):
        assert memory.is_out_of_memory(error)
    for error in (RuntimeError("other"), OSError(errno.ENOSPC, "full"), ValueError("odd")):
        assert not memory.is_out_of_memory(error)


def test_need_is_compared_with_what_is_allowed():
    with memory.limit_memory(10**9):
        memory.require_memory(0.9e9, "the map")
        with pytest.raises(InputError, match="the map takes at least 3 GB of memory, and 1 GB"):
            memory.require_memory(3e9, "the map", "smaller is better")
    memory.require_memory(1e6, "the map")
    with pytest.raises(InputError, match="GB may be used"):
        memory.require_memory(1e18, "the map")


def write_group(folder, files):
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(text)


@pytest.mark.parametrize(
    ("line", "place", "names"),
    [
        ("0::/jobs/one", "jobs", ("memory.max", "memory.current", "inactive_file")),
        (
            "4:cpu,memory:/jobs/one",
            "memory/jobs/one",
            ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        ),
    ],
)
def test_the_group_limits_what_is_available(tmp_path, monkeypatch, line, place, names):
    limit, used, cache = names
    stat = f"anon 1\n{cache} 30000000\n"
    write_group(tmp_path / place, {limit: "200000000", used: "80000000", "memory.stat": stat})
    write_group(tmp_path / "memory", {limit: "max"})
    (tmp_path / "groups").write_text(f"7:pids:/elsewhere\n{line}\n")
    monkeypatch.setattr(memory, "_GROUPS", tmp_path / "groups")
    monkeypatch.setattr(memory, "_CONTROL", tmp_path)
    assert memory.total_memory() == 200_000_000
    assert memory.available_memory() == 150_000_000


def test_strange_files_say_nothing(tmp_path, monkeypatch):
    (tmp_path / "groups").write_text("0\nx:y\n0::/../..\n")
    write_group(
        tmp_path, {"memory.max": "12", "memory.current": "?", "memory.stat": "inactive_file"}
    )
    monkeypatch.setattr(memory, "_GROUPS", tmp_path / "groups")
    monkeypatch.setattr(memory, "_CONTROL", tmp_path)
    assert memory.total_memory() == 12
    monkeypatch.setattr(memory, "_GROUPS", tmp_path / "none")
    assert memory.total_memory() > 1 << 28
    assert 1 << 24 < memory.available_memory() < 1 << 50


@needs_proc
def test_limits_of_the_process_count():
    program = """
import resource
resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))
from stillmap.core.memory import available_memory
print(1 << 30 < available_memory() < 2 << 30)
"""
    assert run(program) == ["True"]


@needs_proc
def test_what_a_process_uses_already_is_allowed_to_it():
    program = """
import resource
import numpy as np
from stillmap.core.memory import default_memory, limit_memory
used = np.ones(100_000_000)  # 0.8 GB
data = resource.getrlimit(resource.RLIMIT_DATA)
resource.setrlimit(resource.RLIMIT_DATA, (1_700_000_000, data[1]))
with limit_memory(default_memory()):
    print(np.ones(40_000_000).sum())
"""
    assert run(program) == ["40000000.0"]
