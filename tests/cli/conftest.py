"""Fixtures: the command as a process, and a small room to map."""

import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from rooms import drive_small_room

from stillmap.cli.main import main
from stillmap.sim import write_simulation

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def command() -> list[str]:
    """How to call stillmap."""
    return [sys.executable, "-m", "stillmap"]


@pytest.fixture(scope="session")
def stillmap(command: list[str]) -> Run:
    """Calls stillmap and waits for it."""

    def run(*words: object, **options: object) -> subprocess.CompletedProcess[str]:
        defaults = {"capture_output": True, "text": True, "timeout": 60}
        return subprocess.run([*command, *map(str, words)], **(defaults | options))

    return run


@pytest.fixture(scope="session")
def on_a_terminal(start: Callable[..., subprocess.Popen[str]]) -> Callable[..., tuple[int, str]]:
    """Runs stillmap with stderr on a terminal; Ctrl-C as soon as `send_at` shows.

    Gives the exit status and what was written there.
    """
    pty = pytest.importorskip("pty", reason="no terminals to be had here")

    def run(*words: object, send_at: bytes | None = None, **environment: str) -> tuple[int, str]:
        master, slave = pty.openpty()
        plain = {k: v for k, v in os.environ.items() if "COLOR" not in k}
        terminal = {"TERM": "xterm-256color", "COLUMNS": "100"}
        process = start(*words, stderr=slave, env=plain | terminal | environment)
        os.close(slave)
        seen = b""
        try:
            while select.select([master], [], [], 60)[0]:
                try:
                    piece = os.read(master, 4096)
                except OSError:  # Linux: the other end has been closed
                    break
                if not piece:
                    break
                seen += piece
                if send_at is not None and send_at in seen:
                    process.send_signal(signal.SIGINT)
                    send_at = None
            out, _ = process.communicate(timeout=60)
        finally:
            os.close(master)
            process.kill()
        assert out == ""
        return process.returncode, seen.decode()

    return run


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording folder: a room of 8 x 6 m with two people, 40 scans of 120 beams."""
    path = tmp_path_factory.mktemp("recording") / "room"
    write_simulation(drive_small_room(1, 120, 40), path)
    return path


@pytest.fixture(scope="session")
def mapped(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of mapping the room."""
    out = tmp_path_factory.mktemp("mapped") / "out"
    words = ("map", room, "-o", out, "--set", "em.max_iterations=2", "--quiet")
    assert main([*map(str, words)]) == 0
    return out


@pytest.fixture(scope="session")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with 1000 scans of 360 beams: an iteration takes long enough to be stopped in."""
    path = tmp_path_factory.mktemp("recording") / "hall"
    write_simulation(drive_small_room(1, 360, 1000), path)
    return path


@pytest.fixture
def nothing_left(tmp_path: Path) -> Callable[..., None]:
    """Checks that tmp_path holds these names alone: no temporary folder stayed behind."""

    def check(*names: str) -> None:
        assert sorted(os.listdir(tmp_path)) == sorted(names)

    return check
