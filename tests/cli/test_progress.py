"""Progress without a terminal: a line every few seconds, and one for every iteration."""

import time

import pytest

from stillmap.cli import console
from stillmap.core import profiling


@pytest.fixture
def lines(monkeypatch):
    """The lines printed so far, and a function that waits for a further one with certain words."""
    printed = []
    monkeypatch.setattr(console, "say", printed.append)
    monkeypatch.setattr(profiling, "is_terminal", lambda _: False)
    monkeypatch.setattr(profiling, "_LINE_PERIOD", 0.02)

    def another(wanted):
        before = len(printed)
        for _ in range(500):
            if any(wanted in line for line in printed[before:]):
                return next(line for line in printed[before:] if wanted in line)
            time.sleep(0.01)
        raise AssertionError(f"{wanted!r} was not printed: {printed}")

    return printed, another


def test_long_steps_are_reported_periodically(lines):
    printed, another = lines
    with console.show_progress(False, 6) as progress:
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
    count = len(printed)
    time.sleep(0.1)
    assert len(printed) == count


def test_short_iteration_is_reported_once(lines, monkeypatch):
    monkeypatch.setattr(profiling, "_LINE_PERIOD", 1000.0)
    printed, _ = lines
    with console.show_progress(False, 3) as progress:
        for iteration in (1, 2):
            for what in ("matching scans", "refining poses"):
                for done in range(1, 4):
                    progress(what, iteration, done, 3)
            progress("labelling beams", iteration, 0, 0)
    assert [line.split(":")[0] for line in printed] == [
        f"matching scans, iteration {k} of at most 3" for k in (1, 2)
    ]
    assert all("3 of 3 scans" in line and "left" not in line for line in printed)


def test_shares_are_per_cent(lines):
    _, another = lines
    with console.show_share(False, "reading") as show:
        show(0.5)
        another("reading: 50 %")


def test_quiet(lines):
    printed, _ = lines
    with console.show_progress(True, 3) as progress:
        progress("matching scans", 1, 3, 3)
        time.sleep(0.1)
    assert printed == []
