"""Colours: on terminals that want them, nowhere else; the words are the same."""

import io

import pytest

from stillmap.cli.terminal import coloured, is_terminal, painted

VARIABLES = ("NO_COLOR", "FORCE_COLOR", "CLICOLOR_FORCE", "TERM")
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
        ({"CLICOLOR_FORCE": "1"}, True, True),
        ({"CLICOLOR_FORCE": "0"}, True, False),
        ({"FORCE_COLOR": "1", "NO_COLOR": "1"}, False, False),
    ],
)
def test_who_gets_colours(monkeypatch, environment, on_terminal, elsewhere):
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert coloured(Terminal()) == on_terminal
    assert coloured(io.StringIO()) == elsewhere
    assert painted("no", "error", Terminal()) == (f"{RED}no{PLAIN}" if on_terminal else "no")


def test_a_stream_that_was_closed_is_no_terminal():
    assert not is_terminal(None)
    assert painted("no", "error", None) == "no"


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


def test_errors_are_plain_elsewhere(stillmap):
    assert "\x1b" not in stillmap("info", "nowhere").stderr


def test_warnings_are_marked_and_a_dumb_terminal_gets_lines(on_a_terminal, room, tmp_path):
    words = ("map", room, "--no-odometry", "--set", "em.max_iterations=1")
    _, written = on_a_terminal(*words, "-o", tmp_path / "a")
    assert "stillmap: \x1b[33mwarning:\x1b[0m no odometry" in written
    _, written = on_a_terminal(*words, "-o", tmp_path / "b", TERM="dumb")
    assert "\x1b" not in written
    assert "stillmap: warning: no odometry" in written
    assert "stillmap: mapping, iteration 1" in written


def test_what_is_logged_stands_above_the_bar(on_a_terminal, room, tmp_path):
    words = ("-v", "map", room, "-o", tmp_path / "out", "--set", "em.max_iterations=1")
    status, written = on_a_terminal(*words)
    assert status == 0
    lines = [line.rpartition("\x1b[2K")[2] for line in written.splitlines()]
    assert any(line.startswith("stillmap: iteration 1: bound") for line in lines), lines
