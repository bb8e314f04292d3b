"""Settings and fixtures of all tests; tests/reference, tests/marks.py, benchmarks and the helpers
beside the tests of a room can be imported."""

import gc
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

with suppress(ImportError):  # not where the tests of ROS run
    from hypothesis import HealthCheck, settings

    # a busy machine makes examples slowly, and takes long for each
    patient = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
    settings.register_profile("patient", patient)
    settings.load_profile("patient")
# thousands of collected tests are alive: walking them at every collection costs 8 % of the time
gc.set_threshold(50_000, 50, 50)
TESTS = Path(__file__).resolve().parent
# helpers have names of their own; those of tests/ros stand in for packages of ROS: not for all
_WITH_HELPERS = (
    *("agreement", "benchmarks", "cli", "contract", "em", "faults", "fleet", "fuzz", "io/ros"),
    *("live", "mapping", "mesh/objects", "mesh/texture", "pipeline", "places", "slam", "tracking"),
    *("viewer", "whole_runs"),
)
sys.path[:0] = [str(TESTS / room) for room in _WITH_HELPERS]
sys.path += [str(TESTS), str(TESTS.parent / "benchmarks")]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real recordings with references, which lie beside the checkout where there are any."""
    path = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not path.is_dir():
        pytest.skip("no folder of real recordings beside the checkout (../shared/data)")
    return path


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Calls stillmap within this process."""
    from stillmap.cli.main import main

    def run(*words: object) -> subprocess.CompletedProcess[str]:
        arguments = [str(word) for word in words]
        return subprocess.CompletedProcess(arguments, main(arguments), *capsys.readouterr())

    return run


@pytest.fixture(scope="session")
def start() -> Callable[..., subprocess.Popen[str]]:
    """Starts stillmap, which hears Ctrl-C even where the tests themselves do not."""

    def popen(*words: object, **options: object) -> subprocess.Popen[str]:
        before = signal.signal(signal.SIGINT, signal.SIG_DFL)  # a child inherits it when ignored
        try:
            defaults = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
            command = [sys.executable, "-m", "stillmap", *map(str, words)]
            return subprocess.Popen(command, **(defaults | options))
        finally:
            signal.signal(signal.SIGINT, before)

    return popen


@pytest.fixture
def limit_files() -> Iterator[Callable[[int | None], None]]:
    """Limits the bytes of each file that is written to, as a disk does that is full (the error is
    EFBIG instead of ENOSPC); None: no longer."""
    before, most = resource.getrlimit(resource.RLIMIT_FSIZE)

    def limit(size: int | None) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (before if size is None else size, most))

    yield limit
    limit(None)


@pytest.fixture(scope="session")
def flat_days(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flat on three days: recordings `day1`, `day2`, `day3`, their results `map1`, ..."""
    from flat import map_days

    folder = tmp_path_factory.mktemp("flat")
    map_days(folder)
    return folder


@pytest.fixture(scope="session")
def flat_place(flat_days: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The place of `map1` and `map2`; not to be changed."""
    from flat import OPTIONS

    import stillmap

    out = tmp_path_factory.mktemp("flat-place") / "place"
    stillmap.merge([flat_days / "map1", flat_days / "map2"], options=OPTIONS, output=out)
    return out
