"""Fixtures: small recordings, results made by hand, a stand-in for stillmap, S3, Dask."""

import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import distributed
import pytest
import stand_in as stand_ins
from fleet_processes import NAMES, wait_until
from result_contents import contents
from rooms import drive_small_room

from stillmap.cli.main import main
from stillmap.sim import write_simulation


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three recordings: a room of 8 x 6 m, 40 scans of 120 beams each."""
    folder = tmp_path_factory.mktemp("recordings")
    for seed, name in enumerate(NAMES):
        write_simulation(drive_small_room(seed, 120, 40), folder / name)
    return folder


@pytest.fixture(scope="session")
def by_hand(
    recordings: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, dict[str, bytes]]:
    """What `stillmap map` writes for each of the recordings."""
    folder = tmp_path_factory.mktemp("by-hand")
    for name in NAMES:
        words = ["map", recordings / name, "-o", folder / name, "--quiet", "--threads", "1"]
        assert main([*map(str, words)]) == 0
    return {name: contents(folder / name) for name in NAMES}


@pytest.fixture(scope="session")
def workers() -> Iterator[str]:
    """Two workers in this process; the address of their scheduler."""
    settings = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
    with distributed.LocalCluster(processes=False, memory_limit=None, **settings) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def stand_in(workers: str, monkeypatch: pytest.MonkeyPatch, call) -> Callable[..., Any]:
    """Calls `stillmap fleet` on workers that run `stand_in.py` instead of stillmap."""
    monkeypatch.setattr("stillmap.cli.fleet.run_command", stand_ins.run_command)

    def run(*words: object) -> subprocess.CompletedProcess[str]:
        return call("fleet", *words, "--scheduler", workers)

    return run


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    """A real S3 server of this machine; its address."""
    pytest.importorskip("moto")
    pytest.importorskip("s3fs")
    port = free_port()
    words = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        wait_until(lambda: _answers(port))
        yield f"http://127.0.0.1:{port}"
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def s3_environment(s3_server: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The usual variables, for the server of this machine; temporary files in `tmp_path/tmp`."""
    (tmp_path / "tmp").mkdir()
    for name, value in {
        "AWS_ENDPOINT_URL": s3_server,
        "AWS_ACCESS_KEY_ID": "robot",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
        "TMPDIR": str(tmp_path / "tmp"),
    }.items():
        monkeypatch.setenv(name, value)


def _answers(port: int) -> bool:
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0
