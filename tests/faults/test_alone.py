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


def test_a_socket_ends_the_process():
    code = """
import socket, sys
sys.path.append(sys.argv[1])
from read_alone import forbid_sockets
if not forbid_sockets():
    sys.exit(7)
socket.socket()
"""
    command = [sys.executable, "-c", code, SCRIPT.parent]
    done = subprocess.run(command, capture_output=True, check=False, timeout=60)
    if done.returncode == 7:
        pytest.skip("this kernel does not let a process forbid itself sockets")
    assert done.returncode == -signal.SIGSYS
