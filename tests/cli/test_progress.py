"""Progress without a terminal."""

import time

import pytest

from stillmap.cli import console as module
from stillmap.cli.console import show_progress


@pytest.fixture
def lines(monkeypatch):
    """What is said, and a function that waits for the next line."""
    said = []
    monkeypatch.setattr(module, "say", said.append)
    monkeypatch.setattr(module, "is_terminal", lambda _: False)
    monkeypatch.setattr(module, "_LINE_PERIOD", 0.02)

    def another(wanted):
        before = len(said)
        for _ in range(500):
            if any(wanted in line for line in said[before:]):
                return next(line for line in said[before:] if wanted in line)
            time.sleep(0.01)
        raise AssertionError(f"{wanted!r} was not said: {said}")

    return said, another


def test_long_steps_are_reported_periodically(lines):
    said, another = lines
    with show_progress(False, 6) as progress:
        assert another("preparing: ").endswith("s so far")
        progress("matching scans", 1, 20, 80)
        assert "matching scans, iteration 1 of at most 6: 20 of 80 scans, " in another("20 of 80")
        assert another("20 of 80").endswith("s left")
        progress("labelling beams", 1, 0, 0)
        another("labelling beams, iteration 1 of at most 6: 0 s so far")
        progress("choosing pictures", 0, 3, 12)
        line = another("choosing pictures")
        assert line.startswith("choosing pictures: 3 of 12, ")
        assert line.endswith("s left")
        assert "scans" not in line
        assert "/s" not in line
        progress("writing", 0, 0, 0)
        assert another("writing").startswith("writing: ")
    count = len(said)
    time.sleep(0.1)
    assert len(said) == count


def test_short_iteration_is_reported_once(lines, monkeypatch):
    monkeypatch.setattr(module, "_LINE_PERIOD", 1000.0)
    said, _ = lines
    with show_progress(False, 3) as progress:
        for iteration in (1, 2):
            for what in ("matching scans", "refining poses"):
                for done in range(1, 4):
                    progress(what, iteration, done, 3)
            progress("labelling beams", iteration, 0, 0)
    assert [line.split(":")[0] for line in said] == [
        "matching scans, iteration 1 of at most 3",
        "matching scans, iteration 2 of at most 3",
    ]
    assert all("3 of 3 scans" in line and "left" not in line for line in said)


def test_quiet(lines):
    said, _ = lines
    with show_progress(True, 3) as progress:
        progress("matching scans", 1, 3, 3)
        time.sleep(0.1)
    assert said == []
