"""Reading opens the input and nothing else: no other file, no socket, no process."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

for needed in ("pye57", "laspy", "lazrs", "lzf"):
    pytest.importorskip(needed)

SCRIPT = Path(__file__).resolve().parent / "read_alone.py"


def test_readers_open_their_input_alone(tmp_path):
    command = [sys.executable, SCRIPT, tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode != -signal.SIGSYS, "a library opened a socket"
    said = done.stdout.splitlines()
    assert [line for line in said if line.startswith(("open", "socket", "a schema", "sub"))] == []
    assert said[-1] == "all read", done.stderr
