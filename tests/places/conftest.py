"""Two sessions of a simulated hall, and what is merged from them."""

from pathlib import Path

import pytest

from stillmap.cli.main import main


@pytest.fixture(scope="session")
def days(tmp_path_factory) -> Path:
    """A folder with three short sessions of an office, mapped: out-1, out-2, out-3."""
    folder = tmp_path_factory.mktemp("days")
    words = ["simulate", "hall", "-o", str(folder / "sim"), "--sessions", "3", "--scans", "200"]
    assert main([*words, "--seed", "5", "--quiet"]) == 0
    for k in (1, 2, 3):
        session = folder / "sim" / f"session-{k}"
        words = ["map", str(session), "-o", str(folder / f"out-{k}"), "--quiet", "--threads", "1"]
        assert main(words) == 0
    return folder


@pytest.fixture(scope="session")
def place(days) -> Path:
    """The place of all three."""
    results = [str(days / f"out-{k}") for k in (1, 2, 3)]
    assert main(["merge", *results, "-o", str(days / "place"), "--quiet", "--threads", "1"]) == 0
    return days / "place"
