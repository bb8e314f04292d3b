"""`stillmap view`: the report, in a browser where there is one."""

import os
import sys

import pytest

SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")


@pytest.fixture
def result(tmp_path):
    out = tmp_path / "a result"
    out.mkdir()
    (out / "report.html").write_text("<!doctype html>")
    return out


@pytest.fixture
def elsewhere(monkeypatch):
    """No screen, no browser."""
    for name in SCREENS:
        monkeypatch.delenv(name, raising=False)


def test_prints_where_the_report_is(call, result, monkeypatch):
    monkeypatch.chdir(result.parent)
    done = call("view", "a result", "--print")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{result / 'report.html'}\n", "")


@pytest.mark.skipif(sys.platform == "darwin", reason="there is always a screen")
@pytest.mark.usefixtures("elsewhere")
def test_without_a_screen_it_says_where_the_report_is(call, result):
    done = call("view", result)
    assert (done.returncode, done.stdout) == (0, "")
    assert str(result / "report.html") in done.stderr


def test_opens_the_browser_of_the_environment(stillmap, result, tmp_path):
    browser = tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\necho "$1" > "{tmp_path}/opened"\n')
    browser.chmod(0o755)
    environment = {**os.environ, "BROWSER": f"{browser} %s"}
    done = stillmap("view", result, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / "opened").read_text() == f"{(result / 'report.html').as_uri()}\n"


def test_what_is_no_result_is_refused(call, tmp_path):
    (tmp_path / "results").mkdir()
    (tmp_path / "file").write_text("")
    for name, said in (
        ("results", "is no result"),
        ("file", "is no result"),
        ("result", f"does not exist (did you mean '{tmp_path / 'results'}'?)"),
    ):
        done = call("view", tmp_path / name)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.startswith(f"stillmap: {tmp_path / name}: {said}")
        assert done.stderr.count("\n") == 1
