"""Returns far from all others take little memory: what is seen counts, not the space around it."""

import subprocess
import sys

PER_RETURN = 2000  # bytes; whole blocks of cells around each would take twice as much
SCRIPT = """
from pathlib import Path
import numpy as np
import stillmap
from stillmap.em import EmOptions
from stillmap.em.observations import collect_observations

def peak():
    return 1024 * int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0])

def observe(n):
    rng = np.random.default_rng(0)
    points = rng.uniform(-500.0, 500.0, (n, 3))
    recording = stillmap.Recording.from_clouds([0, 10**8], [points[: n // 2], points[n // 2 :]])
    poses = np.tile(np.eye(4), (2, 1, 1))
    return collect_observations(recording, poses, 0.15, EmOptions(), 1, with_surroundings=True)

observe(100)
before = peak()
found = observe(20_000)
assert found.surfel_map.size == 20_000
print((peak() - before) // 20_000)
"""


def test_memory_of_isolated_returns():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < PER_RETURN
