"""Output on a terminal: colors, progress bar, cursor."""

import io
import re
import time

import pytest
from maps import ENDLESS

from stillmap.cli import console
from stillmap.cli.console import colorize, show_progress, show_share, uses_color
from stillmap.core import profiling

VARIABLES = ("NO_COLOR", "FORCE_COLOR", "TERM")
RED, PLAIN = "\x1b[1;31m", "\x1b[0m"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("environment", "on_terminal", "elsewhere"),
    [
        ({}, True, False),
        ({"TERM": "xterm"}, True, False),
        ({"TERM": "dumb"}, False, False),
        ({"NO_COLOR": "1"}, False, False),
        ({"NO_COLOR": "0"}, False, False),  # any value but the empty one
        ({"NO_COLOR": ""}, True, False),
        ({"FORCE_COLOR": "1"}, True, True),
        ({"FORCE_COLOR": "1", "TERM": "dumb"}, True, True),
        ({"FORCE_COLOR": "1", "NO_COLOR": "1"}, False, False),
    ],
)
def test_uses_color(monkeypatch, environment, on_terminal, elsewhere):
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert uses_color(Terminal()) == on_terminal
    assert uses_color(io.StringIO()) == elsewhere
    assert colorize("no", "error", Terminal()) == (f"{RED}no{PLAIN}" if on_terminal else "no")


@pytest.mark.parametrize(
    ("words", "prefix"), [(("info", "nowhere"), "stillmap:"), (("map",), "stillmap map:")]
)
def test_errors_are_red_on_a_terminal(on_a_terminal, words, prefix):
    status, coloured_line = on_a_terminal(*words)
    _, plain_line = on_a_terminal(*words, NO_COLOR="1")
    assert status == 2
    assert coloured_line.startswith(f"{RED}{prefix}{PLAIN} ")
    assert "\x1b" not in plain_line
    assert coloured_line.replace(RED, "").replace(PLAIN, "") == plain_line


def test_dumb_terminal_gets_lines(on_a_terminal, room, tmp_path):
    words = ("map", room, "--no-odometry", "--set", "em.max_iterations=1")
    _, written = on_a_terminal(*words, "-o", tmp_path / "b", TERM="dumb")
    assert "\x1b" not in written
    assert "stillmap: note: no odometry" in written
    assert "stillmap: matching scans, iteration 1/1" in written


def test_bar_below_log_messages_is_removed_at_the_end(on_a_terminal, room, tmp_path):
    words = ("-v", "map", room, "-o", tmp_path / "out", "--set", "em.max_iterations=2")
    status, written = on_a_terminal(*words)
    assert status == 0
    assert "iteration 1/2" in written
    assert "/40" in written
    assert written.count("\x1b[?25l") == written.count("\x1b[?25h") > 0  # the cursor came back
    lines = [line.rpartition("\x1b[2K")[2] for line in written.splitlines()]
    assert any(line.startswith("stillmap: iteration 1: bound") for line in lines), lines
    assert "report.html" in lines[-2]


@pytest.mark.parametrize("columns", [80, 120])
def test_progress_fits_the_terminal(monkeypatch, columns):
    written = Terminal()
    monkeypatch.setattr("sys.stderr", written)
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    with show_share(False, "reading") as share:
        share(0.5)
    with show_progress(False, 6) as progress:
        for what, iteration in (("matching scans", 2), ("modelling moving objects", 0)):
            for done in (1, 654321, 987654):
                progress(what, iteration, done, 987654)
    shown = re.sub(r"\x1b\[[?\d;]*[A-Za-z]", "", written.getvalue())
    assert max(len(line) for line in re.split(r"[\r\n]", shown)) <= columns
    assert "…" not in shown  # of texts that are cut off
    for text in ("reading", "50 %", "matching scans", "modelling moving objects", "987654/987654"):
        assert text in shown


@pytest.fixture
def lines(monkeypatch):
    """The lines that are printed where there is no terminal."""
    printed = []
    monkeypatch.setattr(console, "say", printed.append)
    monkeypatch.setattr(profiling, "is_terminal", lambda _: False)
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    return printed


def test_lines_of_long_steps(lines, monkeypatch):
    monkeypatch.setattr(profiling, "_LINE_PERIOD", 0.0)
    with console.show_progress(False, 6) as progress:
        progress("matching scans", 1, 20, 80)
        progress("choosing pictures", 0, 3, 12)
        progress("labelling beams", 1, 0, 0)
    with show_share(False, "reading") as share:
        share(0.5)
    with console.show_progress(True, 3) as progress:
        progress("unheard", 1, 3, 3)
    assert re.fullmatch(
        r"matching scans, iteration 1/6: 20 of 80 scans, \d+/s, \d+ s left", lines[0]
    )
    assert re.fullmatch(r"choosing pictures: 3 of 12, \d+ s left", lines[1])
    assert lines[2:] == ["labelling beams, iteration 1/6: begins", "reading: 50 %"]


def test_silent_steps_are_named_again(lines, monkeypatch):
    def wait(count):
        deadline = time.monotonic() + 20.0
        while len(lines) < count and time.monotonic() < deadline:
            time.sleep(0.01)

    monkeypatch.setattr(profiling, "_SILENT_PERIOD", 0.05)
    with show_share(False, "reading"):
        wait(1)
    assert re.fullmatch(r"reading: \d+ s so far", lines[0])
    lines.clear()
    with console.show_progress(False, 2) as progress:
        progress("labelling beams", 1, 0, 0)
        wait(1)
    assert re.fullmatch(r"labelling beams, iteration 1/2: \d+ s so far", lines[0])


def test_short_iteration_is_reported_once(lines):
    with console.show_progress(False, 3) as progress:
        for iteration in (1, 2):
            for what in ("matching scans", "refining poses"):
                for done in range(1, 4):
                    progress(what, iteration, done, 3)
            progress("labelling beams", iteration, 0, 0)
    starts = [line.partition(": 3 of 3 scans")[0] for line in lines]
    assert starts == [f"matching scans, iteration {k}/3" for k in (1, 2)]


def test_ctrl_c_before_anything_is_finished(call, room, tmp_path, nothing_left, monkeypatch):
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("stillmap.cli.map_run.map_recording", stop)
    done = call("map", room, "-o", tmp_path / "out")
    assert done.returncode == 130
    assert "nothing was written, and there is nothing to resume" in done.stderr
    nothing_left()


@pytest.mark.slow
def test_ctrl_c_restores_the_cursor(on_a_terminal, hall, tmp_path, nothing_left):
    status, written = on_a_terminal(
        "map", hall, "-o", tmp_path / "out", *ENDLESS, send_at=b"iteration 2/"
    )
    assert status == 130
    assert written.count("\x1b[?25l") == written.count("\x1b[?25h") > 0
    told, ended = (line.rpartition("\x1b[2K")[2] for line in written.splitlines()[-2:])
    assert told.startswith("stillmap: continue after iteration ")
    assert told.endswith(" --resume")
    assert ended.startswith("stillmap: interrupted")
    nothing_left(".out.resume")
